"""Robust comparison of a column with the motion of the pose: scale, lag and what remains."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from carlab.core.quantities import FloatArray
from carlab.recording.csv.mapping import UNITS
from carlab.recording.pose_velocity import BoolArray


@dataclass(frozen=True, slots=True)
class LagFit:
    """Column ~ scale * reference(t - lag): the lag with the smallest median remainder, in the column's unit."""

    lag_s: float
    scale: float
    remainder: float
    remainder_unshifted: float
    correlation: float


def fit_lag(t_s: FloatArray, reference: FloatArray, column: FloatArray, mask: BoolArray, lags_s: FloatArray) -> LagFit:
    """Shift ``reference`` (N,) by each of ``lags_s`` and compare with ``column`` (N,) on the rows of ``mask``.

    The median of absolute differences is the measure, so that spikes do not count; its V-shaped least is refined
    between the grid's points by the two neighbours. The scale is the median ratio over the larger half of the values.
    """
    # By the scale without a shift first: in another unit, no shift would make the two alike.
    rough = _scale(reference[mask], column[mask])
    remainders = [_remainder(t_s, rough * reference, column, mask, lag) for lag in lags_s]
    k = int(np.argmin(remainders))
    lag = float(lags_s[k])
    if 0 < k < len(lags_s) - 1:
        before, here, after = remainders[k - 1 : k + 2]
        slope = max(before, after) - here
        if slope > 0:
            lag += 0.5 * float(lags_s[1] - lags_s[0]) * (before - after) / slope
    unshifted = _remainder(t_s, rough * reference, column, mask, 0.0)
    shifted = np.interp(t_s - lag, t_s, reference)[mask]
    chosen = column[mask]
    scale = _scale(shifted, chosen)
    limit = 5 * np.percentile(np.abs(chosen), 95) + 1e-12
    quiet = np.abs(chosen) < limit
    return LagFit(lag, scale, min(remainders), unshifted, correlation(shifted[quiet], chosen[quiet]))


def _scale(reference: FloatArray, column: FloatArray) -> float:
    strong = np.abs(reference) >= max(float(np.median(np.abs(reference))), 1e-9)
    return float(np.median(column[strong] / reference[strong])) if strong.any() else 1.0


def _remainder(t_s: FloatArray, reference: FloatArray, column: FloatArray, mask: BoolArray, lag_s: float) -> float:
    return float(np.median(np.abs(np.interp(t_s - lag_s, t_s, reference) - column)[mask]))


def correlation(a: FloatArray, b: FloatArray) -> float:
    """Correlation of two (n,) arrays; 0 where one does not vary."""
    if len(a) < 3 or np.std(a) < 1e-9 or np.std(b) < 1e-9:
        return 0.0
    return float(np.corrcoef(a, b)[0, 1])


def unit_of_scale(channel: str, scale: float) -> str | None:
    """The unit of ``channel``, other than SI, whose numbers are ``scale`` times (within 15 %) those in SI."""
    for unit, factor in list(UNITS[channel].items())[1:]:
        if abs(abs(scale) * factor - 1.0) < 0.15:
            return unit
    return None


def held_at(t_s: FloatArray, command: FloatArray, lag_s: float) -> FloatArray:
    """The command (N,) that was held ``lag_s`` before each stamp."""
    rows = np.searchsorted(t_s, t_s - lag_s, side="right") - 1
    return command[np.clip(rows, 0, len(command) - 1)]
