"""Gaps between stamps, and stamps that are nominal by distance over speed."""

from __future__ import annotations

import numpy as np

from carlab.core.quantities import FloatArray
from carlab.recording.faults.fault import Fault
from carlab.recording.faults.settings import LIMITS
from carlab.recording.pose_velocity import IndexArray


def gap_rows(t_s: FloatArray) -> IndexArray:
    """Indices k, shape (G,), where there is a gap between rows k - 1 and k of the stamps (N,)."""
    step = np.diff(t_s)
    return np.flatnonzero(step > max(LIMITS.gap_periods * float(np.median(step)), LIMITS.gap_s)) + 1


def segments(rows: int, breaks: IndexArray) -> FloatArray:
    """Number of the unbroken stretch of each row, (rows,); ``breaks`` (G,) are the first rows of new stretches."""
    starts = np.zeros(rows)
    starts[breaks] = 1
    return np.cumsum(starts)


def periods_by_distance(position: FloatArray, velocity: FloatArray, segment: FloatArray) -> FloatArray:
    """Time from row to row by distance over speed [s], shape (N - 1,); NaN at low speed and across breaks.

    Right where the velocity columns are backward differences of the pose by the true period, as loggers make them.
    ``position`` (2, N) is x and y [m], ``velocity`` (2, N) is vx and vy [m/s] in any frame, and ``segment`` (N,) is the
    number of the unbroken stretch.
    """
    distance = np.hypot(*np.diff(position, axis=1))
    speed = np.hypot(*velocity)[1:]
    usable = (speed > LIMITS.moving_mps) & (np.diff(segment) == 0)
    return np.where(usable, distance / np.where(usable, speed, 1.0), np.nan)


def nominal_clock(t_s: FloatArray, periods_s: FloatArray) -> Fault | None:
    """Compare stamps (N,) with periods by distance over speed (N - 1,): a nominal clock over rows that are not even."""
    stamped = np.diff(t_s)
    known = np.isfinite(periods_s)
    if known.sum() < 200:
        return None
    periods = periods_s[known]
    ratio = periods / stamped[known]
    low, median, high = (float(q) for q in np.percentile(ratio, [25, 50, 75]))
    wrong = np.flatnonzero(known)[np.abs(ratio - median) > LIMITS.clock_step]
    are_differences = high - low <= LIMITS.clock_spread and abs(median - 1) <= LIMITS.clock_step
    if not are_differences or len(wrong) < 0.01 * known.sum():
        return None
    p1, p99 = (float(q) for q in np.percentile(periods, [1, 99]))
    mean, mean_stamped = float(np.mean(periods)), float(np.mean(stamped))
    observation = (
        f"by distance over speed, rows were {p1 * 1e3:.1f} to {p99 * 1e3:.1f} ms apart (98 %), {mean * 1e3:.2f} ms on "
        f"average, where the stamps say {mean_stamped * 1e3:.2f} ms; {len(wrong)} steps are off by more than 10 %: the "
        "stamps are nominal"
    )
    evidence = {"mean_s": mean, "p1_s": p1, "p99_s": p99, "stamped_s": mean_stamped}
    return Fault("clock_drift", "t", observation, evidence, "--clock velocity", wrong + 1)
