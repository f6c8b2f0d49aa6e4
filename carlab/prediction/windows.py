"""Recordings cut into prediction windows: short stretches that a model predicts from an estimated initial state.

The initial state of a window is a local cubic through the poses around it (Savitzky and Golay 1964), not the noisy
velocity columns. Each window includes the commands before it, so that delays and the states of servo and motor are
correct at its start.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_filter

from carlab.core.episode_data import EpisodeData
from carlab.core.errors import DataError
from carlab.core.planar import to_body
from carlab.core.quantities import FloatArray
from carlab.prediction.even_grid import MIN_DEVIATION, cell_means, even_grid, part_count, part_deviations, row_period_s
from carlab.prediction.past import past_commands, rows_before

IndexArray = NDArray[np.int64]

SMOOTHING_SPAN_S = 0.27
"""Span of the poses that the initial state of a window is estimated from: nine poses at 30 Hz."""
MIN_HISTORY_S = 0.6
"""Minimum time of a stretch before a window: six time constants of a usual (0.1 s) servo or motor."""
HISTORY_S = 1.2
"""Length of the commands and states before a window. Play in the steering, spinning wheels and slow tyres, servos and
motors depend on more than ``MIN_HISTORY_S``; before the stretch its first command and state were held."""
MIN_QUINTIC_WIDTH = 7
"""Minimum number of poses of the local quintic that is compared with the cubic."""
MAX_PERIOD_S = 0.034
"""Maximum period of a thinned recording [s]."""
MIN_SPEED_MPS = 0.15
"""Windows in which the car is slower [m/s] are omitted, because any model predicts a parked car."""
MAX_OFFSET_SHARE = 0.02
"""Maximum distance of rows to the grid, share of the period, up to which they are not interpolated."""
EVENT_COLUMN = "event"
"""Column of ``EpisodeData.extra`` that is 1 in rows of events (collisions); prediction windows do not contain them."""
BLOCK_S = 5.0
"""Length of a block [s]; windows that start in the same block count as dependent."""


@dataclass(frozen=True, slots=True)
class RecordingSegment:
    """An unbroken stretch of a recording on an even grid of n rows.

    Attributes:
        recording: index of the recording.
        period_s: period of the grid.
        t_s: (n,) time since the first row of the recording.
        states: (n, 6) x, y [m], yaw [rad], vx, vy [m/s], yaw rate [rad/s] as measured, yaw unwrapped.
        smooth: (n, 6) pose of a local cubic through the poses, and the body velocities of that cubic.
        commands: (n, 2) mean of the held steering and throttle over each cell of the grid.
        residual: (m, 6) states minus their local cubic while the car moves, at the period ``sampled_s``.
        speed: (m,) at the rows of ``residual`` [m/s].
        curvature_bias: (n, 6) states of a local quintic minus ``smooth``.
        sampled_s: period before thinning.
        in_event: (n,) whether a row, or a pose that its initial state is estimated from, is in an event.
        command_deviations: (n, R, 2) commands in R equal parts of each cell less their mean over the cell; None if they
            are constant in each cell.
        has_velocity_columns: whether the velocities of ``states`` were recorded, rather than differentiated poses.
    """

    recording: int
    period_s: float
    t_s: FloatArray
    states: FloatArray
    smooth: FloatArray
    commands: FloatArray
    residual: FloatArray
    speed: FloatArray
    curvature_bias: FloatArray
    sampled_s: float
    in_event: NDArray[np.bool_]
    command_deviations: FloatArray | None = None
    has_velocity_columns: bool = True

    @property
    def duration_s(self) -> float:
        """Rows times period."""
        return len(self.t_s) * self.period_s

    def part(self, rows: slice) -> RecordingSegment:
        """Select rows of the segment; ``residual`` and ``speed`` remain those of the whole segment."""
        return replace(
            self,
            t_s=self.t_s[rows],
            states=self.states[rows],
            smooth=self.smooth[rows],
            curvature_bias=self.curvature_bias[rows],
            commands=self.commands[rows],
            in_event=self.in_event[rows],
            command_deviations=None if self.command_deviations is None else self.command_deviations[rows],
        )


@dataclass(frozen=True, slots=True)
class PredictionWindows:
    """S prediction windows of K steps with H commands before them.

    Attributes:
        period_s: length of a step.
        initial_states: (S, 6) x, y [m], yaw [rad] in the recording's frame, vx, vy [m/s] in the body frame, yaw rate
            [rad/s]; other states have the same columns.
        past_commands: (S, H, 2) steering and throttle before the window (``carlab.prediction.past``); before the
            stretch its first ones.
        commands: (S, K, 2) steering and throttle in the window.
        measured: (S, K + 1, 6) states as recorded, yaw unwrapped.
        past_states: (S, H, 6) smoothed states before the window; before the stretch its first one.
        curvature_bias: (S, 6) initial state by a local quintic minus that by the local cubic.
        t0_s: (S,) start of the window since the first row of its recording.
        recording: (S,) index of the recording.
        block: (S,) index of the block of a few seconds; blocks count as independent.
        velocity_window_s2: variance [s2] of the window over which the recording's velocities were differentiated; 0
            if they are instantaneous.
        velocities_from_poses: whether the initial velocities are differentiated poses, not recorded velocities.
        command_deviations: (S, H + K, R, 2) commands in R equal parts of each step, before the window and in it, less
            their mean over the step; None if they are constant in each step.
        in_event: (S,) whether the window has rows of an event; only windows that are cut with events have such rows.
    """

    period_s: float
    initial_states: FloatArray
    past_commands: FloatArray
    commands: FloatArray
    measured: FloatArray
    past_states: FloatArray
    curvature_bias: FloatArray
    t0_s: FloatArray
    recording: IndexArray
    block: IndexArray
    in_event: NDArray[np.bool_]
    velocity_window_s2: float = 0.0
    velocities_from_poses: bool = True
    command_deviations: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.initial_states)

    @property
    def steps(self) -> int:
        """Steps K of each window."""
        return int(self.commands.shape[1])

    @property
    def horizon_s(self) -> float:
        """Length of each window."""
        return self.steps * self.period_s

    def part_commands(self, dtype: type[np.floating[Any]]) -> tuple[int, FloatArray]:
        """Number of parts R of a step, and the commands (2, (H + K) R, S) of the parts before the window and in it."""
        commands = np.concatenate([self.past_commands, self.commands], axis=1)[:, :, None]
        if self.command_deviations is not None:
            commands = commands + self.command_deviations
        count, steps, parts, channels = commands.shape
        return parts, np.ascontiguousarray(commands.reshape(count, steps * parts, channels).transpose(2, 1, 0), dtype)

    def deviations_in(self, steps: slice) -> FloatArray | None:
        """The command deviations in a part of the steps before the window and in it."""
        return None if self.command_deviations is None else self.command_deviations[:, steps]

    def take(self, which: NDArray[np.bool_] | IndexArray) -> Self:
        """Select windows by a mask (S,) or by indices (n,)."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        chosen: dict[str, Any] = {name: v[which] for name, v in values.items() if isinstance(v, np.ndarray)}
        return replace(self, **chosen)

    def split_at_events(self) -> tuple[Self, Self]:
        """Windows without and with rows of events. Raises DataError if all have some."""
        if self.in_event.all():
            raise DataError("Each prediction window has rows of an event (collision); keep events, or record again.")
        return self.take(~self.in_event), self.take(self.in_event)

    def thinned(self, max_windows: int) -> Self:
        """Select at most ``max_windows`` windows at even spacing."""
        if len(self) <= max_windows:
            return self
        return self.take(np.unique(np.linspace(0, len(self) - 1, max_windows).round().astype(np.int64)))


