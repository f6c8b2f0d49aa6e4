"""Training between two episodes: fit the car to all recordings, then train a policy in the learned car.

The result (``models/0003`` in the run's folder) is written atomically.
"""

from __future__ import annotations

import json
import logging
import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from carlab.core.clock import MonotonicClock
from carlab.core.episode_data import EpisodeData
from carlab.core.errors import DataError, DivergedError
from carlab.core.observation import episode_features, feature_size
from carlab.core.quantities import FloatArray
from carlab.core.safety import SafetyEnvelope
from carlab.core.safety_bounds import SAFETY_BOUNDS
from carlab.core.state_estimator import StateEstimator
from carlab.core.task import reference_ticks
from carlab.core.toml_files import toml_tables
from carlab.experiment.campaign.figures_file import FIGURES_FILE, read_training_figures
from carlab.experiment.campaign.predicted_return import predicted_figures
from carlab.experiment.campaign.prior_correction_process import read_version
from carlab.experiment.campaign.training_plan import TrainingPlan
from carlab.prediction.learned import drive_windows, recorded_windows
from carlab.recording.episode_builder import VELOCITY_DELAY
from carlab.recording.mcap.source import has_ticks, read_episode
from carlab.recording.run_folder import RunDirectory
from carlab.recording.sink import describe_os_error
from learning.functional_svgd.authors_fsvgd import STEPS, fit_authors_fsvgd
from learning.policy.sac_agent import SacAgent, SacSettings
from learning.priors.simulator_model import CarModel, known_ranges
from learning.transitions import Transitions, has_whole_step, transitions_of
from learning.world.car_dynamics import CarDynamics
from learning.world.car_fit import PAPER_METHODS, CarFitSettings, LearnedCar, fit_car, load_car, save_car
from learning.world.history import find_history
from learning.world.model_env import ModelEnv
from learning.world.rollout_fit import RolloutFitSettings, fit_rollouts
from sim_backends.car_parameters import SimulatorConfig

log = logging.getLogger(__name__)

DYNAMICS_FILE = "dynamics.pt"
PRIOR_FILE = "prior.toml"
N_EVALUATION_CARS = 64
SUCCESS_BONUS, SUCCESS_SCORE = 0.3, 10.0
"""Reward for a tick of 1/30 s with success in the learned car, additional to the task's reward; and score of a policy
that always succeeds, additional to its return. The paper's reward decreases by only 2 % at 0.2 m from the goal."""
EXTRA_REACTION_S = 0.12
"""Additional reaction time of the learned car's safety gate: a margin of 0.24 m at 2 m/s to the gate of the car."""
EPISODES_BEFORE_HISTORY_CHOICE = 3
"""Number of episodes after which the number of relevant past commands is estimated."""
SMALLER_STEP_FACTOR = 0.25
"""Factor of the learning rate after a divergence."""
ROLLOUT_HORIZON_S, ROLLOUT_STRIDE_S = 1.0, 0.1
"""Length of the windows of the fit to rollouts, and time between their starts."""
MIN_ROLLOUT_WINDOWS = 8
"""Minimum number of windows for a fit to rollouts."""
ROLLOUT_UPDATE_SHARE = 0.06
"""Updates of the fit to rollouts, per step of the particles' optimiser: 150 by default, six seconds on one core. They
lower the position error after a second by a tenth (200 rows) to a half (1900 rows)."""
Progress = Callable[[str, int, int], None]
Learned = TypeVar("Learned")


def training_figures(run: RunDirectory, episode: int) -> dict[str, Any]:
    """Figures of the training before an episode, and the change of the prior before it.

    Raises:
        DataError: the file cannot be read, or a figure is missing or has another type.
    """
    folder = model_folder(run.models, episode)
    try:
        figures = read_training_figures(folder, episode)
    except DataError as error:
        raise DataError(f"In {folder}, {error}; remove the folder to train again.") from error
    version = read_version(run, episode - 1)
    return figures if version is None else {**figures, "prior_change": version.sentence}


