"""First-order filter of recorded velocities, measured against the derivative of the poses.

The measurement needs no simulator, so physics that the simulator lacks does not hide the filter. A dead time, as of a
difference of poses or of another sensor, delays a velocity without a filter; a filter also attenuates fast changes. So
a dead time is fitted together with the time constant. Both velocities are smoothed first: the derivative of the poses
has noise, and any filter would lower its error.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.optimize import minimize_scalar

from carlab.core.quantities import FloatArray
from carlab.diagnosis.settings import IDENTIFICATION
from carlab.prediction.windows import MIN_HISTORY_S, IndexArray, RecordingSegment, history_rows
from carlab.recording.faults.robust import MAX_FIT_ROWS, first_order_lag, parabola_minimum, trimmed_scale
from carlab.recording.faults.settings import LIMITS

VELOCITIES = range(3, 6)
"""Columns of the state: vx, vy, yaw rate."""
DEAD_TIME_STEP = 0.25
"""Step of the grids of dead times, in rows."""
DEAD_TIME_ROWS = np.arange(-1.0, 4.01, DEAD_TIME_STEP)
"""Dead times of filtered velocity columns behind the poses, in rows."""
MAX_DEAD_TIME_S = 0.6
"""Maximum dead time [s] without a filter: about that of the slowest filter together with its longest dead time."""
TIME_CONSTANTS_S = np.arange(0.0, 0.4, 0.01)
"""[s] Grid of time constants. Slower filters leave little of a velocity."""
MIN_SHARE = 1e-12
"""Unexplained share of a velocity that is numerically zero."""


@dataclass(frozen=True, slots=True)
class VelocityFilter:
    """A filter of the velocity columns.

    Attributes:
        time_constant_s: of the first-order filter [s].
        unexplained_ratio: unexplained variance of the velocities with the best dead time alone, over that with the
            filter in addition; geometric mean of the channels.
    """

    time_constant_s: float
    unexplained_ratio: float


@dataclass(frozen=True, slots=True)
class _Rows:
    """Compared rows of the segments: index (m,) of each among all n rows, and of both ends of its segment (m,).

    The car moves in these rows. The unknown state of the filter at the start of the segment has decayed there.
    """

    index: IndexArray
    first: IndexArray
    last: IndexArray

    @classmethod
    def of(cls, segments: Sequence[RecordingSegment]) -> _Rows:
        speed = np.concatenate([np.hypot(each.smooth[:, 3], each.smooth[:, 4]) for each in segments])
        counts = np.array([len(each.t_s) for each in segments])
        last = np.repeat(np.cumsum(counts) - 1, counts)
        first = last - np.repeat(counts, counts) + 1
        has_history = np.arange(len(speed)) - first >= history_rows(segments[0].period_s, MIN_HISTORY_S)
        index = np.flatnonzero((speed > LIMITS.moving_mps) & has_history)
        index = index[:: max(1, math.ceil(len(index) / MAX_FIT_ROWS))]
        return cls(index, first[index], last[index])

    def delayed(self, values: FloatArray, dead_rows: float) -> FloatArray:
        """Values (n,), ``dead_rows`` later, at the compared rows (m,); linear between rows of a segment."""
        at = np.clip(self.index - dead_rows, self.first, self.last)
        return np.asarray(np.interp(at, np.arange(len(values)), values))


@dataclass(frozen=True, slots=True)
class _Velocity:
    """A velocity, smoothed: the recorded one (m,) at the compared rows, and that of the pose (k,) in each segment."""

    rows: _Rows
    recorded: FloatArray
    of_pose: Sequence[FloatArray]
    period_s: float

    @classmethod
    def of(cls, segments: Sequence[RecordingSegment], rows: _Rows, column: int) -> _Velocity:
        period_s = segments[0].period_s
        width = IDENTIFICATION.filter_smoothing_s / period_s
        recorded = np.concatenate([gaussian_filter1d(each.states[:, column], width) for each in segments])
        of_pose = [gaussian_filter1d(each.smooth[:, column], width) for each in segments]
        return cls(rows, recorded[rows.index], of_pose, period_s)

    def unexplained_shares(self, time_constant_s: float, dead_times: FloatArray) -> FloatArray:
        """Shares (d,) of its variance that the filtered velocity of the pose leaves, after dead times (d,) [rows]."""
        filtered = np.concatenate([first_order_lag(each, self.period_s, time_constant_s) for each in self.of_pose])
        variance = float(np.mean(self.recorded**2)) + MIN_SHARE
        left = [trimmed_scale(self.rows.delayed(filtered, dead_rows), self.recorded)[1] for dead_rows in dead_times]
        return np.maximum(np.array(left) / variance, MIN_SHARE)


def velocity_filter(segments: Sequence[RecordingSegment]) -> VelocityFilter | None:
    """The filter of the velocities of recordings; None if a dead time explains them about as well.

    All segments have the same period. Above ``velocity_max_period_s`` the poses give no velocity to compare with.
    """
    if segments[0].period_s > IDENTIFICATION.velocity_max_period_s:
        return None
    rows = _Rows.of(segments)
    if len(rows.index) < IDENTIFICATION.filter_min_rows:
        return None
    velocities = [_Velocity.of(segments, rows, column) for column in VELOCITIES]
    shares = np.array([[v.unexplained_shares(tau, DEAD_TIME_ROWS) for tau in TIME_CONSTANTS_S] for v in velocities])
    cost = np.log(shares).mean(axis=0)  # (time constants, dead times)
    best, dead = np.unravel_index(np.argmin(cost), cost.shape)
    unexplained = shares[:, best, dead]
    channel_ratios = _without_filter(velocities) / unexplained
    ratio = float(np.exp(np.log(channel_ratios).mean()))
    is_significant = ratio > IDENTIFICATION.filter_ratio_min
    acts_on_all = channel_ratios.min() > IDENTIFICATION.filter_channel_ratio_min
    if not (is_significant and acts_on_all and unexplained.max() < IDENTIFICATION.filter_unexplained_max):
        return None
    return VelocityFilter(parabola_minimum(TIME_CONSTANTS_S, cost[:, dead]), ratio)


def _without_filter(velocities: Sequence[_Velocity]) -> FloatArray:
    """Unexplained shares (channels,) with the best dead time alone, refined between the steps of the grid."""

    def shares(dead_times: FloatArray) -> FloatArray:
        return np.array([each.unexplained_shares(0.0, dead_times) for each in velocities])

    dead_times = np.arange(DEAD_TIME_ROWS[0], MAX_DEAD_TIME_S / velocities[0].period_s, DEAD_TIME_STEP)
    nearest = dead_times[np.argmin(np.log(shares(dead_times)).mean(axis=0))]
    refined = minimize_scalar(
        lambda rows: float(np.log(shares(np.array([rows]))).mean()),
        bounds=(nearest - DEAD_TIME_STEP, nearest + DEAD_TIME_STEP),
        method="bounded",
    )
    return shares(np.array([refined.x]))[:, 0]