def segments_of(episodes: Sequence[EpisodeData], period_s: float | None = None) -> list[RecordingSegment]:
    """Resample recordings on an even grid, cut at gaps and missing values.

    Faster recordings are thinned to ``MAX_PERIOD_S`` after smoothing; commands become means over the cells, with their
    deviations in parts of the cells where these matter.

    Args:
        episodes: recordings; the column ``segment`` in ``extra`` numbers stretches that must not be joined, the column
            ``event`` marks rows of events.
        period_s: period of the grid; by default that of the first recording.

    Raises:
        DataError: a recording has fewer than two commands.
    """
    for index, episode in enumerate(episodes):
        if episode.ticks < 2:
            raise DataError(f"Recording {index + 1} has too few commands ({episode.ticks}); record at least 10 s.")
    if not episodes:
        return []
    row_periods_s = [row_period_s(episode.times_s, episode.period_s) for episode in episodes]
    if period_s is None:
        period_s = row_periods_s[0] * max(int(MAX_PERIOD_S / row_periods_s[0] + 1e-6), 1)
    every = [max(round(period_s / row_s), 1) for row_s in row_periods_s]
    parts = part_count(period_s, max(every))
    found = [
        segment
        for index, episode in enumerate(episodes)
        for rows in unbroken_rows(episode)
        if (segment := _segment(index, episode, rows, period_s / every[index], every[index], parts)) is not None
    ]
    deviations = [segment.command_deviations for segment in found if segment.command_deviations is not None]
    if all(np.abs(array).max(initial=0.0) < MIN_DEVIATION for array in deviations):
        return [replace(segment, command_deviations=None) for segment in found]
    return found