def model_folder(models: Path, episode: int) -> Path:
    """Folder of the model and policy that were trained before an episode."""
    return models / f"{episode:04d}"


@dataclass(frozen=True, slots=True)
class TrainingRequest:
    """A training before the episode that follows the recordings.

    Attributes:
        plan: settings of the run.
        models: folder of the models, which receives the result.
        recordings: MCAP files of all episodes so far, in order.
        envelope: limits of the car's safety gate.
    """

    plan: TrainingPlan
    models: Path
    recordings: Sequence[Path]
    envelope: SafetyEnvelope

    @property
    def number(self) -> int:
        """Number of the episode after the training."""
        return len(self.recordings) + 1

    @property
    def folder(self) -> Path:
        """Folder of the result."""
        return model_folder(self.models, self.number)


def train(request: TrainingRequest, progress: Progress) -> dict[str, Any]:
    """Fit the car and train the policy.

    Args:
        request: settings and recordings.
        progress: called with the name of the stage, the steps done and the number of steps.

    Returns:
        Figures, which are also written to ``training.json`` of the result.

    Raises:
        DataError: a recording or the previous training cannot be read, the method needs more rows, or the result
            cannot be written.
        DivergedError: model or policy diverged twice.
    """
    plan, number = request.plan, request.number
    torch.set_num_threads(plan.threads)
    progress("reading the recordings", 0, 1)
    usable, newest = _usable_episodes(request.recordings, plan.history)
    earlier = model_folder(request.models, number - 1)
    earlier_car = load_car(earlier / DYNAMICS_FILE, plan.device) if earlier.is_dir() else None
    rows = transitions_of(usable, plan.history) if usable else None
    figures: dict[str, Any] = {"episode": number, "rows": 0 if rows is None else len(rows)}
    if earlier_car is not None and newest is not None:
        nll, calibration_error = earlier_car.score_episode(newest)
        figures |= {"last_episode_nll": nll, "last_episode_calibration_error": calibration_error}

    clock = MonotonicClock()
    began_s = clock.now_s()
    if number - 1 == EPISODES_BEFORE_HISTORY_CHOICE:
        progress("choosing the number of past commands", 0, 1)
        if (choice := find_history(usable)) is not None:
            figures |= {"supported_history": choice.history, "history_message": choice.message()}
    seed = plan.seed + 1000 * number
    same_inputs = earlier_car if earlier_car is not None and earlier_car.history == plan.history else None
    dynamics = _fitted(plan, _prior_model(plan, usable), usable, rows, same_inputs, seed, progress)
    figures["model_seconds"] = clock.now_s() - began_s

    began_s = clock.now_s()
    training, evaluation, driven = _environments(plan, dynamics, usable, request.envelope, seed)
    agent, policy_figures = _trained_policy(
        plan, training, evaluation, None if earlier_car is None else earlier, plan.updates_before(number), progress
    )
    figures |= {**policy_figures, "policy_seconds": clock.now_s() - began_s}
    figures |= predicted_figures(plan, agent, driven, usable, request.envelope, seed)

    def write(folder: Path) -> None:
        save_car(dynamics, folder / DYNAMICS_FILE)
        agent.save(folder)
        (folder / PRIOR_FILE).write_text(plan.prior_toml, encoding="utf-8")

    _publish(request.folder, figures, write)
    return figures


def _usable_episodes(recordings: Sequence[Path], history: int) -> tuple[list[EpisodeData], EpisodeData | None]:
    """Recorded episodes with at least one complete transition, and the newest recording if it is one of them."""
    episodes = [read_episode(path) if has_ticks(path) else None for path in recordings]
    usable = [e for e in episodes if e is not None and has_whole_step(e, history)]
    newest = usable[-1] if usable and usable[-1] is episodes[-1] else None
    return usable, newest


def _prior_model(plan: TrainingPlan, episodes: list[EpisodeData]) -> CarModel:
    """The prior simulator with the velocity delay of the recordings."""
    simulator = SimulatorConfig.from_tables(toml_tables(plan.prior_toml))
    return CarModel(simulator, plan.history, known_ranges(simulator), velocity_delay_s=velocity_delay_s(episodes))


