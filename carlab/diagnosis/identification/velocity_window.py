"""Window over which the velocities of a recording were differentiated.

A symmetric window of variance s2 gives the velocity ``v + s2 / 2 d2v/dt2`` to fourth order. The difference of the poses
before and after a tick is such a velocity, of a box of two ticks with known variance. The regression of the difference
between the velocity columns and this box velocity on d2v/dt2 gives the variance of their window. The regression uses
measured quantities, so physics that the simulator lacks does not bias it. Its instrument is the noise-free simulated
d2v/dt2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from carlab.core.quantities import FloatArray
from carlab.diagnosis.settings import IDENTIFICATION
from carlab.prediction.initial_states import without_curvature_bias
from carlab.prediction.predict import simulate_windows, velocity_curvature
from carlab.prediction.windows import PredictionWindows, body_states
from sim_backends.car_parameters import SimulatorConfig


def with_initial_states(
    windows: Sequence[PredictionWindows],
    config: SimulatorConfig,
    variance_s2: float | None = None,
) -> tuple[PredictionWindows, ...]:
    """Estimate velocity window and initial states of sets of windows.

    Args:
        windows: windows for the estimate of the velocity window, and further windows of the same recordings.
        config: an approximate simulator.
        variance_s2: variance of the velocity window [s2] if it is known.
    """
    if variance_s2 is None:
        variance_s2 = velocity_window_variance_s2(windows[0], config)
    known = [replace(w, velocity_window_s2=variance_s2) for w in windows]
    return tuple(without_curvature_bias(w, config) if len(w) else w for w in known)


def velocity_window_variance_s2(windows: PredictionWindows, config: SimulatorConfig) -> float:
    """Variance [s2] of the window of the velocity columns; 0 if it is not significant.

    Args:
        windows: windows of recordings with the same velocity estimator.
        config: an approximate simulator.
    """
    period_s = windows.period_s
    if period_s > IDENTIFICATION.velocity_max_period_s or windows.steps < 6:
        return 0.0
    boxed = _box_velocities(windows)
    difference = (boxed[:, 1:-1] - windows.measured[:, 2:-2])[..., 3:]
    curvature = velocity_curvature(boxed, period_s)[:, 1:-1]
    instrument = velocity_curvature(simulate_windows(windows, config)[0], period_s)[:, 2:-2]
    variances, precisions = [], []
    for channels in ((0, 1), (2,)):
        z, d, b = (values[..., channels].ravel() for values in (instrument, difference, curvature))
        covariance = float(z @ b)
        if len(z) < IDENTIFICATION.velocity_min_samples or abs(covariance) < 1e-9:
            continue
        slope = float(z @ d) / covariance
        error = float(np.linalg.norm(z * (d - slope * b))) / abs(covariance)
        variances.append((2.0 * period_s) ** 2 / 12.0 - 2.0 * slope)
        precisions.append(1.0 / max(2.0 * error, 1e-9) ** 2)
    if not variances:
        return 0.0
    mean = float(np.average(variances, weights=precisions))
    is_significant = mean * float(np.sqrt(np.sum(precisions))) > IDENTIFICATION.velocity_z_min
    return min(mean, IDENTIFICATION.velocity_max_width_s**2 / 12.0) if is_significant else 0.0


def _box_velocities(windows: PredictionWindows) -> FloatArray:
    """States (S, K - 1, 6) of the inner ticks with velocities from the poses before and after."""
    pose = windows.measured[..., :3]
    rate = (pose[:, 2:] - pose[:, :-2]) / (2.0 * windows.period_s)
    return body_states(pose[:, 1:-1].reshape(-1, 3), rate.reshape(-1, 3)).reshape(*rate.shape[:2], 6)
