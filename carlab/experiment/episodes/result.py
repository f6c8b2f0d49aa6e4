"""The result of an episode."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from carlab.core.episode_data import EpisodeData
from carlab.core.errors import ConfigError
from carlab.core.observation import episode_features
from carlab.core.outcome import EndReason
from carlab.core.task import Task


@dataclass(frozen=True, slots=True)
class EpisodeResult:
    """A completed episode.

    ``summary`` holds the task's figures; with a constraint also the sum of its cost, and the ticks with a cost.
    """

    episode: int
    data: EpisodeData
    reason: EndReason
    summary: Mapping[str, float]
    path: Path

    @property
    def total_reward(self) -> float:
        """Sum of rewards."""
        return float(np.sum(self.data.rewards))

    @property
    def has_recorded_ticks(self) -> bool:
        """Whether the recording exists and has a complete tick; the safety gate can end an episode before its first."""
        return self.data.ticks > 0 and self.path.exists()


def result_of(number: int, data: EpisodeData, task: Task, path: Path) -> EpisodeResult:
    """Result of a recorded episode; one without a complete tick has no success.

    Raises ConfigError if the task cannot evaluate it.
    """
    try:
        summary = {name: float(value) for name, value in task.summary(data.times_s, data.states).items()}
        if data.ticks == 0 and "success" in summary:  # the car may stand at the goal, but it was not driven there
            summary["success"] = 0.0
        if task.has_constraint:
            costs = np.asarray(task.cost(episode_features(data.states, data.sent, task.history_length)[1:]))
            summary |= {"cost": float(costs.sum()), "violations": float((costs > 0.0).sum())}
    except (Exception, SystemExit) as error:
        raise ConfigError(
            f"The task {task.name} cannot evaluate {path} ({type(error).__name__}: {error}); correct its summary and "
            "cost; the recording is complete."
        ) from error
    return EpisodeResult(number, data, EndReason[data.metadata["end_reason"]], summary, path)