def _environments(
    plan: TrainingPlan, dynamics: LearnedCar, episodes: list[EpisodeData], envelope: SafetyEnvelope, seed: int
) -> tuple[ModelEnv, ModelEnv, ModelEnv]:
    """Environments of the learned car for training, for evaluation, and with the safety gate of the driven car.

    Only the first one has a reward in addition to that of the task.
    """
    task = plan.task
    reaction_s = min(envelope.reaction_s + EXTRA_REACTION_S, SAFETY_BOUNDS.deadline.high)
    slow_gate = replace(envelope, reaction_s=reaction_s)
    common: dict[str, Any] = {"period_s": plan.control_period_s, "device": plan.device}
    recorded = recorded_features(episodes, plan.history) if episodes else None

    def bonus(features: Tensor) -> Tensor:
        value: Tensor = SUCCESS_BONUS * task.tick_weight * task.success(features).to(features)
        return value - task.cost_weight * task.cost(features) if task.has_constraint else value

    training = ModelEnv(
        dynamics, task, SacSettings().cars, recorded=recorded, bonus=bonus, envelope=slow_gate, seed=seed, **common
    )
    evaluation = ModelEnv(dynamics, task, N_EVALUATION_CARS, envelope=slow_gate, seed=seed + 1, **common)
    return training, evaluation, ModelEnv(dynamics, task, N_EVALUATION_CARS, envelope=envelope, seed=seed + 2, **common)


def _trained_policy(
    plan: TrainingPlan, training: ModelEnv, evaluation: ModelEnv, earlier: Path | None, updates: int, progress: Progress
) -> tuple[SacAgent, dict[str, Any]]:
    """Train a policy, starting from the previous one if its folder is given; returns the policy and its figures.

    The evaluation selects the best policy of the training.
    """
    task, sac = plan.task, SacSettings()
    sac = replace(sac, discount=sac.discount ** reference_ticks(plan.control_period_s))
    figures: dict[str, Any] = {}

    def evaluate(candidate: SacAgent) -> float:
        drives = evaluation.roll_out(candidate.act)
        success = SUCCESS_SCORE * task.success(drives.final).float().mean()
        return float((drives.returns - task.cost_weight * drives.costs).mean() + success)

    def trained(rate_factor: float) -> SacAgent:
        settings = replace(sac, learning_rate=rate_factor * sac.learning_rate)
        agent = SacAgent(settings, plan.seed, plan.device)
        if earlier is not None:
            agent = SacAgent.load(earlier, settings, plan.seed, plan.device)
            agent.widen(feature_size(plan.history))
        progress("learning to drive", 0, updates)
        figures.update(
            agent.train(training, updates, lambda done: progress("learning to drive", done, updates), evaluate)
        )
        return agent

    agent = _with_smaller_steps(trained, "policy")
    drives = evaluation.roll_out(agent.act)
    figures |= {"updates": updates, "return_in_model": float(drives.returns.mean())}
    figures |= {"cost_in_model": float(drives.costs.mean())} if task.has_constraint else {}
    return agent, figures | {"success_in_model": float(task.success(drives.final).float().mean())}


def _fitted(
    plan: TrainingPlan,
    model: CarModel,
    episodes: list[EpisodeData],
    rows: Transitions | None,
    before: LearnedCar | None,
    seed: int,
    progress: Progress,
) -> LearnedCar:
    """Fit the car by the method of the plan."""
    is_papers = plan.method in PAPER_METHODS
    steps = plan.model_steps or (STEPS if is_papers else CarFitSettings().steps)

    def report_step(done: int) -> None:
        progress("learning the car", done, steps)

    report_step(0)
    if is_papers:
        simulator = None if plan.method == "fsvgd" else model
        return fit_authors_fsvgd(
            episodes,
            plan.history,
            steps,
            seed,
            report_step,
            plan.device,
            simulator,
            plan.method == "sim-fsvgd-corrected",
        )
    settings = CarFitSettings(plan.method, steps, seed=seed, kind=plan.particles)
    earlier = before if isinstance(before, CarDynamics) else None

    def fitted(rate_factor: float) -> LearnedCar:
        scaled = replace(settings, learning_rate=rate_factor * settings.learning_rate)
        car = fit_car(rows, model, scaled, earlier=earlier, progress=report_step, device=plan.device)
        return _fitted_to_rollouts(car, episodes, rows, scaled, rate_factor, progress)

    return _with_smaller_steps(fitted, "model")


