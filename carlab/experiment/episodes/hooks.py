"""Callbacks of a run. This module imports no heavy library."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from carlab.core.car import Car
from carlab.core.documents import Document, Tick
from carlab.core.errors import ConfigError
from carlab.core.outcome import EndReason
from carlab.core.quantities import CarState
from carlab.experiment.episodes.result import EpisodeResult


def _refuse_to_place(start: CarState) -> None:
    raise ConfigError(
        f"The car cannot move to x {start.x_m:.2f} m, y {start.y_m:.2f} m, yaw {start.yaw_rad:.2f} rad by itself; "
        "pass place=False to start at its current pose, or hooks with a place_by_hand that prompts a person."
    )


@dataclass(slots=True)
class RunHooks:
    """Callbacks while a car is driven; the defaults do nothing.

    Attributes:
        on_start: receives the run's folder and the car, before the car is opened.
        place_by_hand: receives a start pose that the car cannot reach by itself; returns when the car is there.
        on_episode: receives the number of a starting episode and its maximum number of ticks.
        on_tick: receives each tick.
        on_document: receives each document of the control loop; it must return at once.
        on_result: receives each finished episode.
        on_abandon: receives reason and detail after the control loop hung and the car was stopped; it may end the
            process. Otherwise, if the loop resumes, the episode ends with LOOP_HUNG, or SafetyStop is raised if the
            loop itself fails because the car is closed.
    """

    on_start: Callable[[Path, Car], None] = lambda folder, car: None
    place_by_hand: Callable[[CarState], None] = _refuse_to_place
    on_episode: Callable[[int, int], None] = lambda episode, ticks: None
    on_tick: Callable[[Tick], None] = lambda tick: None
    on_document: Callable[[Document], None] = lambda document: None
    on_result: Callable[[EpisodeResult], None] = lambda result: None
    on_abandon: Callable[[EndReason, str], None] = lambda reason, detail: None
