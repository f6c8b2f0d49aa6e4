"""A recording cut into shots: where they start, commands on the simulator's ticks, what was recorded at the ends."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from carlab.core.episode_data import EpisodeData
from carlab.core.quantities import FloatArray

BoolArray = NDArray[np.bool_]
IndexArray = NDArray[np.intp]

GRID_S = 0.0025
"""Irregular commands are averaged over cells of at most this length, a quarter of the longest integration step."""
GAP_PERIODS, GAP_S = 3.0, 0.1
"""A gap is longer than three median periods and than 0.1 s, as on import."""


class RecordedShots:
    """A recording prepared for shots: unwrapped yaw, unbroken stretches, the grid of the simulator's ticks.

    Args:
        episode: A recording of at least one command.
    """

    def __init__(self, episode: EpisodeData) -> None:
        self.times_s = episode.times_s
        self.ticks = episode.ticks
        self.commands = np.nan_to_num(episode.sent)
        self.period_s = episode.period_s
        self.states = episode.states.copy()
        self.whole: BoolArray = np.asarray(np.isfinite(self.states).all(axis=1))
        step = np.diff(self.times_s)
        broken: BoolArray = step > max(GAP_PERIODS * self.period_s, GAP_S)
        broken |= ~self.whole[1:] | ~self.whole[:-1]
        if "segment" in episode.extra:
            broken |= np.diff(episode.extra["segment"]) != 0
        self.stretch = np.concatenate([[0], np.cumsum(broken)])
        for number in np.unique(self.stretch):
            rows = self.stretch == number
            self.states[rows, 2] = np.unwrap(self.states[rows, 2])
        self.even = bool(np.abs(step - self.period_s).max() < 1e-3 * self.period_s)
        if self.even:
            self.grid_s = float(np.mean(step))
            self.note = (
                f"Even stamps: the simulator's ticks are the recording's rows, {self.grid_s * 1e3:.3f} ms apart."
            )
        else:
            self.grid_s = float(self.period_s / np.ceil(self.period_s / GRID_S))
            self.note = (
                f"Uneven stamps (median {self.period_s * 1e3:.2f} ms): held commands are averaged over cells of "
                f"{self.grid_s * 1e3:.2f} ms."
            )

    def starts(
        self, steps: int, stride_s: float, min_speed_mps: float
    ) -> tuple[IndexArray, IndexArray, dict[str, int]]:
        """Rows at which shots of ``steps`` ticks start, first rows not before their ends, how many were left out."""
        horizon_s = steps * self.grid_s
        moments = np.arange(self.times_s[0], self.times_s[-1] - horizon_s + 1e-6, stride_s)
        rows = np.unique(np.searchsorted(self.times_s, moments - 1e-6))
        if self.even:
            ends = rows + steps
        else:
            # Never the start's own row: the state there is interpolated from the row before.
            ends = np.maximum(rows + 1, np.searchsorted(self.times_s, self.times_s[rows] + horizon_s - 1e-9))
        inside = ends < len(self.times_s)
        rows, ends = rows[inside], ends[inside]
        unbroken = (self.stretch[rows] == self.stretch[ends]) & self.whole[rows]
        speed = np.hypot(self.states[:, 3], self.states[:, 4])
        fastest = np.array([np.max(speed[a : b + 1]) for a, b in zip(rows, ends, strict=True)])
        moving = fastest > min_speed_mps
        left_out = {
            "across a gap, a jump or a missing value": int(np.sum(~unbroken)),
            "without motion": int(np.sum(unbroken & ~moving)),
        }
        chosen = unbroken & moving
        return rows[chosen], ends[chosen], left_out

    def ends(self, starts: IndexArray, ends: IndexArray, horizon_s: float) -> FloatArray:
        """Recorded states (S, 6) at the end of each shot: a row where stamps are even, else linear between two."""
        if self.even:
            return self.states[ends]
        before, after = self.times_s[ends - 1], self.times_s[ends]
        share = ((self.times_s[starts] + horizon_s - before) / (after - before))[:, None]
        between: FloatArray = (1 - share) * self.states[ends - 1] + share * self.states[ends]
        return between

    def restarts(self, horizon_s: float) -> IndexArray:
        """Rows at which the overlay starts anew: every horizon, and at the start of each unbroken stretch."""
        rows: list[int] = []
        for k, t_s in enumerate(self.times_s):
            last = rows[-1] if rows else 0
            due = not rows or self.stretch[k] != self.stretch[last] or t_s >= self.times_s[last] + horizon_s - 1e-6
            if due and self.whole[k]:
                rows.append(k)
        return np.array(rows, dtype=np.intp)

    def held(self, rows: IndexArray, first: int, last: int) -> FloatArray:
        """Commands (len(rows), last - first, 2) on the ticks ``first`` to ``last``, counted from each row's stamp."""
        if self.even:
            index = rows[:, None] + np.arange(first, last)[None, :]
            whole: FloatArray = self.commands[np.clip(index, 0, self.ticks - 1)]
            return whole
        edges = self.times_s[rows][:, None] + self.grid_s * np.arange(first, last + 1)[None, :]
        integral = np.concatenate([np.zeros((1, 2)), np.cumsum(self.commands * np.diff(self.times_s)[:, None], axis=0)])
        total = np.stack([self._integral(edges, integral[:, c], c) for c in range(2)], axis=-1)
        averages: FloatArray = np.asarray((total[:, 1:] - total[:, :-1]) / self.grid_s)
        return averages

    def _integral(self, moments_s: FloatArray, integral: FloatArray, channel: int) -> FloatArray:
        inside: FloatArray = np.interp(moments_s, self.times_s, integral)
        before = np.minimum(moments_s - self.times_s[0], 0.0) * self.commands[0, channel]
        after = np.maximum(moments_s - self.times_s[-1], 0.0) * self.commands[-1, channel]
        total: FloatArray = inside + before + after
        return total

    def overlay(self, restarts: IndexArray, predicted: FloatArray, horizon_s: float) -> FloatArray:
        """Predicted states (T + 1, 6) at the recorded stamps; NaN in rows that are not whole."""
        overlay = np.full_like(self.states, np.nan)
        grid = self.grid_s * np.arange(predicted.shape[1])
        for shot, (a, b) in enumerate(pairwise(np.append(restarts, len(self.times_s)).tolist())):
            rows = np.arange(a, b)[(self.stretch[a:b] == self.stretch[a]) & self.whole[a:b]]
            ahead = self.times_s[rows] - self.times_s[a]
            near = ahead <= horizon_s + 1e-6
            for channel in range(6):
                overlay[rows[near], channel] = np.interp(ahead[near], grid, predicted[shot, :, channel])
        return overlay
