"""The outer loop: fit the car, train a policy in the learned car, drive an episode, repeat.

Algorithm 2 of Rothfuss et al., arXiv 2403.16644. A run may be stopped at any time: the files in its folder determine
its next step.

| finished recordings | models/000k, k = recordings + 1 | next step |
| --- | --- | --- |
| fewer than the target | absent | train; with ``corrects_prior`` correct the prior before it, unless that is done |
| fewer than the target | present | drive |
| target reached | | none |
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np

from carlab.cars import CarChoice
from carlab.core.documents import EpisodeEnded
from carlab.core.errors import ConfigError, DataError
from carlab.core.json_files import read_json
from carlab.core.outcome import EndReason
from carlab.core.quantities import Reality
from carlab.core.safety import SafetyEnvelope
from carlab.core.seeds import MAX_SEED
from carlab.core.toml_files import toml_tables
from carlab.experiment.campaign.figures import figures_of
from carlab.experiment.campaign.hooks import LearnHooks
from carlab.experiment.campaign.policy_folders import observed_history, policy_folders
from carlab.experiment.campaign.prior_correction import PriorVersion, corrected, without_ranges
from carlab.experiment.campaign.prior_correction_process import (
    CorrectionRequest,
    correction_path,
    read_version,
    run_correction_subprocess,
)
from carlab.experiment.campaign.quick_check import check_path, run_check_subprocess
from carlab.experiment.campaign.training import TrainingRequest, model_folder, training_figures
from carlab.experiment.campaign.training_plan import TrainingPlan, plan_as_json, plan_from_json
from carlab.experiment.campaign.training_process import Trainer, train_in_subprocess
from carlab.experiment.episodes.result import EpisodeResult
from carlab.experiment.episodes.session import Session
from carlab.recording.mcap.source import has_ticks, read_documents
from carlab.recording.run_folder import RunDirectory
from learning.policy.sac_agent import SacAgent, SacSettings
from sim_backends.car_parameters import SimulatorConfig

T = TypeVar("T", int, bool)
CAMPAIGN_FILE = "campaign.json"
CONTINUE_REASONS = frozenset(
    {EndReason.COMPLETED, EndReason.GOAL_REACHED, EndReason.TASK_ENDED, EndReason.GEOFENCE, EndReason.OVERSPEED}
)
"""End reasons after which the run continues; an untrained policy may leave the arena."""
PAPER_HISTORY = 3
STOPPED = frozenset({EndReason.STOP_REQUESTED, EndReason.LOOP_HUNG})
"""End reasons after which the same episode is driven again, as after an end before the first tick."""
PRIOR_HALF_WIDTH = 0.3
"""Relative half-width of the prior range of a parameter without a range in the car file."""
DRY_RUN = "--dry-run"
PERIOD_TOLERANCE = 0.02
"""Relative difference between control periods that counts as equal."""
UNCERTAIN_PARAMETERS = (
    *("vehicle.yaw_inertia", "tyre.front.B", "tyre.front.mu", "tyre.rear.B", "tyre.rear.mu"),
    *("motor.drive_gain", "motor.damping", "steering.max_angle"),
)
KINEMATIC_PARAMETERS = ("motor.drive_gain", "motor.damping", "steering.max_angle")


def prior_simulator(car: SimulatorConfig, kind: Literal["kinematic", "nominal"]) -> SimulatorConfig:
    """Make the simulator of the prior: the car file's (nominal), or a kinematic one (no tyre slip).

    Ranges are those of the car file. Of the ``UNCERTAIN_PARAMETERS``, those without a range have one of
    ``PRIOR_HALF_WIDTH`` about their values. A file with standard deviations is the result of a diagnosis, whose other
    numbers are exact.
    """
    values = car.values()
    if kind == "kinematic":
        ranges = {n: car.priors.get(n, _range_about(values[n])) for n in KINEMATIC_PARAMETERS}
        return replace(car, kind="kinematic", effects={}, priors=ranges, parameter_std={})
    if car.parameter_std:
        return car
    names = KINEMATIC_PARAMETERS if car.kind == "kinematic" else UNCERTAIN_PARAMETERS
    added = {n: _range_about(values[n]) for n in names if n not in car.priors}
    return replace(car, priors={**car.priors, **added})


def _range_about(value: float) -> tuple[float, float]:
    return value * (1.0 - PRIOR_HALF_WIDTH), value * (1.0 + PRIOR_HALF_WIDTH)


def check_period(prior: SimulatorConfig, period_s: float, of: str) -> None:
    """Raise ConfigError if a prior's control period differs from that of a car or its recordings (``of``)."""
    prior_period_s = prior.control_period_s
    if abs(prior_period_s - period_s) > PERIOD_TOLERANCE * period_s:
        raise ConfigError(
            f"The control_period of the prior is {prior_period_s:.4g} s, that of {of} is {period_s:.4g} s; name a "
            "prior with the same control_period."
        )


