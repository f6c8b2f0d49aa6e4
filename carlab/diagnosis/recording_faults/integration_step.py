"""Check of the integration step: the nominal simulator at its usual and at a fine step."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from carlab.core.episode_data import EpisodeData
from carlab.core.errors import DataError
from carlab.core.quantities import STATE_NAMES
from carlab.diagnosis.findings import DataFault
from carlab.diagnosis.identification.measurement_noise import estimate_noise
from carlab.prediction.predict import simulate_windows
from carlab.prediction.step_length import MIN_STEP_S
from carlab.prediction.windows import cut_windows, segments_of
from sim_backends.car_parameters import SimulatorConfig

MAX_WINDOWS = 64
HORIZON_S = 1.0
FINE_STEP_S = MIN_STEP_S / 4.0


def check_integration(fit: Sequence[EpisodeData], nominal: SimulatorConfig) -> list[DataFault]:
    """Compare the difference of predictions at their usual step and at ``FINE_STEP_S`` with the noise, by channel.

    The difference is the root mean square after 1 s without the tenth of the windows with the largest differences,
    because a spinning car amplifies all errors. Returns an empty list without windows.
    """
    try:
        segments = segments_of(fit)
        windows = cut_windows(segments, HORIZON_S, 0.5).thinned(MAX_WINDOWS)
    except DataError:
        return []
    noise = estimate_noise(segments, windows.curvature_bias).measured
    with np.errstate(all="ignore"):  # a step that is far too coarse overflows
        usual, fine = (simulate_windows(windows, nominal, max_step_s=s, in_double=True) for s in (None, FINE_STEP_S))
        difference = np.abs(usual - fine)[0, :, -1]
    difference = np.where(np.isfinite(difference), difference, np.inf)
    difference_rms = np.sqrt(np.mean(np.sort(difference, axis=0)[: max(round(0.9 * len(windows)), 1)] ** 2, axis=0))
    return [
        DataFault(
            "integration_error",
            name,
            len(windows),
            f"reported: a finer step changes the simulator's {name} after {HORIZON_S:.0f} s by {size:.2g}, more than "
            f"the noise of the recording ({own:.2g}); do not interpret an error of this size as missing physics.",
        )
        for name, size, own in zip(STATE_NAMES, difference_rms, noise, strict=True)
        if size > own
    ]
