"""Over which time a recording's velocities were differentiated: the window smears them, which looks like a lag.

A velocity that a symmetric window of variance s2 gives is ``v + s2 / 2 d2v/dt2`` to the fourth order. The difference of
the poses before and after a tick is such a velocity, of a box as wide as two ticks, whose variance is known. So what
the columns differ from it by, held against d2v/dt2, gives the variance of their window. All of that is measured, so
that physics which the simulator leaves out does not matter; the simulator's own d2v/dt2, free of noise, serves as the
instrument of the regression.
"""

from __future__ import annotations

import numpy as np

from carlab.core.quantities import FloatArray
from carlab.diagnosis.prediction import Predictor, bend_of
from carlab.diagnosis.shots import Shots, body_states
from sim_backends.car_parameters import SimulatorConfig

COARSEST_S = 0.06
"""Longest period at which differences of poses are velocities."""
WIDEST_S = 0.25
"""Width of the widest box that is taken for a window."""
STANDARD_ERRORS = 3.0
"""A window must be so certain to be taken into account."""
_LEAST = 50


def smear_s2(shots: Shots, config: SimulatorConfig) -> float:
    """Variance [s2] of the window of the velocity columns; 0 where none is found for certain.

    Args:
        shots: with the velocities as recorded.
        config: a simulator that is roughly right.
    """
    period_s = shots.period_s
    if period_s > COARSEST_S or shots.steps < 6:
        return 0.0
    boxed = _box_velocities(shots)
    difference = (boxed[:, 1:-1] - shots.measured[:, 2:-2])[..., 3:]
    bend = bend_of(boxed, period_s)[:, 1:-1]
    instrument = bend_of(Predictor(shots, config)()[0], period_s)[:, 2:-2]
    variances, certainties = [], []
    for channels in ((0, 1), (2,)):
        z, d, b = (values[..., channels].ravel() for values in (instrument, difference, bend))
        both = float(z @ b)
        if len(z) < _LEAST or abs(both) < 1e-9:
            continue
        slope = float(z @ d) / both
        error = float(np.linalg.norm(z * (d - slope * b))) / abs(both)
        variances.append((2.0 * period_s) ** 2 / 12.0 - 2.0 * slope)
        certainties.append(1.0 / max(2.0 * error, 1e-9) ** 2)
    if not variances:
        return 0.0
    mean = float(np.average(variances, weights=certainties))
    certain = mean * float(np.sqrt(np.sum(certainties))) > STANDARD_ERRORS
    return min(mean, WIDEST_S**2 / 12.0) if certain else 0.0


def _box_velocities(shots: Shots) -> FloatArray:
    """States (S, K - 1, 6) of the inner ticks with velocities from the poses before and after."""
    pose = shots.measured[..., :3]
    rate = (pose[:, 2:] - pose[:, :-2]) / (2.0 * shots.period_s)
    return body_states(pose[:, 1:-1].reshape(-1, 3), rate.reshape(-1, 3)).reshape(*rate.shape[:2], 6)
