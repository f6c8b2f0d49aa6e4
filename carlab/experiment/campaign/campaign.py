"""The outer loop: fit the car, train a policy in the learned car, drive an episode, repeat.

Algorithm 2 of Rothfuss et al., arXiv 2403.16644. A run may be stopped at any time: its next step follows from the
files in its folder.

| finished recordings | models/000k, k = recordings + 1 | next step |
| --- | --- | --- |
| fewer than wanted | absent | train |
| fewer than wanted | present | drive |
| as many as wanted | | none |
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from carlab.cars import CarChoice
from carlab.core.documents import EpisodeEnded
from carlab.core.errors import ConfigError, DataError
from carlab.core.outcome import EndReason
from carlab.core.quantities import Reality
from carlab.core.safety import SafetyEnvelope
from carlab.core.state_estimator import StateEstimator
from carlab.experiment.campaign.figures import EpisodeFigures, figures_of
from carlab.experiment.campaign.quick_check import QuickCheck, check_path, run_check_subprocess
from carlab.experiment.campaign.training import (
    FIGURES_FILE,
    Progress,
    TrainingPlan,
    model_folder,
    plan_as_json,
    plan_from_json,
)
from carlab.experiment.campaign.training_process import train_in_subprocess
from carlab.experiment.episodes.session import EpisodeResult, Session, SessionHooks
from carlab.recording.mcap.source import read_documents
from carlab.recording.run_folder import RunDirectory
from learning.policy.sac_agent import SacAgent, SacSettings
from sim_backends.car_parameters import SimulatorConfig

CAMPAIGN_FILE = "campaign.json"
CONTINUING_ENDS = frozenset({EndReason.COMPLETED, EndReason.GOAL_REACHED, EndReason.GEOFENCE, EndReason.OVERSPEED})
"""Ends after which the next episode follows; an untrained policy may leave the arena."""
PAPER_HISTORY, MAX_HISTORY = 3, 8
STOPPED = frozenset({EndReason.STOP_REQUESTED, EndReason.LOOP_HUNG})
"""Ends after which the same episode is driven again."""
SPREAD = 0.3
"""Relative half-width of the prior range of a number for which the car file gives none."""
DRY_RUN = "--dry-run"
PERIOD_TOLERANCE = 0.02
"""Relative difference between control periods that counts as equal."""
UNCERTAIN = (
    *("vehicle.yaw_inertia", "tyre.front.B", "tyre.front.mu", "tyre.rear.B", "tyre.rear.mu"),
    *("motor.drive_gain", "motor.damping", "steering.max_angle"),
)
KINEMATIC_UNCERTAIN = ("motor.drive_gain", "motor.damping", "steering.max_angle")


def prior_simulator(car: SimulatorConfig, kind: Literal["kinematic", "nominal"]) -> SimulatorConfig:
    """Make the simulator that is the prior: the car's own (nominal), or one whose wheels do not slip (kinematic).

    Ranges are those of the car file. Where it has none, the parameters in ``UNCERTAIN`` have a range of ``SPREAD``
    about their values.

    Args:
        car: simulator of the car file.
        kind: tyre model of the prior.
    """
    values = car.values()
    if kind == "kinematic":
        spans = {n: car.priors.get(n, _about(values[n])) for n in KINEMATIC_UNCERTAIN}
        return replace(car, kind="kinematic", effects={}, priors=spans, parameter_std={})
    if car.priors or car.parameter_std:
        return car
    names = KINEMATIC_UNCERTAIN if car.kind == "kinematic" else UNCERTAIN
    return replace(car, priors={n: _about(values[n]) for n in names})


def needed_history(car: SimulatorConfig) -> int:
    """Number of past commands that affect the next measured state, from three to eight.

    It covers the command delay, the latency of motion capture and the window of the velocity estimate.
    """
    values = car.values()
    span_s = values["timing.command_delay"] + values["mocap.latency"] + StateEstimator().window_s
    return min(max(round(span_s / car.control_period_s), PAPER_HISTORY), MAX_HISTORY)


def _about(value: float) -> tuple[float, float]:
    return value * (1.0 - SPREAD), value * (1.0 + SPREAD)


def check_period(prior: SimulatorConfig, period_s: float, of: str) -> None:
    """Raise ConfigError where a prior's control period is not that of a car or its recordings (``of``)."""
    own = prior.control_period_s
    if abs(own - period_s) > PERIOD_TOLERANCE * period_s:
        raise ConfigError(
            f"The prior has a control_period of {own:.4g} s, {of} one of {period_s:.4g} s, and one step of the one is "
            "no step of the other; name a prior with the same control_period."
        )