def unbroken_rows(episode: EpisodeData) -> Iterable[slice]:
    """Stretches of a recording without gaps, missing numbers and changes of the column ``segment``."""
    t = episode.times_s
    is_whole = np.asarray(np.isfinite(episode.states).all(axis=1))
    is_whole[:-1] &= np.isfinite(episode.sent).all(axis=1)
    broken = np.asarray(np.diff(t) > max(3.0 * episode.period_s, 0.1)) | ~(is_whole[1:] & is_whole[:-1])
    if "segment" in episode.extra:
        broken = broken | np.asarray(np.diff(episode.extra["segment"]) != 0)
    edges = [0, *(np.flatnonzero(broken) + 1), len(t)]
    for first, last in itertools.pairwise(edges):
        if last - first > 2:
            yield slice(int(first), int(last))


def _segment(
    index: int, episode: EpisodeData, rows: slice, period_s: float, every: int, parts: int
) -> RecordingSegment | None:
    t = episode.times_s[rows]
    states = episode.states[rows].copy()
    states[:, 2] = np.unwrap(states[:, 2])
    commands = np.vstack([episode.sent, episode.sent[-1:]])[rows]
    grid = even_grid(t, period_s)
    width = smoothing_width(period_s)
    if len(grid) < max(width, MIN_QUINTIC_WIDTH) + 2:
        return None
    if len(grid) != len(t) or np.abs(t - grid).max() > MAX_OFFSET_SHARE * period_s:
        states = np.stack([np.interp(grid, t, column) for column in states.T], axis=1)
        commands = cell_means(t, commands, grid, period_s)
    smooth = _smoothed(states, width, 3, period_s)
    speed = np.hypot(smooth[:, 3], smooth[:, 4])
    in_event = _event_rows(t, episode.extra.get(EVENT_COLUMN, np.zeros(len(episode.times_s)))[rows], grid)
    moving = speed > MIN_SPEED_MPS
    moving = moving if moving.sum() >= 20 else np.ones_like(moving)
    residual = (states - savgol_filter(states, width, 3, axis=0))[moving]
    speed = speed[moving]
    curvature_bias = _smoothed(states, max(width, MIN_QUINTIC_WIDTH), 5, period_s) - smooth
    whole = len(grid) // every * every
    deviations = part_deviations(grid, commands, grid[:whole:every], every * period_s, parts)
    if every > 1:
        commands = commands[:whole].reshape(-1, every, 2).mean(axis=1)
        grid, states, smooth, curvature_bias = (v[:whole:every] for v in (grid, states, smooth, curvature_bias))
        in_event = in_event[:whole:every]
    return RecordingSegment(
        recording=index,
        period_s=every * period_s,
        t_s=grid - episode.times_s[0],
        states=states,
        smooth=smooth,
        commands=commands,
        residual=residual,
        speed=speed,
        curvature_bias=curvature_bias,
        sampled_s=period_s,
        in_event=in_event,
        command_deviations=deviations,
        has_velocity_columns=episode.has_velocity_columns,
    )


def _event_rows(t: FloatArray, event: FloatArray, grid: FloatArray) -> NDArray[np.bool_]:
    """Rows of the grid with a marked row of ``t`` within half the span of the poses of an initial state."""
    marked = t[event > 0.0]
    if not len(marked):
        return np.zeros(len(grid), dtype=bool)
    index = np.searchsorted(marked, grid)
    after_s = np.append(marked, np.inf)[index] - grid
    before_s = grid - np.append(-np.inf, marked)[index]
    return np.asarray(np.minimum(after_s, before_s) <= 0.5 * SMOOTHING_SPAN_S)


def _smoothed(states: FloatArray, width: int, order: int, period_s: float) -> FloatArray:
    """Pose and body velocities (n, 6) by a local polynomial through the poses of (n, 6)."""
    pose = savgol_filter(states[:, :3], width, order, axis=0)
    return body_states(pose, savgol_filter(states[:, :3], width, order, deriv=1, delta=period_s, axis=0))


def body_states(pose: FloatArray, rate: FloatArray) -> FloatArray:
    """States (n, 6) of poses (n, 3) [m, m, rad] and their rates in the world (n, 3) [m/s, m/s, rad/s]."""
    return np.column_stack([pose, *to_body(rate[:, 0], rate[:, 1], pose[:, 2]), rate[:, 2]])