@dataclass(slots=True)
class Campaign:
    """A run of ``carlab learn`` on an open car.

    ``checked_simulator`` is the simulator of the quick check after each episode; by default that of the car file.
    ``car`` holds the command-line options that select the car. With ``corrects_prior`` the prior is the car file's
    simulator with the corrections that ``correct`` finds between episodes, and the quick check tests this prior.
    ``trainer`` trains model and policy; by default a child process.
    """

    choice: CarChoice
    plan: TrainingPlan
    episodes: int
    run: RunDirectory
    hooks: LearnHooks = field(default_factory=LearnHooks)
    max_ticks: int | None = None
    place: bool = True
    record_rerun: bool = True
    checked_simulator: SimulatorConfig | None = None
    car: str = ""
    corrects_prior: bool = False
    correct: Callable[[CorrectionRequest, Callable[[], bool]], PriorVersion | None] = run_correction_subprocess
    trainer: Trainer | None = None
    stop: Callable[[], bool] = lambda: False

    def write_plan(self) -> None:
        """Write the settings that resuming the run needs."""
        settings: dict[str, Any] = {"episodes": self.episodes, "ticks": self.max_ticks}
        settings |= {"place": self.place, "rerun": self.record_rerun, "car": self.car}
        settings["repairs_prior"] = self.corrects_prior
        if self.checked_simulator is not None:
            settings["questioned"] = self.checked_simulator.to_tables()
        self.run.write_json(CAMPAIGN_FILE, {**settings, "plan": plan_as_json(self.plan)})

    def run_episodes(self) -> Iterator[EpisodeResult]:
        """Train and drive until the run has all its episodes; yields each result.

        Ends early on request, or after an episode whose end reason requires a person.

        Raises:
            DataError: training failed, or a recording could not be written.
        """
        self.move_stopped_episode()
        self._check()
        while (done := len(self.run.recordings())) < self.episodes:
            folder = model_folder(self.run.models, done + 1)
            if not folder.is_dir():
                if not self._correct_prior():
                    return
                plan = self.current_plan(done)
                request = TrainingRequest(plan, self.run.models, self.run.recordings(), self._envelope)
                trained = (self.trainer or train_in_subprocess)(request, self.hooks.on_training, self.stop)
                if trained is None:
                    return
                self.hooks.on_learned(trained)
            if self.stop():
                return
            training = training_figures(self.run, done + 1)
            result = self._drive(done + 1)
            if result is None or result.reason in STOPPED:
                self.move_stopped_episode()
                return
            if result.reason is EndReason.RECORDER_ERROR:
                raise DataError(result.data.metadata["end_detail"])
            continues = self._may_continue(result.reason)
            if continues and result.reason.is_safety_stop:
                self.choice.car.reset_fault()
            self.hooks.on_figures(figures_of(result, training, self.plan.task))
            self._check()
            yield result
            if not continues:
                self.move_stopped_episode()
                return

    def move_stopped_episode(self) -> None:
        """Move the last recording to ``stopped``; the episode is repeated.

        It is moved if a person ended it, the loop hung, or it has no complete tick, and no model was trained on it.
        """
        recordings = self.run.recordings()
        if not recordings or model_folder(self.run.models, len(recordings) + 1).is_dir():
            return
        ends = [d.reason for d in read_documents(recordings[-1]) if isinstance(d, EpisodeEnded)]
        if STOPPED & set(ends) or not has_ticks(recordings[-1]):
            self.run.move_to_stopped(recordings[-1])

    def _check(self) -> None:
        """Run the quick check of the newest recording, unless its result exists or the recording has no tick."""
        recordings = self.run.recordings()
        number = len(recordings)
        path = check_path(self.run, number)
        if not number or not path.parent.is_dir() or path.is_file() or not has_ticks(recordings[-1]):
            return
        if self.stop():
            return
        self.hooks.on_checking()
        simulator = self.checked_simulator or self.choice.simulator
        if self.corrects_prior:
            simulator = without_ranges(self._simulator(self._version(number - 1)))
        check = run_check_subprocess(self.run, simulator, self.stop)
        if check is not None:
            self.hooks.on_check(check)

    def current_plan(self, recordings: int) -> TrainingPlan:
        """The plan with the version of the prior after a number of recordings."""
        if not self.corrects_prior:
            return self.plan
        import tomli_w

        version = self._version(recordings)
        text = tomli_w.dumps(self._simulator(version).to_tables()) if version.corrections else self.plan.prior_toml
        return replace(self.plan, prior_toml=text, history=version.history)

    def _version(self, recordings: int) -> PriorVersion:
        """The newest version of the prior that used at most this number of recordings."""
        for number in range(recordings, 0, -1):
            if (version := read_version(self.run, number)) is not None:
                return version
        return PriorVersion(history=self.plan.history)

    def _simulator(self, version: PriorVersion) -> SimulatorConfig:
        initial = SimulatorConfig.from_tables(toml_tables(self.plan.prior_toml))
        return corrected(initial, version.corrections)

    def _correct_prior(self) -> bool:
        """Correct the prior after the newest episode, unless that is done; False if it was stopped."""
        number = len(self.run.recordings())
        path = correction_path(self.run, number)
        if not self.corrects_prior or not number or path.is_file() or not check_path(self.run, number).is_file():
            return not self.stop()
        self.hooks.on_correcting()
        request = CorrectionRequest(
            tuple(self.run.recordings()), self.plan.prior_toml, self._version(number - 1), path.parent
        )
        version = self.correct(request, self.stop)
        if version is not None:
            self.hooks.on_prior(version)
        return version is not None

    def _may_continue(self, reason: EndReason) -> bool:
        """Whether the run may continue; after a safety stop of a real car only if a person places the car."""
        is_placed = self.place or self.choice.car.reality is not Reality.REAL
        return reason in CONTINUE_REASONS and (is_placed or not reason.is_safety_stop)

    @property
    def _envelope(self) -> SafetyEnvelope:
        """The car's limits; the task's arena if the car has no arena."""
        return self.choice.envelope.with_default_arena(self.plan.task.arena_m)

    def _drive(self, number: int) -> EpisodeResult | None:
        agent = SacAgent.load(model_folder(self.run.models, number), SacSettings(), self.plan.seed)
        seed = int(np.random.SeedSequence((self.plan.seed, number)).generate_state(1)[0])
        self.choice.car.seed_noise(seed)
        session = Session(
            self.choice.car,
            agent.policy(),
            self.current_plan(number - 1).task,
            self._envelope,
            self.run,
            self.choice.control_period_s,
            seed=seed,
            max_ticks=self.max_ticks,
            config_toml=self.choice.config_toml,
            metadata={"model": str(number), "method": self.plan.method},
            hooks=self.hooks,
            place=self.place,
            record_rerun=self.record_rerun,
        )
        results = session.drive(1)
        return results[0] if results else None