def _fitted_to_rollouts(
    car: CarDynamics,
    episodes: list[EpisodeData],
    rows: Transitions | None,
    settings: CarFitSettings,
    rate_factor: float,
    progress: Progress,
) -> CarDynamics:
    """Fit the car to rollouts over windows of the episodes; the same car if there are too few.

    The car was fitted to ``rows``, the transitions of the episodes, by ``settings``.
    """
    try:
        windows = drive_windows(recorded_windows(episodes, ROLLOUT_HORIZON_S, ROLLOUT_STRIDE_S), car.history)
    except DataError as error:
        log.debug("no fit to rollouts: %s", error)
        return car
    if rows is None or len(windows) < MIN_ROLLOUT_WINDOWS:
        return car
    default = RolloutFitSettings()
    updates = max(round(ROLLOUT_UPDATE_SHARE * settings.steps), 1)
    return fit_rollouts(
        car, windows, rows, replace(default, updates=updates, learning_rate=rate_factor * default.learning_rate),
        seed=settings.seed, progress=lambda done: progress("fitting the car to rollouts", done, updates),
    )  # fmt: skip


def _with_smaller_steps(learn: Callable[[float], Learned], what: str) -> Learned:
    """Call ``learn`` with a factor of 1 on the learning rate, after a divergence with ``SMALLER_STEP_FACTOR``.

    Raises:
        DivergedError: both diverged.
    """
    try:
        return learn(1.0)
    except DivergedError as error:
        log.warning("The %s diverged (%s); learning rate reduced by a factor %g.", what, error, SMALLER_STEP_FACTOR)
    try:
        return learn(SMALLER_STEP_FACTOR)
    except DivergedError as error:
        raise DivergedError(
            f"The {what} diverged twice, the second time with a smaller learning rate; the recordings remain. View "
            "the last recording (carlab replay) and remove it if it is implausible, or start a run with another "
            "--prior."
        ) from error


def velocity_delay_s(episodes: Sequence[EpisodeData]) -> float:
    """Median delay of measured velocities in recordings [s]; without any, that of the state estimator."""
    delays = [np.asarray(e.extra[VELOCITY_DELAY], dtype=np.float64) for e in episodes if VELOCITY_DELAY in e.extra]
    known = np.concatenate([d[np.isfinite(d)] for d in delays]) if delays else np.zeros(0)
    return float(np.median(known)) if len(known) else 0.5 * StateEstimator().window_s


def recorded_features(episodes: list[EpisodeData], history: int) -> FloatArray:
    """Features (R, 7 + 2 H) of recorded states with the H commands before each."""
    features = np.concatenate([episode_features(e.states, e.sent, history)[history : e.ticks] for e in episodes])
    finite: FloatArray = features[np.isfinite(features).all(axis=1)]
    return finite


def _publish(folder: Path, figures: dict[str, Any], write: Callable[[Path], None]) -> None:
    unfinished = folder.with_name(f"{folder.name}.partial")
    try:
        shutil.rmtree(unfinished, ignore_errors=True)
        unfinished.mkdir(parents=True)
        write(unfinished)
        (unfinished / FIGURES_FILE).write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
        os.replace(unfinished, folder)
    except OSError as error:
        shutil.rmtree(unfinished, ignore_errors=True)  # unfinished files would keep the disk full
        raise DataError(describe_os_error(error, folder)) from error
