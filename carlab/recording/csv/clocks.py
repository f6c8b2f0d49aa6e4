"""Reconstructed clocks: from distance over speed, and from the constant frame rate of a camera."""

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

_MIN_ROWS = 200
_MEDIAN_FILTER_ROWS = 51


def rebuilt_clock(channels: Channels) -> tuple[FloatArray, str]:
    """Stamps (N,) [s] from distance over speed (below 0.3 m/s the median period), and a note about them."""
    if "vx" not in channels.values or "vy" not in channels.values:
        raise DataError("The clock cannot be rebuilt without vx and vy columns; use --clock column.")
    periods = channels.periods_s()
    median = float(np.nanmedian(periods)) if np.isfinite(periods).any() else float("nan")
    # Periods outside 0.5 to 3 medians are due to wrong speeds (an impact, a stale row), not to the clock.
    plausible = (periods > 0.5 * median) & (periods < 3 * median)
    if plausible.sum() < 100:
        raise DataError("The car hardly moves: the clock cannot be rebuilt by distance over speed; use --clock column.")
    broken = np.diff(channels.segment) != 0
    steps = np.where(plausible, periods, np.where(broken, np.diff(channels.t_s), median))
    note = f"rebuilt from distance over speed for {int(plausible.sum())} of {len(steps)} periods, median elsewhere"
    return np.concatenate([[0.0], np.cumsum(steps)]), note


def even_clock(t_s: FloatArray) -> tuple[FloatArray, list[Finding]]:
    """Frame times of a source with constant rate, from arrival stamps (N,) [s] with jitter.

    The times are a straight line through each part without a gap. A permanent step by an integer number of periods is a
    lost frame and remains. Parts of less than ``_MIN_ROWS`` rows keep their stamps.
    """
    even = t_s.copy()
    edges = [0, *gap_rows(t_s).tolist(), len(t_s)]
    moved = 0
    for first, last in pairwise(edges):
        if last - first < _MIN_ROWS:
            continue
        stamps = t_s[first:last]
        frame = np.arange(last - first, dtype=np.float64)
        span = min(500, (last - first) // 4)  # Most spans have no lost frame; the median is that of a span without.
        period, start = float(np.median(stamps[span:] - stamps[:-span])) / span, stamps[0]
        for _ in range(8):
            late = median_filter(stamps - (start + period * frame), _MEDIAN_FILTER_ROWS, mode="nearest")
            step = np.round((late - late.min()) / period)
            step = np.minimum.accumulate(step[::-1])[::-1]  # A temporary step is a late arrival, not a lost frame.
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
