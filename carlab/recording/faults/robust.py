"""Robust fits of a column by another: spread, correlation, lag, first-order filter, scale."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from carlab.core.quantities import FloatArray
from carlab.core.robust import STD_OVER_MAD
from carlab.recording.pose_velocity import BoolArray

LAGS_S = np.arange(-0.05, 0.3001, 0.01)
TIME_CONSTANTS_S = (0.0, 0.02, 0.05, 0.1, 0.2, 0.4)
FILTER_LAG_PERIODS = np.arange(-1.0, 2.01, 0.5)
KEPT_SHARE = 0.95
"""Share of the rows that a trimmed fit keeps."""
MAX_FIT_ROWS = 50_000
"""A fit takes every k-th row of a longer column: eight minutes at 100 Hz determine scale and lag."""


def robust_std(values: FloatArray) -> float:
    """Standard deviation of values (n,) by the median of absolute deviations; 0 for an empty array."""
    return STD_OVER_MAD * float(np.median(np.abs(values - np.median(values)))) if len(values) else 0.0


def correlation(a: FloatArray, b: FloatArray) -> float:
    """Correlation of two (n,) arrays; 0 where one does not vary."""
    if len(a) < 3 or np.std(a) < 1e-9 or np.std(b) < 1e-9:
        return 0.0
    return float(np.corrcoef(a, b)[0, 1])


def runs(mask: BoolArray) -> list[tuple[int, int]]:
    """Starts and ends (exclusive) of the runs of True in a mask (n,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def held_at(t_s: FloatArray, command: FloatArray, lag_s: float) -> FloatArray:
    """The command (N,) that was held ``lag_s`` before each stamp."""
    rows = np.searchsorted(t_s, t_s - lag_s, side="right") - 1
    return command[np.clip(rows, 0, len(command) - 1)]


def held_means(t_s: FloatArray, held: FloatArray, begin_s: FloatArray, width_s: FloatArray | float) -> FloatArray:
    """Means (n,) over [begin, begin + width) of a value (N,) that is held from each of ``t_s`` (N,) on.

    ``begin_s`` is (n,); ``width_s`` is one number or (n,).
    """
    integral = np.concatenate([[0.0], np.cumsum(held[:-1] * np.diff(t_s))])

    def integral_to(moments: FloatArray) -> FloatArray:
        row = np.clip(np.searchsorted(t_s, moments, side="right") - 1, 0, len(t_s) - 1)
        return np.asarray(integral[row] + (moments - t_s[row]) * held[row])

    width = np.broadcast_to(np.asarray(width_s, dtype=np.float64), begin_s.shape)
    return (integral_to(begin_s + width) - integral_to(begin_s)) / width


def first_order_lag(values: FloatArray, period_s: float, time_constant_s: float) -> FloatArray:
    """Filter values (N,) on an even grid by a first-order lag without dead time (trapezoidal rule)."""
    if time_constant_s <= 0.0:
        return values
    ratio = 2.0 * time_constant_s / period_s
    gain, decay = 1.0 / (1.0 + ratio), (1.0 - ratio) / (1.0 + ratio)
    out, _ = lfilter([gain, gain], [1.0, decay], values, zi=[values[0] * (1.0 - gain)])
    return np.asarray(out)


def parabola_minimum(grid: FloatArray, cost: FloatArray) -> float:
    """Point of the least cost on an even grid (n,), by a parabola through it and its neighbours."""
    k = int(np.argmin(cost))
    if not 0 < k < len(cost) - 1:
        return float(grid[k])
    before, here, after = cost[k - 1 : k + 2]
    bend = before - 2.0 * here + after
    return float(grid[k] + (0.5 * (before - after) / bend if bend > 0 else 0.0) * (grid[1] - grid[0]))


@dataclass(frozen=True, slots=True)
class ColumnFit:
    """Column ~ scale * filtered reference(t - lag).

    Attributes:
        scale: in the column's unit over the reference's.
        lag_s: dead time [s].
        unexplained: mean square of the residual over that of the column, without the 5 % of rows that fit worst [1].
        unexplained_unshifted: the same without filter and dead time.
        rms: root mean square of the column, in its unit.
        prediction: scale * filtered reference(t - lag), (N,) in the column's unit.
    """

    scale: float
    lag_s: float
    unexplained: float
    unexplained_unshifted: float
    rms: float
    prediction: FloatArray

    @property
    def residual_rms(self) -> float:
        """Root mean square of the residual, in the column's unit."""
        return self.rms * math.sqrt(self.unexplained)


def fit_column(
    t_s: FloatArray,
    reference: FloatArray,
    column: FloatArray,
    rows: BoolArray,
    *,
    lags_s: FloatArray | None = None,
    time_constants_s: Sequence[float] = TIME_CONSTANTS_S,
) -> ColumnFit:
    """Fit a column (N,) by a scaled, filtered and delayed reference (N,) on ``rows``, least squares without outliers.

    Args:
        t_s: stamps (N,).
        reference: what the column should measure (N,).
        column: the column (N,).
        rows: mask (N,) of the rows to compare; larger values than six times the 90th percentile do not count, and of
            more than ``MAX_FIT_ROWS`` only every k-th.
        lags_s: even grid of dead times, refined by a parabola; without it, -1 to 2 rows in half rows, not refined,
            because velocity columns are differences of poses and lag by whole or half rows.
        time_constants_s: of the first-order filter; ``(0.0,)`` fits a dead time alone.
    """
    period = float(np.median(np.diff(t_s)))
    lags = FILTER_LAG_PERIODS * period if lags_s is None else lags_s
    compared = np.flatnonzero(rows & (np.abs(column) < 6.0 * np.percentile(np.abs(column[rows]), 90) + 1e-9))
    compared = compared[:: max(1, math.ceil(len(compared) / MAX_FIT_ROWS))]
    target = column[compared]
    mean_square = float(np.mean(target**2)) + 1e-18

    def fit(filtered: FloatArray, lag_s: float) -> tuple[float, float]:
        scale, cost = trimmed_scale(np.interp(t_s[compared] - lag_s, t_s, filtered), target)
        return cost / mean_square, scale

    best = (math.inf, 0.0, 0.0, reference)
    for time_constant_s in time_constants_s:
        filtered = first_order_lag(reference, period, time_constant_s)
        shares = np.array([fit(filtered, lag)[0] for lag in lags])
        refined = [] if lags_s is None else [parabola_minimum(lags, shares)]
        for lag in (float(lags[np.argmin(shares)]), *refined):
            unexplained, scale = fit(filtered, lag)
            if unexplained < best[0]:
                best = (unexplained, scale, lag, filtered)
    unexplained, scale, lag, filtered = best
    prediction = scale * np.interp(t_s - lag, t_s, filtered)
    return ColumnFit(scale, lag, unexplained, fit(reference, 0.0)[0], math.sqrt(mean_square), prediction)


def trimmed_scale(reference: FloatArray, column: FloatArray) -> tuple[float, float]:
    """Least-squares scale of the ``KEPT_SHARE`` of rows that fit best, and the mean square that it leaves."""
    keep = np.ones(len(column), dtype=bool)
    scale = 0.0
    for _ in range(3):
        x = reference[keep]
        scale = float(x @ column[keep]) / (float(x @ x) + 1e-18)
        error = np.abs(column - scale * reference)
        keep = error <= _quantile(error, KEPT_SHARE)
    return scale, float(np.mean(error[keep] ** 2))


def _quantile(values: FloatArray, share: float) -> float:
    """Quantile of values (n,), linear between neighbours: ``np.quantile`` without its overhead, 60 % of a fit."""
    position = share * (len(values) - 1)
    below = math.floor(position)
    above = min(below + 1, len(values) - 1)
    lower, upper = np.partition(values, (below, above))[[below, above]]
    return float(lower + (position - below) * (upper - lower))