@dataclass(slots=True)
class CampaignHooks:
    """Callbacks of a campaign."""

    session: SessionHooks = field(default_factory=SessionHooks)
    on_training: Progress = lambda what, done, total: None
    on_learned: Callable[[dict[str, Any]], None] = lambda figures: None
    on_figures: Callable[[EpisodeFigures], None] = lambda figures: None
    on_checking: Callable[[], None] = lambda: None
    on_check: Callable[[QuickCheck], None] = lambda check: None
    stop: Callable[[], bool] = lambda: False


@dataclass(slots=True)
class Campaign:
    """A run of ``carlab learn`` on an open car.

    ``questioned`` is the simulator of the quick check after each episode; that of the car's file unless given.
    ``car`` holds the command-line options that name the car.
    """

    choice: CarChoice
    plan: TrainingPlan
    episodes: int
    run: RunDirectory
    hooks: CampaignHooks = field(default_factory=CampaignHooks)
    max_ticks: int | None = None
    place: bool = True
    record_rerun: bool = True
    questioned: SimulatorConfig | None = None
    car: str = ""

    def write_plan(self) -> None:
        """Write the settings that resuming the run needs."""
        wanted: dict[str, Any] = {"episodes": self.episodes, "ticks": self.max_ticks}
        wanted |= {"place": self.place, "rerun": self.record_rerun, "car": self.car}
        if self.questioned is not None:
            wanted["questioned"] = self.questioned.to_tables()
        self.run.write_json(CAMPAIGN_FILE, {**wanted, "plan": plan_as_json(self.plan)})

    def go_on(self) -> Iterator[EpisodeResult]:
        """Train and drive until there are enough episodes; yields each result.

        Ends early on request, or after an episode whose end needs a person.

        Raises:
            DataError: training failed, or a recording could not be written.
        """
        self.set_aside_stopped_episode()
        self._check()
        while (done := len(self.run.recordings())) < self.episodes:
            folder = model_folder(self.run.models, done + 1)
            if not folder.is_dir():
                trained = train_in_subprocess(
                    self.plan,
                    self.run.models,
                    self.run.recordings(),
                    self._envelope,
                    self.hooks.on_training,
                    self.hooks.stop,
                )
                if trained is None:
                    return
                self.hooks.on_learned(trained)
            if self.hooks.stop():
                return
            result = self._drive(done + 1)
            if result is None or result.reason in STOPPED:
                self.set_aside_stopped_episode()
                return
            if result.reason is EndReason.RECORDER_ERROR:
                raise DataError(result.data.metadata["end_detail"])
            goes_on = self._may_go_on(result.reason)
            if goes_on and result.reason.is_safety_stop:
                self.choice.car.reset_fault()
            self.hooks.on_figures(figures_of(result, self._training(done + 1)))
            self._check()
            yield result
            if not goes_on:
                return

    def set_aside_stopped_episode(self) -> None:
        """Move the last recording to ``stopped`` where a person ended it or the loop hung; it is driven again."""
        recordings = self.run.recordings()
        if not recordings or model_folder(self.run.models, len(recordings) + 1).is_dir():
            return
        ends = [d.reason for d in read_documents(recordings[-1]) if isinstance(d, EpisodeEnded)]
        if STOPPED & set(ends):
            self.run.move_to_stopped(recordings[-1])

    def _check(self) -> None:
        """Run the quick check where the newest recording has none."""
        number = len(self.run.recordings())
        path = check_path(self.run, number)
        if not number or not path.parent.is_dir() or path.is_file() or self.hooks.stop():
            return
        self.hooks.on_checking()
        check = run_check_subprocess(self.run, self.questioned or self.choice.simulator, self.hooks.stop)
        if check is not None:
            self.hooks.on_check(check)

    def _may_go_on(self, reason: EndReason) -> bool:
        """Whether the next episode may follow; after a safety stop of a real car only where a person places the car."""
        asked = self.place or self.choice.car.reality is not Reality.REAL
        return reason in CONTINUING_ENDS and (asked or not reason.is_safety_stop)

    @property
    def _envelope(self) -> SafetyEnvelope:
        """The car's limits, in the arena of the task where the car has none of its own."""
        own = self.choice.envelope
        return own if own.arena_m else replace(own, arena_m=self.plan.task.arena_m)

    def _drive(self, number: int) -> EpisodeResult | None:
        agent = SacAgent.load(model_folder(self.run.models, number), SacSettings(), self.plan.seed)
        session = Session(
            self.choice.car,
            agent.policy(),
            self.plan.task,
            self._envelope,
            self.run,
            self.choice.control_period_s,
            seed=int(np.random.SeedSequence((self.plan.seed, number)).generate_state(1)[0]),
            max_ticks=self.max_ticks,
            config_toml=self.choice.config_toml,
            metadata={"model": str(number), "method": self.plan.method},
            hooks=self.hooks.session,
            place=self.place,
            record_rerun=self.record_rerun,
        )
        results = session.drive(1)
        return results[0] if results else None

    def _training(self, number: int) -> dict[str, Any]:
        path = model_folder(self.run.models, number) / FIGURES_FILE
        try:
            found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise DataError(f"{path} cannot be read ({error}); remove its folder, and it is learned anew.") from error
        return found


