"""A step of a fit within the bounds of its parameters.

A parameter at a bound has no slope beyond it. Without the bounds in the step, its prior alone would move it, far back
into the range and against the data, and no step of the other parameters could lower the loss.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from carlab.core.quantities import FloatArray
from carlab.diagnosis.identification.fit_parameters import FitParameter

_BLOCK_EXCHANGES = 3
"""Exchanges of all wrong coordinates that may leave as many wrong ones as before."""
_MAX_EXCHANGES = 200
_NO_SLOPE = 1e-10
"""Slope, over the steepest one, that counts as zero."""


def coordinate_bounds(free: Sequence[FitParameter]) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest coordinates (n,) of the parameters."""
    ends = np.array([[f.coordinate(f.low), f.coordinate(f.high)] for f in free]).reshape(-1, 2)
    return ends.min(axis=1), ends.max(axis=1)


def bounded_step(matrix: FloatArray, gradient: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """The step d (n,) that minimises ``d'Md / 2 + g'd`` with ``low <= d <= high``.

    By block principal pivoting (Judice and Pires 1994): all coordinates that pass a bound are held there, all held
    ones whose slope points into the range are released, until there are none. If that does not reduce their number,
    one coordinate is exchanged at a time, which always ends.

    Args:
        matrix: symmetric and positive definite (n, n).
        gradient: (n,).
        low: bounds (n,), at most ``high``.
        high: bounds (n,).
    """
    at_low, at_high = np.zeros(len(gradient), bool), np.zeros(len(gradient), bool)
    fewest, attempts, flat = len(gradient) + 1, _BLOCK_EXCHANGES, _NO_SLOPE * np.abs(gradient).max(initial=0.0)
    for _ in range(_MAX_EXCHANGES):
        is_free = ~(at_low | at_high)
        step = np.where(at_low, low, np.where(at_high, high, 0.0))
        right = -(gradient + matrix[:, ~is_free] @ step[~is_free])[is_free]
        step[is_free] = np.linalg.solve(matrix[np.ix_(is_free, is_free)], right)
        slope = gradient + matrix @ step
        wrong = np.where(is_free, (step < low) | (step > high), np.where(at_low, slope < -flat, slope > flat))
        if not wrong.any():
            break
        attempts = _BLOCK_EXCHANGES if wrong.sum() < fewest else attempts - 1
        fewest = min(fewest, int(wrong.sum()))
        if attempts < 0:
            wrong[: np.flatnonzero(wrong)[-1]] = False
        at_low, at_high = (
            np.where(wrong, is_free & (step < low), at_low),
            np.where(wrong, is_free & (step > high), at_high),
        )
    return step.clip(low, high)


def held_at_bounds(free: Sequence[FitParameter], z: FloatArray, gradient: FloatArray) -> NDArray[np.bool_]:
    """Which coordinates z (n,) are at a bound beyond which the loss with ``gradient`` (n,) would fall."""
    low, high = coordinate_bounds(free)
    return ((z <= low) & (gradient > 0.0)) | ((z >= high) & (gradient < 0.0))


def inward_steps(free: Sequence[FitParameter], z: FloatArray, steps: FloatArray) -> FloatArray:
    """Steps (n,) for finite differences at z (n,), with the other sign where one would pass the upper bound.

    In a range narrower than the step it ends at the farther bound.
    """
    low, high = coordinate_bounds(free)
    above, below = high - z, z - low
    signed = np.where((steps <= above) | (above >= below), np.minimum(steps, above), -np.minimum(steps, below))
    is_choice = np.array([f.choice for f in free], bool)
    return np.where(is_choice | (signed == 0.0), steps, signed)
