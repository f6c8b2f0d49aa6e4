"""Even grids for recordings: their period, and the means of commands over their cells and over parts of the cells."""

from __future__ import annotations

import numpy as np

from carlab.core.quantities import FloatArray
from carlab.recording.faults.robust import held_means

MAX_JITTER_SHARE, MAX_JITTER_S = 0.2, 1e-3
"""Maximum deviation of the time between rows from its mean, share or [s]: jitter, or stamps in whole milliseconds."""
MAX_PERIOD_DEVIATION = 1e-3
"""Maximum relative deviation of a segment's period from that of its grid."""
MAX_PART_S = 0.0085
"""Maximum length [s] of a part. A step of a command that is averaged over 33 ms causes errors of several noise floors,
because tyres are not linear."""
MIN_DEVIATION = 0.05
"""Deviation of a part from the mean of its cell (full command = 1) from which the parts are simulated."""


def row_period_s(t_s: FloatArray, median_s: float) -> float:
    """Mean time between rows without gaps where their stamps are even up to jitter and rounding, else the median."""
    steps_s = np.diff(t_s)
    steps_s = steps_s[np.abs(steps_s - median_s) < 0.5 * median_s]
    mean_s = float(np.mean(steps_s))
    jitter_s = np.quantile(np.abs(steps_s - mean_s), 0.99)
    return mean_s if jitter_s <= max(MAX_JITTER_SHARE * mean_s, MAX_JITTER_S) else median_s


def even_grid(t_s: FloatArray, period_s: float) -> FloatArray:
    """Even stamps that begin at the first of ``t_s`` (N,).

    They end at the last stamp if this changes the period by at most ``MAX_PERIOD_DEVIATION``. Otherwise they are
    exactly ``period_s`` apart.
    """
    duration_s = float(t_s[-1] - t_s[0])
    steps = round(duration_s / period_s)
    if abs(duration_s - steps * period_s) <= MAX_PERIOD_DEVIATION * duration_s:
        return np.linspace(t_s[0], t_s[-1], steps + 1)
    return np.asarray(t_s[0] + period_s * np.arange(int(duration_s / period_s + 1e-6) + 1))


def part_count(period_s: float, rows_per_cell: int) -> int:
    """Number of parts R of a cell, at most one for each row."""
    return min(rows_per_cell, max(round(period_s / MAX_PART_S), 1))


def part_deviations(t: FloatArray, held: FloatArray, grid: FloatArray, period_s: float, parts: int) -> FloatArray:
    """Commands (n, R, 2) in equal parts of each cell of the grid (n,), less their mean over the cell.

    Args:
        t: stamps (N,).
        held: commands (N, 2), each held from its stamp on.
        grid: begins of the cells (n,).
        period_s: length of a cell.
        parts: R.
    """
    begins = (grid[:, None] + period_s / parts * np.arange(parts)).ravel()
    means = cell_means(t, held, begins, period_s / parts).reshape(len(grid), parts, 2)
    return np.asarray(means - means.mean(axis=1, keepdims=True))


def cell_means(t: FloatArray, held: FloatArray, grid: FloatArray, period_s: float) -> FloatArray:
    """Mean over [grid, grid + period) of values held from each t on."""
    return np.stack([held_means(t, column, grid, period_s) for column in held.T], axis=1)