CONNECTION_TABLES = ("hardware", "mocap")
"""Tables of a car file that describe its connections, not the car."""


def check_same_car(run: RunDirectory, choice: CarChoice, car_options: str) -> None:
    """Check that a campaign was started with the same car, its parameters and the same ``--dry-run``.

    ``car_options`` are the command-line options that select the car.

    Raises:
        ConfigError: it was started with another one.
        DataError: the folder's config.toml cannot be read.
    """
    try:
        saved_options = str(read_json(run.path / CAMPAIGN_FILE).get("car", car_options))
    except (OSError, ValueError):
        return  # No campaign: ``resumed_campaign`` raises.
    try:
        texts = (run.config_toml, choice.config_toml)
        tables = [{k: v for k, v in toml_tables(text).items() if k not in CONNECTION_TABLES} for text in texts]
    except (OSError, ValueError) as error:
        raise DataError(
            f"{run.path} cannot be resumed, because its car is unknown (config.toml: {error}); restore the file, or "
            "start a new run."
        ) from error
    kinds = [text.partition("\n")[0] for text in texts]
    if kinds[0] == kinds[1] and tables[0] == tables[1] and (DRY_RUN in saved_options) == (DRY_RUN in car_options):
        return
    difference = "other options" if saved_options != car_options else "other parameters in the car file"
    raise ConfigError(
        f"{run.path} was started with {difference}; resume it with '{saved_options.strip() or '--car sim'}' and the "
        f"parameters in {run.path / 'config.toml'}, or start a new run."
    )