def smoothing_width(period_s: float) -> int:
    """Number of poses, odd and at least 5, that an initial state is estimated from."""
    return max(2 * round((SMOOTHING_SPAN_S / period_s - 1) / 2) + 1, 5)


def history_rows(period_s: float, seconds: float = HISTORY_S) -> int:
    """Number of rows in a time before a window."""
    return max(round(seconds / period_s), 1)


def _deviations(starts: Sequence[tuple[RecordingSegment, int]], past: int, steps: int) -> FloatArray | None:
    """Command deviations (S, H + K, R, 2) of windows that start at rows of segments; 0 before the stretch."""
    found = []
    for segment, row in starts:
        if segment.command_deviations is None:
            return None
        rows = np.arange(row - past, row + steps)
        found.append(segment.command_deviations[np.maximum(rows, 0)] * (rows >= 0)[:, None, None])
    return np.stack(found)


def cut_windows(
    segments: Sequence[RecordingSegment],
    horizon_s: float,
    stride_s: float,
    block_s: float = BLOCK_S,
    *,
    with_events: bool = False,
) -> PredictionWindows:
    """Cut segments into windows in which the car moves, without those with rows of events.

    Args:
        segments: all have the same period.
        horizon_s: length of a window.
        stride_s: time between the starts of windows.
        block_s: length of the blocks that count as independent.
        with_events: also cut windows with rows of events.

    Raises:
        DataError: no segment, or the car moves in no window.
    """
    if not segments:
        raise DataError("The recordings have no stretch without a gap that is long enough; record a longer drive.")
    period_s = segments[0].period_s
    steps = max(round(horizon_s / period_s), 1)
    stride = max(round(stride_s / period_s + 1e-3), 1)  # 0.25 s are eight rows at 30 Hz, also with jitter
    starts = [
        (segment, row)
        for segment in segments
        for row in range(history_rows(period_s, MIN_HISTORY_S), len(segment.t_s) - steps, stride)
        if np.hypot(*segment.smooth[row : row + steps + 1, 3:5].T).max() >= MIN_SPEED_MPS
        and (with_events or not segment.in_event[row : row + steps + 1].any())
    ]
    past, needed_s = history_rows(period_s), horizon_s + MIN_HISTORY_S
    if all(len(segment.t_s) <= history_rows(period_s, MIN_HISTORY_S) + steps for segment in segments):
        raise DataError(
            f"The longest stretch without a gap has {max(segment.duration_s for segment in segments):.1f} s; a "
            f"prediction needs {needed_s:.1f} s. Record a longer drive without gaps, or choose a shorter horizon."
        )
    if not starts:
        raise DataError(
            f"The car moves in no stretch of {needed_s:.1f} s; record a longer drive, or choose a shorter horizon."
        )
    return PredictionWindows(
        period_s=period_s,
        initial_states=np.stack([segment.smooth[row] for segment, row in starts]),
        past_commands=np.stack([past_commands(segment.commands, row, past) for segment, row in starts]),
        commands=np.stack([segment.commands[row : row + steps] for segment, row in starts]),
        measured=np.stack([segment.states[row : row + steps + 1] for segment, row in starts]),
        past_states=np.stack([rows_before(segment.smooth, row, past) for segment, row in starts]),
        curvature_bias=np.stack([segment.curvature_bias[row] for segment, row in starts]),
        t0_s=np.array([segment.t_s[row] for segment, row in starts]),
        recording=np.array([segment.recording for segment, _ in starts]),
        block=np.array([segment.recording * 1_000_000 + int(segment.t_s[row] / block_s) for segment, row in starts]),
        in_event=np.array([segment.in_event[row : row + steps + 1].any() for segment, row in starts]),
        command_deviations=_deviations(starts, past, steps),
    )


def split_segments(
    segments: Sequence[RecordingSegment], share: float, guard_s: float
) -> tuple[list[RecordingSegment], list[RecordingSegment]]:
    """Split each segment into its first part and its last ``share``, with a gap of ``guard_s`` between them.

    Parts that are not longer than the gap are omitted.
    """
    early, late = [], []
    guard = round(guard_s / segments[0].period_s) if segments else 0
    for segment in segments:
        cut_at = round((1.0 - share) * len(segment.t_s))
        early.append(segment.part(slice(0, max(cut_at - guard, 0))))
        late.append(segment.part(slice(cut_at, len(segment.t_s))))
    return [t for t in early if len(t.t_s) > guard], [t for t in late if len(t.t_s) > guard]
