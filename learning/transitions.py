"""One-step transitions of a car, independent of its position and heading.

Position and heading enter the motion of a car only through exact kinematics. Therefore the inputs of a model are
body-frame velocities and the last commands. It predicts the change of the pose in the body frame at the step's start,
and the changes of the body-frame velocities, each in the body frame of its own time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from carlab.core.angles import wrap
from carlab.core.episode_data import EpisodeData
from carlab.core.errors import DataError
from carlab.core.planar import to_body
from carlab.core.quantities import FloatArray

OUTPUTS = ("ahead_m", "left_m", "yaw_rad", "vx_mps", "vy_mps", "yaw_rate_radps")
"""Changes over one step: of the position along the body axes at the step's start, of yaw, of the body-frame velocities
(each along the body axes of its own time), of yaw rate."""
MAX_STEP_PERIODS = 1.5
"""Maximum duration of a step; a longer step spans missing rows and is dropped."""
MAX_POSE_JITTER_PERIODS = 0.75
"""Maximum deviation of the time between two poses from its median."""
MIN_DELAY_S = 0.002
"""Smaller delays of the velocities count as zero."""
TRIMMING_ITERATIONS = 4
TRIMMED_QUANTILE = 0.9
"""Quantile of the absolute error above which rows are dropped from the least squares."""


@dataclass(frozen=True, slots=True)
class Transitions:
    """Rows for a one-step model.

    Attributes:
        inputs: (n, 3 + 2 (H + 1)): vx, vy [m/s], yaw rate [rad/s], then steering and throttle sent at t - H ... t,
            oldest first; the last two are sent at the step's start.
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

    @property
    def step_numbers(self) -> np.ndarray:
        """A number of each row (n,); numbers differ by 1 exactly between consecutive steps of an episode."""
        if not len(self):
            return self.tick
        numbers: np.ndarray = self.tick + self.episode * (int(self.tick.max()) + 2)
        return numbers

    def take(self, rows: np.ndarray) -> Transitions:
        """Some of the rows, by index (m,) or mask (n,)."""
        return Transitions(self.inputs[rows], self.targets[rows], self.episode[rows], self.tick[rows], self.history)


def transitions_of(episodes: Sequence[EpisodeData], history: int) -> Transitions:
    """Complete steps of episodes with ``history`` commands before the command at the step's start.

    Dropped are steps with a gap in time, missing numbers, or an incomplete history; steps over a jump of the poses
    (``segment`` of an imported recording changes); and steps whose poses are not one period apart, because one of them
    was not updated in time (``pose_age_s``).

    Args:
        episodes: recordings.
        history: H.

    Raises:
        DataError: no complete step, or a negative ``history``.
    """
    if history < 0:
        raise DataError(f"A history of {history} commands is negative; give 0 or more.")
    inputs, targets, origin, ticks = [], [], [], []
    for number, episode in enumerate(episodes):
        count = episode.ticks
        if count <= history:
            continue
        states = episode.states
        whole = whole_steps(episode)
        rows = np.arange(history, count)
        # Each command of the history must also have been held for one period.
        good = np.array([whole[k - history : k + 1].all() for k in rows], dtype=bool)
        past = np.stack([episode.sent[rows - back] for back in range(history, -1, -1)], axis=1)
        given = np.hstack([states[rows, 3:], past.reshape(len(rows), -1)])
        change = states[rows + 1] - states[rows]
        moved = np.stack([
            *to_body(change[:, 0], change[:, 1], states[rows, 2]),
            wrap(change[:, 2]),
            *change[:, 3:].T,
        ], axis=1)  # fmt: skip
        good &= (
            np.isfinite(given).all(axis=1) & np.isfinite(moved).all(axis=1) & _between_consecutive_poses(episode)[rows]
        )
        inputs.append(given[good])
        targets.append(moved[good])
        origin.append(np.full(int(good.sum()), number))
        ticks.append(rows[good])
    if not inputs or not sum(len(i) for i in inputs):
        raise DataError(
            f"The recordings hold no complete step with {history} commands before it; record longer episodes, or use "
            "a shorter history."
        )
    return Transitions(
        np.concatenate(inputs), np.concatenate(targets), np.concatenate(origin), np.concatenate(ticks), history
    )


def whole_steps(episode: EpisodeData) -> np.ndarray:
    """Mask (T,) of the steps that last about one period; the others span a gap in time."""
    steps_s = np.diff(episode.times_s)
    whole: np.ndarray = (steps_s > 0) & (steps_s < MAX_STEP_PERIODS * np.median(steps_s))
    return whole


def _between_consecutive_poses(episode: EpisodeData) -> np.ndarray:
    """Mask (T,) of the steps between two consecutive poses of motion capture."""
    valid = np.ones(episode.ticks, dtype=bool)
    if "segment" in episode.extra:
        valid &= np.diff(episode.extra["segment"]) == 0
    if "pose_age_s" in episode.extra:
        between = np.diff(episode.times_s - episode.extra["pose_age_s"])
        usual = np.nanmedian(between) if np.isfinite(between).any() else np.nan
        # Comparisons with NaN are false: steps of unknown age remain.
        valid &= ~(np.abs(between - usual) > MAX_POSE_JITTER_PERIODS * usual)
    return valid


def has_whole_step(episode: EpisodeData, history: int) -> bool:
    """Whether ``transitions_of`` finds a row in an episode."""
    try:
        return bool(len(transitions_of([episode], history)))
    except DataError:
        return False


def velocity_delay_s(rows: Transitions, period_s: float) -> float:
    """Delay of the velocities behind the poses [s]; about half a period for backward differences.

    A step's displacement is a weighted mean of the velocities at its ends; without a delay the weights are equal. The
    weight of the later velocity is fitted by trimmed least squares, so that collisions have no influence. A delay below
    ``MIN_DELAY_S`` is zero.

    Args:
        rows: transitions.
        period_s: their period [s].

    Raises:
        DataError: no rows.
    """
    if not len(rows):
        raise DataError("The delay of the velocities cannot be estimated without rows; record longer drives.")
    first, change = rows.inputs[:, [0, 2]], rows.targets[:, [3, 5]]
    excess = rows.targets[:, [0, 2]] / period_s - first
    weight, mask, square = np.full(2, 0.5), np.ones(excess.shape, dtype=bool), np.zeros(2)
    for _ in range(TRIMMING_ITERATIONS):
        square = (mask * change * change).sum(axis=0)
        weight = np.where(square > 0.0, (mask * excess * change).sum(axis=0) / np.maximum(square, 1e-12), 0.5)
        error = np.abs(excess - weight * change)
        mask = error <= np.quantile(error, TRIMMED_QUANTILE, axis=0)
    delay_s = float(np.clip(weight[square > 0.0].mean() - 0.5, 0.0, 1.0)) * period_s if square.any() else 0.0
    return delay_s if delay_s > MIN_DELAY_S else 0.0