def saved_seed(folder: Path) -> int | None:
    """The seed of a run; None if the folder is not a campaign (``resumed_campaign`` raises then)."""
    try:
        seed = int(read_json(folder / CAMPAIGN_FILE)["plan"]["seed"])
        return seed if 0 <= seed <= MAX_SEED else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def saved_plan(folder: Path) -> TrainingPlan:
    """The plan of a run, without the file of a user's task. Raises DataError if the folder is not a campaign."""
    try:
        plan = plan_from_json(read_json(folder / CAMPAIGN_FILE)["plan"])
        SimulatorConfig.from_tables(toml_tables(plan.prior_toml))
        return plan
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(
            f"{folder} is not the folder of a run of carlab learn ({CAMPAIGN_FILE}: {error}); restore the file, "
            "or name the folder of another run."
        ) from error


def resumed_campaign(run: RunDirectory, choice: CarChoice, device: str | None = None) -> Campaign:
    """Resume a run with its saved settings, optionally on another device.

    Raises:
        DataError: it is not a campaign, or its settings do not fit its newest policy.
    """
    path = run.path / CAMPAIGN_FILE
    try:
        content = read_json(path)
        plan = plan_from_json(content["plan"])
        plan = plan if device is None else replace(plan, device=device)
        SimulatorConfig.from_tables(toml_tables(plan.prior_toml))
        tables = content.get("questioned")
        checked_simulator = None if tables is None else SimulatorConfig.from_tables(tables)
        campaign = Campaign(
            choice, plan, _checked_value(content, "episodes", int), run, LearnHooks(),
            None if content["ticks"] is None else _checked_value(content, "ticks", int),
            _checked_value(content, "place", bool), _checked_value(content, "rerun", bool),
            checked_simulator, str(content.get("car", "")), bool(content.get("repairs_prior", False)),
        )  # fmt: skip
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(
            f"{run.path} cannot be resumed ({CAMPAIGN_FILE}: {error}); name the folder of a run of carlab learn, or "
            "start a new run."
        ) from error
    _check_history(campaign)
    return campaign


def _check_history(campaign: Campaign) -> None:
    """Raise DataError if the newest policy observes another number of past commands than the settings state."""
    folders = policy_folders(campaign.run.path)
    if not folders:
        return
    folder = folders[-1]
    history = campaign.current_plan(int(folder.name) - 1).history
    observed = observed_history(SacAgent.load(folder, SacSettings(), campaign.plan.seed))
    if observed != history:
        raise DataError(
            f"{campaign.run.path} cannot be resumed, because the policy in {folder} observes {observed} past commands "
            f"and {CAMPAIGN_FILE} states a history of {history}; restore the file, or start a new run."
        )


def _checked_value(content: Mapping[str, Any], name: str, kind: type[T]) -> T:
    """A value of a JSON object. Raises ValueError if it has another type or is below 1 (bool: no limit)."""
    value = content[name]
    if type(value) is not kind or (kind is int and value < 1):
        raise ValueError(f"{name} is {value!r}")
    return value
