"""First-order filter of recorded velocities, measured against the derivative of the poses.

The measurement needs no simulator, so physics that the simulator lacks does not hide the filter. A dead time, as of a
difference of poses or of another sensor, delays a velocity without a filter; a filter also attenuates fast changes. So
a dead time is fitted together with the time constant. Both velocities are smoothed first: the derivative of the poses
has noise, and any filter would lower its error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.optimize import minimize_scalar

from carlab.core.quantities import FloatArray
from carlab.diagnosis.settings import IDENTIFICATION
from carlab.prediction.windows import RecordingSegment
from carlab.recording.faults.robust import first_order_lag, parabola_minimum, trimmed_scale
from carlab.recording.faults.settings import LIMITS
from carlab.recording.pose_velocity import BoolArray

VELOCITIES = range(3, 6)
"""Columns of the state: vx, vy, yaw rate."""
DEAD_TIME_ROWS = np.arange(-1.0, 4.01, 0.25)
"""Dead times of velocity columns behind the poses, in rows."""
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
class _Velocity:
    """A velocity of a segment: the recorded one (n,), that of the pose (n,), both smoothed, and moving rows (n,)."""

    recorded: FloatArray
    of_pose: FloatArray
    moving: BoolArray
    period_s: float

    def filtered(self, time_constant_s: float) -> FloatArray:
        """The velocity of the pose behind a filter (n,)."""
        return first_order_lag(self.of_pose, self.period_s, time_constant_s)


def velocity_filter(segments: Sequence[RecordingSegment]) -> VelocityFilter | None:
    """The filter of the velocities of recordings; None if a dead time explains them about as well."""
    channels = [[_velocity(segment, channel) for segment in segments] for channel in VELOCITIES]
    if any(sum(int(each.moving.sum()) for each in channel) < IDENTIFICATION.filter_min_rows for channel in channels):
        return None
    grid = np.array([[_unexplained_shares(channel, tau) for tau in TIME_CONSTANTS_S] for channel in channels])
    cost = np.log(grid).mean(axis=0)  # (time constants, dead times)
    best, dead = np.unravel_index(np.argmin(cost), cost.shape)
    unexplained = grid[:, best, dead]
    channel_ratios = _without_filter(channels, cost[0]) / unexplained
    ratio = float(np.exp(np.log(channel_ratios).mean()))
    is_significant = ratio > IDENTIFICATION.filter_ratio_min
    acts_on_all = channel_ratios.min() > IDENTIFICATION.filter_channel_ratio_min
    if not (is_significant and acts_on_all and unexplained.max() < IDENTIFICATION.filter_unexplained_max):
        return None
    return VelocityFilter(parabola_minimum(TIME_CONSTANTS_S, cost[:, dead]), ratio)


def _velocity(segment: RecordingSegment, channel: int) -> _Velocity:
    width = IDENTIFICATION.filter_smoothing_s / segment.period_s
    recorded, of_pose = (gaussian_filter1d(each[:, channel], width) for each in (segment.states, segment.smooth))
    moving = np.hypot(segment.smooth[:, 3], segment.smooth[:, 4]) > LIMITS.moving_mps
    return _Velocity(recorded, of_pose, moving, segment.period_s)


def _unexplained_shares(channel: Sequence[_Velocity], time_constant_s: float) -> FloatArray:
    """Shares (dead times,) of a velocity that the filtered velocity of the pose leaves."""
    filtered = [each.filtered(time_constant_s) for each in channel]
    return np.array([_unexplained_share(channel, filtered, rows) for rows in DEAD_TIME_ROWS])


def _unexplained_share(channel: Sequence[_Velocity], filtered: Sequence[FloatArray], dead_rows: float) -> float:
    recorded = np.concatenate([each.recorded[each.moving] for each in channel])
    delayed = [_delayed(f, dead_rows)[each.moving] for f, each in zip(filtered, channel, strict=True)]
    left = trimmed_scale(np.concatenate(delayed), recorded)[1]
    return max(left / (float(np.mean(recorded**2)) + MIN_SHARE), MIN_SHARE)


def _without_filter(channels: Sequence[Sequence[_Velocity]], cost: FloatArray) -> FloatArray:
    """Shares (channels,) that the best dead time leaves, refined between the rows of the grid with ``cost``."""
    nearest = DEAD_TIME_ROWS[np.argmin(cost)]
    step = DEAD_TIME_ROWS[1] - DEAD_TIME_ROWS[0]

    def shares(dead_rows: float) -> FloatArray:
        return np.array([_unexplained_share(c, [each.of_pose for each in c], dead_rows) for c in channels])

    refined = minimize_scalar(
        lambda rows: np.log(shares(rows)).mean(), bounds=(nearest - step, nearest + step), method="bounded"
    )
    return shares(float(refined.x))


def _delayed(values: FloatArray, rows: float) -> FloatArray:
    """Values (n,) ``rows`` rows later, linear between rows."""
    index = np.arange(len(values), dtype=np.float64)
    return np.interp(index - rows, index, values)
