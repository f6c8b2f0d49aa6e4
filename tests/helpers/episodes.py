"""Episodes at 30 Hz, by default of the parking task with the default limits of the safety gate."""

from __future__ import annotations

from typing import Any

from carlab.core.car import Car
from carlab.core.episode_data import EpisodeData
from carlab.core.policy import Policy
from carlab.core.safety import SafetyEnvelope
from carlab.core.task import ParkingTask, Task
from carlab.experiment.episodes.episode import run_episode

PERIOD_S = 1.0 / 30.0


def drive_episode(
    car: Car, policy: Policy, task: Task | None = None, envelope: SafetyEnvelope | None = None, **options: Any
) -> EpisodeData:
    """``run_episode`` with ``options``."""
    return run_episode(
        car, policy, ParkingTask() if task is None else task, envelope or SafetyEnvelope(), period_s=PERIOD_S, **options
    )
