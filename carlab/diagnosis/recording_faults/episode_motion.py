"""What the checks of recordings share: an episode under repair, its motion by the pose alone, and its commands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from carlab.core.episode_data import EpisodeData
from carlab.core.quantities import FloatArray
from carlab.diagnosis.findings import DataFault
from carlab.recording.audit.stamps import gap_rows, segments
from carlab.recording.pose_velocity import PoseMotion, pose_jumps, pose_motion

BoolArray = NDArray[np.bool_]


@dataclass(slots=True)
class Patient:
    """A recording under repair; ``faults`` says what was found and done.

    times_s (N,), states (N, 6), commands (N, 2) as sent, the last row's never executed; ``segment`` (N,) numbers
    unbroken stretches, ``rows`` (N,) are those of the recording that are left, ``mended`` (N,) those whose pose was
    interpolated. ``own_velocities`` is False where the velocities were only ever estimated from the pose.
    """

    episode: EpisodeData
    times_s: FloatArray
    states: FloatArray
    commands: FloatArray
    segment: FloatArray
    rows: NDArray[np.int64]
    mended: BoolArray
    own_velocities: bool
    faults: list[DataFault] = field(default_factory=list)
    touched: bool = False

    @classmethod
    def of(cls, episode: EpisodeData) -> Patient:
        """Take a recording in; its arrays are copied."""
        commands = np.vstack([episode.sent, episode.sent[-1:]])
        source = episode.metadata.get("velocity_source", "column")
        states = episode.states.copy()
        segment = segments(len(states), gap_rows(episode.times_s)) if episode.ticks > 1 else np.zeros(len(states))
        rows = np.arange(len(states))
        mended = np.zeros(len(states), dtype=bool)
        return cls(episode, episode.times_s.copy(), states, commands, segment, rows, mended, "column" in source)

    @property
    def period_s(self) -> float:
        """Median time from row to row [s]."""
        return float(np.median(np.diff(self.times_s)))

    @property
    def usable(self) -> bool:
        """Whether there is enough of it to check: 2 s of rows with numbers in them."""
        return len(self.times_s) >= 60 and bool(np.isfinite(self.states).all() and np.isfinite(self.commands).all())

    def motion(self) -> PoseMotion:
        """Motion by the pose alone."""
        x, y, yaw = self.states.T[:3]
        return pose_motion(self.times_s, x, y, yaw, self.segment)

    def cut_at_jumps(self) -> int:
        """Number the stretches anew, cut at gaps and where the pose jumps. Returns how many jumps."""
        gaps = gap_rows(self.times_s)
        jumps = np.setdiff1d(pose_jumps(self.times_s, *self.states.T[:3]), gaps)
        self.segment = segments(len(self.times_s), np.union1d(gaps, jumps))
        return len(jumps)

    def keep(self, rows: BoolArray) -> None:
        """Leave out all other rows (N,); what is missing shows as a gap, and the command before is held across it."""
        self.touched = True
        self.times_s, self.states, self.commands = self.times_s[rows], self.states[rows], self.commands[rows]
        self.segment, self.rows, self.mended = self.segment[rows], self.rows[rows], self.mended[rows]

    def found(self, identity: str, channel: str, rows: int, action: str) -> None:
        """Note a fault; ``action`` begins with repaired, reported or unusable."""
        self.faults.append(DataFault(identity, channel, int(rows), action))

    def retime(self, channel: int, later_s: FloatArray | float) -> None:
        """Take a command column from another moment: its value at t becomes that of t - ``later_s``."""
        self.touched = True
        begin = self.times_s - later_s
        self.commands[:, channel] = held_means(
            self.times_s, self.commands[:, channel], begin, np.append(np.diff(self.times_s), self.period_s)
        )

    def discharged(self) -> EpisodeData:
        """The recording as repaired; the very same one where nothing was touched."""
        if not self.touched:
            return self.episode
        if not self.own_velocities:
            motion = self.motion()
            self.states[:, 3:] = np.column_stack([motion.vx, motion.vy, motion.yaw_rate])
        extra = {name: column[self.rows] for name, column in self.episode.extra.items() if name != "segment"}
        if np.ptp(self.segment) > 0:
            extra["segment"] = self.segment
        poses = self.episode.poses
        if len(poses) == len(self.times_s):
            poses = np.column_stack([self.times_s, self.states[:, :3]])
        ticks = self.rows[:-1]
        return replace(
            self.episode,
            times_s=self.times_s,
            states=self.states,
            requested=self.episode.requested[ticks],
            sent=self.commands[:-1],
            rewards=self.episode.rewards[ticks],
            poses=poses,
            extra=extra,
        )


def held_means(t_s: FloatArray, held: FloatArray, begin_s: FloatArray, width_s: FloatArray | float) -> FloatArray:
    """Mean over [begin, begin + width) of a value (N,) that is held from each of ``t_s`` (N,) on."""
    integral = np.concatenate([[0.0], np.cumsum(held[:-1] * np.diff(t_s))])

    def upto(moments: FloatArray) -> FloatArray:
        row = np.clip(np.searchsorted(t_s, moments, side="right") - 1, 0, len(t_s) - 1)
        return np.asarray(integral[row] + (moments - t_s[row]) * held[row])

    width = np.broadcast_to(np.asarray(width_s, dtype=np.float64), begin_s.shape)
    return (upto(begin_s + width) - upto(begin_s)) / width


def lagged(values: FloatArray, period_s: float, time_constant_s: float) -> FloatArray:
    """A first-order lag over an even grid (N,), without a delay of its own (trapezoidal rule)."""
    if time_constant_s <= 0.0:
        return values
    ratio = 2.0 * time_constant_s / period_s
    gain, decay = 1.0 / (1.0 + ratio), (1.0 - ratio) / (1.0 + ratio)
    out, _ = lfilter([gain, gain], [1.0, decay], values, zi=[values[0] * (1.0 - gain)])
    return np.asarray(out)


def spread(values: FloatArray) -> float:
    """Robust standard deviation."""
    return 1.4826 * float(np.median(np.abs(values - np.median(values)))) if len(values) else 0.0


def merged(faults: Sequence[DataFault]) -> list[DataFault]:
    """One entry a fault, channel and kind of action: rows added up, the sentence of the one with the most rows."""
    groups: dict[tuple[str, str, str], list[DataFault]] = {}
    for fault in faults:
        groups.setdefault((fault.id, fault.channel, fault.action.split(":")[0]), []).append(fault)
    return [replace(max(group, key=lambda f: f.rows), rows=sum(f.rows for f in group)) for group in groups.values()]
