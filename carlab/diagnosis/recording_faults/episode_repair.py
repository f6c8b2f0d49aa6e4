"""An episode under repair: its arrays, the motion of its pose, and the faults found so far."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from carlab.core.episode_data import EpisodeData
from carlab.core.quantities import STATE_NAMES, FloatArray
from carlab.diagnosis.findings import DataFault
from carlab.diagnosis.state_alignment import STATE_AGE
from carlab.recording.column_mapping import COMMAND_CHANNELS
from carlab.recording.faults.fault import Fault
from carlab.recording.faults.robust import held_means
from carlab.recording.faults.stamps import gap_rows, segments
from carlab.recording.pose_velocity import BoolArray, PoseMotion, pose_jumps, pose_motion

MIN_ROWS = 60
"""Minimum number of rows of a recording to check: 2 s at 30 Hz."""


@dataclass(slots=True)
class EpisodeRepair:
    """A recording under repair.

    Attributes:
        episode: the recording before repair.
        times_s: stamps (N,).
        states: states (N, 6): x, y [m], yaw [rad], vx, vy [m/s], yaw rate [rad/s].
        commands: sent commands (N, 2), steering and throttle; that of the last row is not executed.
        segment: number of the unbroken stretch (N,).
        rows: indices (N,) of the remaining rows in the recording.
        interpolated: whether the pose of a row was interpolated (N,).
        has_velocity_columns: False if the velocities are estimated from the pose of the repaired rows.
        faults: faults found, with the action taken.
        is_changed: whether anything was repaired.
    """

    episode: EpisodeData
    times_s: FloatArray
    states: FloatArray
    commands: FloatArray
    segment: FloatArray
    rows: NDArray[np.int64]
    interpolated: BoolArray
    has_velocity_columns: bool
    faults: list[DataFault] = field(default_factory=list)
    is_changed: bool = False

    @classmethod
    def of(cls, episode: EpisodeData) -> EpisodeRepair:
        """Copy a recording's arrays."""
        commands = np.vstack([episode.sent, episode.sent[-1:]])
        states = episode.states.copy()
        segment = segments(len(states), gap_rows(episode.times_s)) if episode.ticks > 1 else np.zeros(len(states))
        rows = np.arange(len(states))
        interpolated = np.zeros(len(states), dtype=bool)
        has_columns = episode.has_velocity_columns
        return cls(episode, episode.times_s.copy(), states, commands, segment, rows, interpolated, has_columns)

    @property
    def period_s(self) -> float:
        """Median time from row to row [s]."""
        return float(np.median(np.diff(self.times_s)))

    @property
    def usable(self) -> bool:
        """Whether there are enough rows to check, with all numbers finite."""
        return len(self.times_s) >= MIN_ROWS and not _missing_numbers(self.episode)[self.rows].any()

    def motion(self, *, for_states: bool = False) -> PoseMotion:
        """Motion estimated from the pose; ``for_states`` as for ``pose_motion``."""
        x, y, yaw = self.states.T[:3]
        return pose_motion(self.times_s, x, y, yaw, self.segment, for_states=for_states)

    def set_velocities(self, motion: PoseMotion) -> None:
        """Replace the velocities by those of a motion."""
        self.states[:, 3:] = np.column_stack([motion.vx, motion.vy, motion.yaw_rate])

    def cut_at_jumps(self) -> int:
        """Split into segments at gaps and jumps of the pose. Returns the number of jumps."""
        gaps = gap_rows(self.times_s)
        jumps = np.setdiff1d(pose_jumps(self.times_s, *self.states.T[:3]), gaps)
        self.segment = segments(len(self.times_s), np.union1d(gaps, jumps))
        return len(jumps)

    def leave_out_incomplete_rows(self) -> None:
        """Remove rows with missing numbers if enough rows remain, and report them unless their frames are lost."""
        missing = _missing_numbers(self.episode)
        is_incomplete = np.asarray(missing.any(axis=1))
        if not is_incomplete.any():
            return
        if STATE_AGE not in self.episode.metadata:
            names = ("t", *STATE_NAMES, *COMMAND_CHANNELS)
            channels = ", ".join(name for name, column in zip(names, missing.T, strict=True) if column.any())
            action = "reported: rows with missing numbers are left out, and the recording is cut there."
            self.report("not_a_number", channels, is_incomplete.sum(), action)
        if len(is_incomplete) - is_incomplete.sum() >= MIN_ROWS:
            self.keep(~is_incomplete)

    def keep(self, rows: BoolArray) -> None:
        """Keep the rows of a mask (N,). The previous command is held across gaps."""
        self.is_changed = True
        self.times_s, self.states, self.commands = self.times_s[rows], self.states[rows], self.commands[rows]
        self.segment, self.rows, self.interpolated = self.segment[rows], self.rows[rows], self.interpolated[rows]

    def trim(self, count: int, *, at_end: bool) -> None:
        """Remove ``count`` rows at the end or at the beginning."""
        index = np.arange(len(self.times_s))
        self.keep(index < len(index) - count if at_end else index >= count)

    def report(self, identity: str, channel: str, rows: int, action: str) -> None:
        """Add a fault; ``action`` begins with repaired, reported or unusable."""
        self.faults.append(DataFault(identity, channel, int(rows), action))

    def repaired(self, fault: Fault, remedy: str, rows: int | None = None) -> None:
        """Add a repaired fault with its remedy and number of rows (by default all)."""
        self.is_changed = True
        count = len(self.times_s) if rows is None else rows
        self.report(fault.id, fault.channel, count, f"repaired: {fault.observation}; {remedy}.")

    def retime(self, channel: int, later_s: FloatArray | float) -> None:
        """Delay a command column: its value at t becomes that at t - ``later_s``.

        Args:
            channel: 0 for steering, 1 for throttle.
            later_s: delay [s]; one number, or one for each row (N,).
        """
        self.is_changed = True
        begin = self.times_s - later_s
        self.commands[:, channel] = held_means(
            self.times_s, self.commands[:, channel], begin, np.append(np.diff(self.times_s), self.period_s)
        )

    def result(self) -> EpisodeData:
        """The repaired recording; the same object if nothing was changed."""
        if not self.is_changed:
            return self.episode
        metadata = self.episode.metadata
        if not self.has_velocity_columns:
            self.set_velocities(motion := self.motion(for_states=True))
            metadata = {**metadata, "velocity_source": motion.method()}
        extra = {name: column[self.rows] for name, column in self.episode.extra.items() if name != "segment"}
        is_incomplete = _missing_numbers(self.episode).any(axis=1)
        segment = self.segment + np.cumsum(is_incomplete)[self.rows]
        if np.ptp(segment) > 0:
            extra["segment"] = segment
        poses = self.episode.poses
        if len(poses) == len(self.episode.times_s):
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
            metadata=metadata,
        )


def _missing_numbers(episode: EpisodeData) -> BoolArray:
    """Whether stamp, states and commands of each row are missing or infinite, shape (N, 9)."""
    commands = np.vstack([episode.sent, episode.sent[-1:]])
    return np.asarray(~np.isfinite(np.column_stack([episode.times_s, episode.states, commands])))


def merged(faults: Sequence[DataFault]) -> list[DataFault]:
    """Merge entries of equal fault, channel and kind of action: sum of the rows, text of the largest entry."""
    groups: dict[tuple[str, str, str], list[DataFault]] = {}
    for fault in faults:
        groups.setdefault((fault.id, fault.channel, fault.action.split(":")[0]), []).append(fault)
    return [replace(max(group, key=lambda f: f.rows), rows=sum(f.rows for f in group)) for group in groups.values()]
