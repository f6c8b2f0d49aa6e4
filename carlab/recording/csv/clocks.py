"""Reconstruction of stamps: from distance over speed, or as the constant frame rate of a camera."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy.ndimage import median_filter

from carlab.core.errors import DataError
from carlab.core.quantities import FloatArray
from carlab.recording.audit.audit import Channels
from carlab.recording.audit.report import Finding, Severity
from carlab.recording.column_mapping import POSE_CHANNELS
from carlab.recording.faults.robust import robust_std
from carlab.recording.faults.stamps import gap_rows
from carlab.recording.pose_velocity import pose_motion

_MIN_ROWS = 200
_MEDIAN_FILTER_ROWS = 51


def rebuilt_clock(channels: Channels) -> tuple[FloatArray, str]:
    """Stamps (N,) [s] from distance over speed, with the median period below 0.3 m/s, and a note about them.

    Raises:
        DataError: there is no pose, there are no vx and vy columns, or the car hardly moves.
    """
    if channels.motion is None or any(name not in channels.values for name in ("vx", "vy")):
        raise DataError("The clock cannot be rebuilt without x, y, vx and vy columns; use --clock column.")
    periods_s = channels.periods_s()
    median_s = float(np.nanmedian(periods_s)) if np.isfinite(periods_s).any() else float("nan")
    # A period outside 0.5 to 3 medians is due to a wrong speed (an impact, a stale row), not to the clock.
    is_plausible = (periods_s > 0.5 * median_s) & (periods_s < 3 * median_s)
    if is_plausible.sum() < 100:
        raise DataError("The car hardly moves: the clock cannot be rebuilt by distance over speed; use --clock column.")
    is_break = np.diff(channels.segment) != 0
    steps_s = np.where(is_plausible, periods_s, np.where(is_break, np.diff(channels.t_s), median_s))
    note = f"rebuilt from distance over speed for {int(is_plausible.sum())} of {len(steps_s)} periods, median elsewhere"
    return np.concatenate([[0.0], np.cumsum(steps_s)]), note


def with_rebuilt_clock(channels: Channels) -> tuple[Channels, str]:
    """The channels with the stamps of ``rebuilt_clock`` and the motion of the pose by them, and its note.

    Raises:
        DataError: as ``rebuilt_clock``.
    """
    t_s, note = rebuilt_clock(channels)
    x_m, y_m, yaw_rad = (channels.values[name] for name in POSE_CHANNELS)
    motion = pose_motion(t_s, x_m, y_m, yaw_rad, channels.segment)
    return replace(channels, t_s=t_s, motion=motion), note


def even_clock(t_s: FloatArray) -> tuple[FloatArray, list[Finding]]:
    """Estimate the frame times of a source with constant rate from its arrival stamps (N,) [s] with jitter.

    Fits a straight line to the stamps of each part without a gap. A permanent step by an integer number of periods is a
    lost frame and is kept. Parts of less than ``_MIN_ROWS`` rows keep their stamps.

    Returns:
        Frame times (N,) [s] from 0 and a finding; the stamps and no finding if every part is too short.
    """
    frame_times_s = t_s.copy()
    bounds = [0, *gap_rows(t_s).tolist(), len(t_s)]
    n_changed = 0
    for first, last in pairwise(bounds):
        if last - first < _MIN_ROWS:
            continue
        stamps_s = t_s[first:last]
        frame = np.arange(last - first, dtype=np.float64)
        span = min(500, (last - first) // 4)  # The median span has no lost frame.
        period_s, start_s = float(np.median(stamps_s[span:] - stamps_s[:-span])) / span, stamps_s[0]
        for _ in range(8):
            delay_s = median_filter(stamps_s - (start_s + period_s * frame), _MEDIAN_FILTER_ROWS, mode="nearest")
            lost_frames = np.round((delay_s - delay_s.min()) / period_s)
            # A temporary step is a delayed arrival, not a lost frame.
            lost_frames = np.minimum.accumulate(lost_frames[::-1])[::-1]
            frame += lost_frames
            period_s, start_s = np.polyfit(frame, stamps_s, 1)
            if not lost_frames.any():
                break
        frame_times_s[first:last] = start_s + period_s * frame
        n_changed += last - first
    if not n_changed:
        return t_s, []
    correction_s = frame_times_s - t_s
    jitter_s = robust_std(correction_s)
    finding = Finding(
        "arrival_stamps",
        "t",
        Severity.REPAIRED,
        f"The stamps of {n_changed} rows are arrival times with a jitter of {jitter_s * 1e3:.2f} ms (up to "
        f"{float(np.abs(correction_s).max()) * 1e3:.1f} ms) about a constant frame rate; they were replaced by the "
        "frame times.",
        n_changed,
        evidence={"jitter_s": jitter_s, "largest_s": float(np.abs(correction_s).max())},
    )
    return frame_times_s - frame_times_s[0], [finding]
