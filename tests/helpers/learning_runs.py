"""Short learning and driving runs for tests: a small training plan and recordings of straight drives."""

from __future__ import annotations

import shutil
import threading
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import tomli_w

from carlab.cars import CarChoice, choose_car
from carlab.core.policy import PolicyInput
from carlab.core.quantities import Action, CarState
from carlab.core.safety import SafetyEnvelope
from carlab.core.task import ParkingTask
from carlab.experiment.campaign.campaign import prior_simulator
from carlab.experiment.campaign.figures import EpisodeFigures
from carlab.experiment.campaign.training_plan import TrainingPlan
from carlab.experiment.episodes.result import EpisodeResult
from carlab.experiment.episodes.session import Session
from carlab.recording.run_folder import RunDirectory

HISTORY = 2
TICKS = 25
ENVELOPE = SafetyEnvelope(arena_m=ParkingTask().arena_m)


def tiny_plan(choice: CarChoice, **changes: Any) -> TrainingPlan:
    """Training plan with the kinematic prior, few steps and one thread."""
    text = tomli_w.dumps(prior_simulator(choice.simulator, "kinematic").to_tables())
    return replace(TrainingPlan(text, HISTORY, model_steps=60, updates=32, ticks=TICKS, threads=1), **changes)


def names(run: RunDirectory) -> list[str]:
    """Models and recordings of a run."""
    return sorted(str(p.relative_to(run.path)) for f in (run.models, run.episodes) for p in f.glob("*"))


def drive(folder: Path, ticks: int, start: CarState | None = None, episodes: int = 1) -> RunDirectory:
    """A run with recordings of ``ticks`` commands from the state ``start``."""

    class Forward:
        name = "forward"

        def reset(self) -> None: ...

        def act(self, view: PolicyInput) -> Action:
            return Action(0.0, 0.3)

    choice = choose_car("sim", seed=0)
    run = RunDirectory.create(folder, "short")
    with choice.car as car:
        car.place(CarState() if start is None else start)
        task = ParkingTask(history_length=HISTORY)
        Session(
            car, Forward(), task, ENVELOPE, run, choice.control_period_s, max_ticks=ticks, place=False,
            record_rerun=False,
        ).drive(episodes)  # fmt: skip
    return run


@dataclass
class InterruptedRun:
    """A run that was stopped before its first drive, killed in its second training, and resumed each time."""

    run: RunDirectory
    plan: TrainingPlan
    sent_actions: list[Action] = field(default_factory=list)
    results: list[EpisodeResult] = field(default_factory=list)
    figures: list[EpisodeFigures] = field(default_factory=list)
    files_after_stop: list[str] = field(default_factory=list)
    files_after_kill: list[str] = field(default_factory=list)
    error_text: str = ""
    first_model: bytes = b""

    def copied(self, folder: Path, *models: str, recordings: bool = False) -> RunDirectory:
        """A new run in ``folder`` with these models, and with the recordings, of this run."""
        run = RunDirectory.create(folder, "copied")
        for model in models:
            shutil.copytree(self.run.models / model, run.models / model)
        for recording in self.run.recordings() if recordings else ():
            shutil.copy(recording, run.episodes)
        return run


def log_sent_actions(choice: CarChoice) -> list[Action]:
    """A list that receives each action that the car reports as sent."""
    sent: list[Action] = []
    command = choice.car.command

    def logged(action: Action) -> Action:
        sent.append(command(action))
        return sent[-1]

    choice.car.command = logged  # type: ignore[method-assign]
    return sent


def small_plan(**changes: Any) -> TrainingPlan:
    """A plan whose training takes a second."""
    return tiny_plan(choose_car("sim"), model_steps=20, updates=8, **changes)


def hang(stream: object) -> None:
    """A viewer that does not answer; here, because the process of a live view imports it."""
    threading.Event().wait()
