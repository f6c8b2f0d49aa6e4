"""Clocks that are made anew: from distance over speed, and from the even beat of a camera."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy.ndimage import median_filter

from carlab.core.errors import DataError
from carlab.core.quantities import FloatArray
from carlab.recording.audit.audit import Channels
from carlab.recording.audit.report import Finding, Severity
from carlab.recording.faults.robust import robust_std
from carlab.recording.faults.stamps import gap_rows

_LEAST_ROWS = 200
_BEAT_ROWS = 51


def rebuilt_clock(channels: Channels) -> tuple[FloatArray, str]:
    """Stamps (N,) from distance over speed; slower than 0.3 m/s, the median of those periods. And a note on it."""
    if "vx" not in channels.values or "vy" not in channels.values:
        raise DataError("The clock can be rebuilt only where vx and vy columns are given; use --clock column.")
    periods = channels.periods_s()
    median = float(np.nanmedian(periods)) if np.isfinite(periods).any() else float("nan")
    # Beyond half to three times the median, the speed is at fault (an impact, a stale row), not the clock.
    trusted = (periods > 0.5 * median) & (periods < 3 * median)
    if trusted.sum() < 100:
        raise DataError("The car hardly moves: the clock cannot be rebuilt by distance over speed; use --clock column.")
    broken = np.diff(channels.segment) != 0
    steps = np.where(trusted, periods, np.where(broken, np.diff(channels.t_s), median))
    note = f"rebuilt from distance over speed for {int(trusted.sum())} of {len(steps)} periods, median elsewhere"
    return np.concatenate([[0.0], np.cumsum(steps)]), note


def even_clock(t_s: FloatArray) -> tuple[FloatArray, list[Finding]]:
    """Stamps of frames of a source of constant rate, from the stamps of their arrival (N,), which jitter.

    A straight line through each stretch without a gap; a lasting step of the stamps by whole periods is a lost frame
    and stays. Stretches of less than 200 rows keep their stamps.
    """
    even = t_s.copy()
    edges = [0, *gap_rows(t_s).tolist(), len(t_s)]
    moved = 0
    for first, last in pairwise(edges):
        if last - first < _LEAST_ROWS:
            continue
        stamps = t_s[first:last]
        frame = np.arange(last - first, dtype=np.float64)
        span = min(500, (last - first) // 4)  # most such spans have lost no frame, so their median has not either
        period, start = float(np.median(stamps[span:] - stamps[:-span])) / span, stamps[0]
        for _ in range(8):
            late = median_filter(stamps - (start + period * frame), _BEAT_ROWS, mode="nearest")
            step = np.round((late - late.min()) / period)
            step = np.minimum.accumulate(step[::-1])[::-1]  # what does not last was only late
            frame += step
            period, start = np.polyfit(frame, stamps, 1)
            if not step.any():
                break
        even[first:last] = start + period * frame
        moved += last - first
    if not moved:
        return t_s, []
    off = even - t_s
    jitter_s = robust_std(off)
    finding = Finding(
        "arrival_stamps",
        "t",
        Severity.REPAIRED,
        f"The stamps of {moved} rows are those of arrival and jitter by {jitter_s * 1e3:.2f} ms (up to "
        f"{float(np.abs(off).max()) * 1e3:.1f} ms) about an even beat; the beat was taken.",
        moved,
        evidence={"jitter_s": jitter_s, "largest_s": float(np.abs(off).max())},
    )
    return even - even[0], [finding]