WIRES = ("hardware", "mocap")
"""Tables of a car file that describe its connections, not the car."""


def check_same_car(run: RunDirectory, choice: CarChoice, typed: str) -> None:
    """Raise ConfigError where a campaign was started with another car, other parameters of it, or another dry run.

    Args:
        run: folder of the campaign.
        choice: the car to go on with.
        typed: the command-line options that name the car.
    """
    try:
        content = json.loads((run.path / CAMPAIGN_FILE).read_text(encoding="utf-8"))
        was, now = run.config_toml, choice.config_toml
        numbers = [{k: v for k, v in tomllib.loads(text).items() if k not in WIRES} for text in (was, now)]
        before = str(content.get("car", typed))
    except (OSError, ValueError, AttributeError):
        return  # No campaign: ``resumed_campaign`` raises.
    kinds = [text.partition("\n")[0] for text in (was, now)]
    if kinds[0] == kinds[1] and numbers[0] == numbers[1] and (DRY_RUN in before) == (DRY_RUN in typed):
        return
    what = "other options" if before != typed else "other numbers in the car's file"
    raise ConfigError(
        f"{run.path} was started with {what}; go on with '{before.strip() or '--car sim'}' and what is in "
        f"{run.path / 'config.toml'}, or start a new run."
    )


def seed_of(folder: Path) -> int | None:
    """The seed of a run; None where the folder is no campaign, for which ``resumed_campaign`` raises."""
    try:
        return int(json.loads((folder / CAMPAIGN_FILE).read_text(encoding="utf-8"))["plan"]["seed"])
    except (OSError, ValueError, KeyError, TypeError):
        return None


def resumed_campaign(run: RunDirectory, choice: CarChoice, hooks: CampaignHooks, device: str | None = None) -> Campaign:
    """Resume a run with its own settings, or on another device. Raises DataError where it is no campaign."""
    path = run.path / CAMPAIGN_FILE
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        plan = plan_from_json(content["plan"])
        plan = plan if device is None else replace(plan, device=device)
        SimulatorConfig.from_tables(tomllib.loads(plan.prior_toml))
        ticks, tables = content["ticks"], content.get("questioned")
        questioned = None if tables is None else SimulatorConfig.from_tables(tables)
        return Campaign(
            choice, plan, int(content["episodes"]), run, hooks, None if ticks is None else int(ticks),
            bool(content["place"]), bool(content["rerun"]), questioned, str(content.get("car", "")),
        )  # fmt: skip
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(
            f"{run.path} is no run of carlab learn that can be resumed ({CAMPAIGN_FILE}: {error}); start a new "
            "run, or name the folder of one."
        ) from error


__all__ = [
    "CAMPAIGN_FILE",
    "Campaign",
    "CampaignHooks",
    "check_period",
    "check_same_car",
    "needed_history",
    "prior_simulator",
    "resumed_campaign",
    "seed_of",
]
