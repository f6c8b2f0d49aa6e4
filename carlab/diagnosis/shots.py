"""Recordings cut into shots: short stretches that a simulator is asked to predict from an estimated start.

The start of a shot is a local cubic through the poses about it (Savitzky and Golay 1964), not the noisy velocity
columns; the commands before it go along, so that delays and hidden states of servo and motor are right at its start.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_filter

from carlab.core.episode_data import EpisodeData
from carlab.core.errors import DataError
from carlab.core.quantities import FloatArray

IndexArray = NDArray[np.int64]

START_SPAN_S = 0.27
"""Poses that the start of a shot is estimated from: nine at 30 Hz."""
HISTORY_S = 0.6
QUINTIC_WIDTH = 7
"""Fewest poses under the quintic that the start is held against."""
COARSEST_S = 0.034
"""Longest period to which a faster recording is thinned."""
MIN_MOTION_MPS = 0.15


@dataclass(frozen=True, slots=True)
class Track:
    """One unbroken stretch of a recording on an even grid of ``period_s``.

    t_s        (n,)     since the first row of the recording
    states     (n, 6)   as measured, yaw unwrapped
    smooth     (n, 6)   local cubic through the poses: pose, and body velocities from it
    commands   (n, 2)   mean over each cell of the commands held as recorded
    residual   (m, 6)   what the local cubic leaves of the states while the car moves, at the recording's own period
    speed      (m,)     there
    bent       (n, 6)   what a quintic makes of ``smooth``, less ``smooth``
    sampled_s           that period
    """

    recording: int
    period_s: float
    t_s: FloatArray
    states: FloatArray
    smooth: FloatArray
    commands: FloatArray
    residual: FloatArray
    speed: FloatArray
    bent: FloatArray
    sampled_s: float


@dataclass(frozen=True, slots=True)
class Shots:
    """S shots of K steps with H commands of history.

    start (S, 6); history (S, H, 2); commands (S, K, 2); measured (S, K + 1, 6) with the yaw unwrapped; smooth states
    before the start (S, H, 6); bent (S, 6), by how much a quintic through the poses about it differs from the start;
    t0_s (S,); recording (S,) and block (S,), stretches of a few seconds that are treated
    as independent of one another; row (S,) into the recording's grid. ``smear_s2`` is the variance in time [s2] of the
    window by which the recording's velocities were differentiated, 0 where they are taken to be of the moment.
    """

    period_s: float
    start: FloatArray
    history: FloatArray
    commands: FloatArray
    measured: FloatArray
    before: FloatArray
    bent: FloatArray
    t0_s: FloatArray
    recording: IndexArray
    block: IndexArray
    row: IndexArray
    smear_s2: float = 0.0

    def __len__(self) -> int:
        return len(self.start)

    @property
    def steps(self) -> int:
        """Steps K of each shot."""
        return int(self.commands.shape[1])

    def take(self, which: NDArray[np.bool_] | IndexArray) -> Shots:
        """Some of the shots."""
        return Shots(
            self.period_s,
            self.start[which],
            self.history[which],
            self.commands[which],
            self.measured[which],
            self.before[which],
            self.bent[which],
            self.t0_s[which],
            self.recording[which],
            self.block[which],
            self.row[which],
            self.smear_s2,
        )


def tracks_of(episodes: Sequence[EpisodeData], period_s: float | None = None) -> list[Track]:
    """Put recordings onto an even grid, cut at gaps and where a value is missing.

    Recordings faster than ``COARSEST_S`` allows are thinned after smoothing: the dynamics of a car need no more, and
    commands go in as means over the cells.

    Args:
        episodes: recordings; the column ``segment`` in ``extra`` numbers stretches that must not be joined.
        period_s: grid; that of the first recording where None.

    Raises:
        DataError: a recording has no two rows.
    """
    found = []
    for index, episode in enumerate(episodes):
        if episode.ticks < 2:
            raise DataError(f"Recording {index + 1} has {episode.ticks} commands; record at least some seconds.")
        if period_s is None:
            period_s = episode.period_s * max(int(COARSEST_S / episode.period_s + 1e-6), 1)
        every = max(round(period_s / episode.period_s), 1)
        for rows in _unbroken(episode, episode.period_s):
            track = _track(index, episode, rows, period_s / every, every)
            if track is not None:
                found.append(track)
    return found


def _unbroken(episode: EpisodeData, period_s: float) -> Iterable[slice]:
    t = episode.times_s
    whole = np.asarray(np.isfinite(episode.states).all(axis=1))
    broken = np.asarray(np.diff(t) > max(3.0 * period_s, 0.1)) | ~(whole[1:] & whole[:-1])
    if "segment" in episode.extra:
        broken = broken | np.asarray(np.diff(episode.extra["segment"]) != 0)
    edges = [0, *(np.flatnonzero(broken) + 1), len(t)]
    for first, last in itertools.pairwise(edges):
        if last - first > 2:
            yield slice(int(first), int(last))


def _track(index: int, episode: EpisodeData, rows: slice, period_s: float, every: int) -> Track | None:
    t = episode.times_s[rows]
    states = episode.states[rows].copy()
    states[:, 2] = np.unwrap(states[:, 2])
    commands = np.vstack([episode.sent, episode.sent[-1:]])[rows]
    count = int(np.floor((t[-1] - t[0]) / period_s + 1e-6)) + 1
    grid = t[0] + period_s * np.arange(count)
    width = start_width(period_s)
    if count < max(width, QUINTIC_WIDTH) + 2:
        return None
    if np.abs(np.diff(t) - period_s).max() > 0.02 * period_s or count != len(t):
        states = np.stack([np.interp(grid, t, column) for column in states.T], axis=1)
        commands = _cell_means(t, commands, grid, period_s)
    smooth = _smoothed(states, width, 3, period_s)
    speed = np.hypot(smooth[:, 3], smooth[:, 4])
    moving = speed > MIN_MOTION_MPS
    moving = moving if moving.sum() >= 20 else np.ones_like(moving)
    residual = (states - savgol_filter(states, width, 3, axis=0))[moving]
    speed = speed[moving]
    bent = _smoothed(states, max(width, QUINTIC_WIDTH), 5, period_s) - smooth
    if every > 1:
        whole = len(grid) // every * every
        commands = commands[:whole].reshape(-1, every, 2).mean(axis=1)
        grid, states, smooth, bent = (rows[:whole:every] for rows in (grid, states, smooth, bent))
    begin_s = episode.times_s[0]
    return Track(index, every * period_s, grid - begin_s, states, smooth, commands, residual, speed, bent, period_s)


def _smoothed(states: FloatArray, width: int, order: int, period_s: float) -> FloatArray:
    """Pose and body velocities (n, 6) by a local polynomial through the poses of (n, 6)."""
    pose = savgol_filter(states[:, :3], width, order, axis=0)
    return body_states(pose, savgol_filter(states[:, :3], width, order, deriv=1, delta=period_s, axis=0))


def body_states(pose: FloatArray, rate: FloatArray) -> FloatArray:
    """States (n, 6) of poses (n, 3) and their rates in the world (n, 3)."""
    sin, cos = np.sin(pose[:, 2]), np.cos(pose[:, 2])
    forward, left = cos * rate[:, 0] + sin * rate[:, 1], cos * rate[:, 1] - sin * rate[:, 0]
    return np.column_stack([pose, forward, left, rate[:, 2]])


def _cell_means(t: FloatArray, held: FloatArray, grid: FloatArray, period_s: float) -> FloatArray:
    """Mean over [grid, grid + period) of values held from each t on."""
    integral = np.vstack([np.zeros(2), np.cumsum(held[:-1] * np.diff(t)[:, None], axis=0)])

    def upto(moments: FloatArray) -> FloatArray:
        inside = np.clip(moments, t[0], t[-1])
        index = np.clip(np.searchsorted(t, inside, side="right") - 1, 0, len(t) - 1)
        past = np.clip(moments - t[-1], 0.0, None)[:, None] * held[-1]
        return np.asarray(integral[index] + (inside - t[index])[:, None] * held[index] + past)

    return (upto(grid + period_s) - upto(grid)) / period_s


def start_width(period_s: float) -> int:
    """Number of poses, odd and at least 5, that the start of a shot is estimated from."""
    return max(2 * round((START_SPAN_S / period_s - 1) / 2) + 1, 5)


def cut(tracks: Sequence[Track], horizon_s: float, stride_s: float, block_s: float = 5.0) -> Shots:
    """Cut tracks into shots that move. Raises DataError where there is none."""
    period_s = tracks[0].period_s
    steps = max(round(horizon_s / period_s), 1)
    stride = max(round(stride_s / period_s), 1)
    past = max(round(HISTORY_S / period_s), 1)
    names = ("start", "history", "commands", "measured", "before", "bent")
    parts: dict[str, list[FloatArray]] = {name: [] for name in names}
    t0, recordings, blocks, rows = [], [], [], []
    for track in tracks:
        speed = np.hypot(track.smooth[:, 3], track.smooth[:, 4])
        for row in range(past, len(track.t_s) - steps, stride):
            if speed[row : row + steps + 1].max() < MIN_MOTION_MPS:
                continue
            parts["start"].append(track.smooth[row])
            parts["history"].append(track.commands[row - past : row])
            parts["commands"].append(track.commands[row : row + steps])
            parts["measured"].append(track.states[row : row + steps + 1])
            parts["before"].append(track.smooth[row - past : row])
            parts["bent"].append(track.bent[row])
            t0.append(track.t_s[row])
            recordings.append(track.recording)
            blocks.append(track.recording * 1_000_000 + int(track.t_s[row] / block_s))
            rows.append(row)
    if not t0:
        raise DataError(
            f"The recording holds no moving stretch of {horizon_s + HISTORY_S:.1f} s; record a longer drive."
        )
    return Shots(
        period_s=period_s,
        start=np.stack(parts["start"]),
        history=np.stack(parts["history"]),
        commands=np.stack(parts["commands"]),
        measured=np.stack(parts["measured"]),
        before=np.stack(parts["before"]),
        bent=np.stack(parts["bent"]),
        t0_s=np.array(t0),
        recording=np.array(recordings),
        block=np.array(blocks),
        row=np.array(rows),
    )
