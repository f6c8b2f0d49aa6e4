"""One-step transitions of a car, independent of where it is and which way it faces.

Position and heading enter the motion of a car only through exact kinematics, so a model sees body-frame velocities and
the last commands, and predicts the change of pose and velocities in the body frame of the step's start.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from carlab.core.angles import wrap
from carlab.core.episode_data import EpisodeData
from carlab.core.errors import DataError
from carlab.core.quantities import FloatArray

OUTPUTS = ("ahead_m", "left_m", "yaw_rad", "vx_mps", "vy_mps", "yaw_rate_radps")
"""Changes over one step: of place and velocities along the body axes of the step's start, of yaw, of the yaw rate."""
GAP = 1.5
"""A step longer than this many periods is no step."""
STALE = 0.75
"""Share of a period by which a step from pose to pose may be shorter or longer than the others."""

LEAST_LATE_S = 0.002
"""Velocities that lag by less are on time."""
TRIMMED = 4
KEPT = 0.9


@dataclass(frozen=True, slots=True)
class Transitions:
    """Rows for a model of one step.

    Attributes:
        inputs: (n, 3 + 2 (H + 1)): vx, vy [m/s], yaw rate [rad/s], then steering and throttle sent at t - H ... t, the
            oldest first; row by row the last two are those that were sent at the step's start.
        targets: (n, 6) in the order of ``OUTPUTS``.
        episode: number of each row's episode (n,).
        tick: number of each row's command in its episode (n,).
        history: H.
    """

    inputs: FloatArray
    targets: FloatArray
    episode: np.ndarray
    tick: np.ndarray
    history: int

    def __len__(self) -> int:
        return len(self.inputs)

    def take(self, rows: np.ndarray) -> Transitions:
        """Some of the rows, by index or mask."""
        return Transitions(self.inputs[rows], self.targets[rows], self.episode[rows], self.tick[rows], self.history)


def transitions_of(episodes: Sequence[EpisodeData], history: int) -> Transitions:
    """Every whole step of some episodes with ``history`` commands before the one at its start.

    Steps across a gap in time, with numbers missing, or whose history is cut off are left out. So are those across a
    jump of the poses (``segment`` of an imported recording changes there), and to or from a pose that was not renewed
    in time (``pose_age_s``): from pose to pose such a step is no period long.

    Raises:
        DataError: nothing is left, or ``history`` is negative.
    """
    if history < 0:
        raise DataError(f"A history of {history} commands makes no sense; give 0 or more.")
    inputs, targets, origin, ticks = [], [], [], []
    for number, episode in enumerate(episodes):
        count = episode.ticks
        if count <= history:
            continue
        states = episode.states
        steps = np.diff(episode.times_s)
        whole = (steps > 0) & (steps < GAP * np.median(steps))
        rows = np.arange(history, count)
        # Each command of the history must have been held for a period, too.
        good = np.array([whole[k - history : k + 1].all() for k in rows], dtype=bool)
        past = np.stack([episode.sent[rows - back] for back in range(history, -1, -1)], axis=1)
        given = np.hstack([states[rows, 3:], past.reshape(len(rows), -1)])
        change = states[rows + 1] - states[rows]
        sin, cos = np.sin(states[rows, 2]), np.cos(states[rows, 2])
        moved = np.stack([
            cos * change[:, 0] + sin * change[:, 1],
            cos * change[:, 1] - sin * change[:, 0],
            wrap(change[:, 2]),
            *change[:, 3:].T,
        ], axis=1)  # fmt: skip
        good &= np.isfinite(given).all(axis=1) & np.isfinite(moved).all(axis=1) & _as_seen(episode)[rows]
        inputs.append(given[good])
        targets.append(moved[good])
        origin.append(np.full(int(good.sum()), number))
        ticks.append(rows[good])
    if not inputs or not sum(len(i) for i in inputs):
        raise DataError(
            f"The recordings hold no whole step with {history} commands before it; record longer episodes, or use a "
            "shorter history."
        )
    return Transitions(
        np.concatenate(inputs), np.concatenate(targets), np.concatenate(origin), np.concatenate(ticks), history
    )


def _as_seen(episode: EpisodeData) -> np.ndarray:
    """Which steps (T,) lead from a pose to the next one as motion capture saw it go there."""
    seen = np.ones(episode.ticks, dtype=bool)
    if "segment" in episode.extra:
        seen &= np.diff(episode.extra["segment"]) == 0
    if "pose_age_s" in episode.extra:
        between = np.diff(episode.times_s - episode.extra["pose_age_s"])
        usual = np.nanmedian(between) if np.isfinite(between).any() else np.nan
        seen &= ~(np.abs(between - usual) > STALE * usual)  # Where no age is known nothing is held against a step.
    return seen


def has_whole_step(episode: EpisodeData, history: int) -> bool:
    """Whether ``transitions_of`` finds any row in an episode; a short one with a late stamp may have none."""
    try:
        return bool(len(transitions_of([episode], history)))
    except DataError:
        return False


def velocity_delay_s(rows: Transitions, period_s: float) -> float:
    """By how much the velocities of some rows lag behind their poses [s]; about half a period for backward differences.

    A step is as long as a mean of the velocities at both of its ends says, in equal parts where these are on time; the
    share of the later one is told by least squares, over the middle rows by error so that collisions have no say. Zero
    if it is less than ``LEAST_LATE_S``.

    Args:
        rows: rows.
        period_s: their period [s].

    Raises:
        DataError: there are no rows.
    """
    if not len(rows):
        raise DataError("No rows tell by how much velocities are late; record longer drives.")
    first, change = rows.inputs[:, [0, 2]], rows.targets[:, [3, 5]]
    off = rows.targets[:, [0, 2]] / period_s - first
    share, kept, told = np.full(2, 0.5), np.ones(off.shape, dtype=bool), np.zeros(2)
    for _ in range(TRIMMED):
        told = (kept * change * change).sum(axis=0)
        share = np.where(told > 0.0, (kept * off * change).sum(axis=0) / np.maximum(told, 1e-12), 0.5)
        error = np.abs(off - share * change)
        kept = error <= np.quantile(error, KEPT, axis=0)
    late_s = float(np.clip(share[told > 0.0].mean() - 0.5, 0.0, 1.0)) * period_s if told.any() else 0.0
    return late_s if late_s > LEAST_LATE_S else 0.0


__all__ = ["OUTPUTS", "Transitions", "has_whole_step", "transitions_of", "velocity_delay_s"]
