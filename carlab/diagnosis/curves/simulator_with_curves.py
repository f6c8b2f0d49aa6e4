"""A simulator with measured curves from recordings, without a report: for priors of learned cars."""

from __future__ import annotations

from collections.abc import Sequence

from carlab.core.episode_data import EpisodeData
from carlab.diagnosis.curves.curve_fit import fit_curves
from carlab.diagnosis.curves.support import without_extrapolation
from carlab.diagnosis.identification.held_out_errors import mean_noise_floor
from carlab.diagnosis.identification.measurement_noise import estimate_noise
from carlab.diagnosis.identification.velocity_window import with_initial_states
from carlab.diagnosis.recording_faults import find as data_faults_of
from carlab.diagnosis.recordings import split_recordings
from carlab.diagnosis.selection.problem import RunControl, SearchProblem
from carlab.diagnosis.selection.search import search
from carlab.diagnosis.settings import DEFAULT, DiagnosisSettings
from carlab.diagnosis.state_alignment import with_known_latency
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.effects import CATALOGUE, DelayEffect

EFFECTS_WITH_CURVES = tuple(
    name for name, effect in CATALOGUE.items() if isinstance(effect, DelayEffect) and effect.fitted_with_curves
)
"""Effects that are searched before the curves (the command delay); most others are parts of a curve."""


def simulator_with_curves(
    episodes: Sequence[EpisodeData], nominal: SimulatorConfig, *, settings: DiagnosisSettings = DEFAULT
) -> SimulatorConfig:
    """Fit base parameters, a command delay and measured curves to recordings, as ``diagnose`` with ``curves`` does.

    Nothing is held out, and windows with events are left out.

    Args:
        episodes: recordings.
        nominal: the simulator of the car file.
        settings: settings of the diagnosis.

    Returns:
        The simulator with its curves. Without a curve that left-out blocks need: with the refitted parameters and the
        delay.

    Raises:
        Inconclusive: too little driving, speed or variation of the commands, or events in all windows.
        DataError: a recording has fewer than two commands.
    """
    nominal = with_known_latency(nominal, episodes)
    repaired, _, _ = data_faults_of.check(episodes, (), nominal)
    # The second argument is scored by a diagnosis; the fit does not use it.
    recordings = split_recordings(repaired, repaired, settings.windows.default_held_out_share, nominal, settings)
    (windows,) = with_initial_states((recordings.fit_windows,), nominal)
    noise = estimate_noise(recordings.fit_segments, windows.curvature_bias)
    floor = mean_noise_floor(windows, noise, nominal)
    problem = SearchProblem(nominal, windows, floor, noise.measured, {}, EFFECTS_WITH_CURVES, settings)
    control = RunControl()
    found = search(problem, control)
    measured, _ = fit_curves(problem, found, control)
    if measured is None:
        return found.best.config
    return without_extrapolation(measured, recordings.fit_segments, settings.curves).fit.config
