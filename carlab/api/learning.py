"""Learning a task: fit a model of the car (the learned car), train a policy in it, drive, repeat."""

from __future__ import annotations

import contextlib
import hashlib
import platform
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from carlab.api.arguments import above_zero, at_least, at_most, valid_seed, whole_number
from carlab.api.learn_request import (
    AUTO,
    RAY_WAIT_S,
    Device,
    LearnRequest,
    Method,
    Particles,
    checked_simulator,
    learn_request,
    training_plan,
)
from carlab.api.runs import (
    check_learning_run,
    existing_run,
    followed_by,
    html_picture,
    html_table,
    learning_run,
    new_run,
    viewer_connection,
    write_result,
)
from carlab.api.tasks import check_trainable, given_task, load_checked
from carlab.core.errors import ConfigError
from carlab.core.outcome import EndReason
from carlab.core.task import Task
from carlab.core.ticks import MAX_TICKS
from carlab.core.version import VERSION
from carlab.experiment.campaign.hooks import LearnHooks
from carlab.experiment.cluster.settings import LinkSettings
from carlab.experiment.episodes.hooks import RunHooks
from carlab.experiment.episodes.interrupts import Interrupts, check_main_thread
from carlab.experiment.episodes.result import EpisodeResult

if TYPE_CHECKING:
    from carlab.cars import CarChoice, CarFile
    from carlab.experiment.campaign.campaign import Campaign
    from carlab.experiment.campaign.figures import EpisodeFigures
    from carlab.experiment.campaign.live_view import LiveView
    from carlab.experiment.campaign.quick_check import EpisodeCheck
    from carlab.experiment.cluster.trainer import ClusterTrainer
    from carlab.recording.run_folder import RunDirectory

EPISODES = 20
PLAN_ARGUMENTS = ("method", "particles", "history", "model_steps", "updates", "seed", "ticks")
"""Arguments that are part of the training plan of a run."""


@dataclass(frozen=True)
class LearnRun:
    """Result of ``carlab.learn``.

    Attributes:
        folder: the run's folder; ``carlab.learn(resume=folder)`` resumes the run.
        target_episodes: number of episodes of the complete run.
        episodes: figures of the episodes of this call: return, predicted return, success, constraint cost ...
        results: the same episodes with their data and end reasons.
    """

    folder: Path
    target_episodes: int
    episodes: tuple[EpisodeFigures, ...]
    results: tuple[EpisodeResult, ...]

    @property
    def recordings(self) -> list[Path]:
        """The finished MCAP files of the whole run."""
        from carlab.recording.run_folder import RunDirectory

        return RunDirectory(self.folder).recordings() if self.folder.is_dir() else []

    @property
    def is_complete(self) -> bool:
        """Whether the run has all its episodes."""
        return len(self.recordings) >= self.target_episodes

    @property
    def picture(self) -> Path:
        """Path of the picture of the learning curve."""
        return self.folder / "learn.png"

    @property
    def end(self) -> EndReason | None:
        """End reason of the last episode; None without episodes."""
        return self.results[-1].reason if self.results else None

    def __repr__(self) -> str:
        """One line: folder, number of episodes and their target number."""
        return f"<LearnRun {self.folder}: {len(self.recordings)} of {self.target_episodes} episodes>"

    def _repr_html_(self) -> str:
        rows = [
            [
                e.episode,
                e.total_reward,
                e.predicted_return,
                e.cost,
                e.outcome,
                "yes" if e.success else "no",
                e.end.lower(),
            ]
            for e in self.episodes
        ]
        columns = ["episode", "return", "predicted return", "constraint cost", "outcome", "success", "end"]
        return html_table(columns, rows) + html_picture(self.picture)


def learn(
    car: str | Path | CarFile = "sim", *, task: str | Task | None = None, track: Path | str | None = None,
    episodes: int | None = None, ticks: int | None = None, prior: str | Path | CarFile | None = None,
    method: Method | None = None, particles: Particles | None = None, history: int | None = None,
    model_steps: int | None = None, updates: int | None = None, seed: int | None = None, device: Device | None = None,
    place: bool | None = None, resume: Path | str | None = None, out: Path | str | None = None, name: str | None = None,
    rerun: bool | None = None, live: bool = False, viewer: str | None = None,
    vehicle: str | Path | CarFile | None = None, reality: str | Path | CarFile | None = None, dry_run: bool = False,
    ray: str = "", ray_wait: float = RAY_WAIT_S, hooks: RunHooks | None = None,
) -> LearnRun:  # fmt: skip
    """Fit a model of the car (the learned car), train a policy in it, drive an episode with the policy, and repeat.

    Args:
        car: as for ``carlab.drive``.
        task: as for ``carlab.drive``; by default that of the resumed run, else ``parking``.
        track: as for ``carlab.drive``.
        episodes: total number of episodes; by default 20, or the number of the resumed run.
        ticks: control periods (ticks) per episode, from ``history`` + 1 to a million; by default the task's number.
        prior: the prior simulator: ``nominal`` (the default), ``kinematic``, or a car file such as a diagnosed model.
            ``auto`` starts with the nominal one; between episodes, effects and parameters that the recordings support
            are added to it, and those that the recordings contradict are removed.
        method: ``gp-sim-posterior`` (the default): particles of a Gaussian-process posterior around the simulator
            (carlab's own method). ``gp-posterior``: the same without a simulator. ``sim-fsvgd``: the paper's, as in the
            authors' code; ``sim-fsvgd-corrected``: without its errors; ``fsvgd``: the paper's, without a simulator.
        particles: ``network`` (the default), or ``simulator``: networks that correct the steps of the prior simulator.
        history: number of past commands that model and policy observe. By default it covers the command delay, the
            latency of motion capture and the velocity window (4 for the simulated car; the paper's methods have 3).
            After three episodes a message states the number that the recordings support.
        model_steps: optimiser steps of the model before an episode: 2500; of the paper's methods at most 40 000.
        updates: gradient steps of SAC before an episode, 30 000 by default. Before the first episode the number is 1.5
            times as large; after the third it is multiplied by 3 / episode.
        seed: seed of all random numbers, 0 by default. The same seed gives the same run, except for a resumed run (its
            times have other rounding errors) and a run with the prior ``auto`` (its diagnoses have a time limit).
        device: device of the training: by default ``cpu``, or that of the resumed run. The policy drives on the CPU.
        place: start each episode at the task's start pose, at which a person places a real car (the default); otherwise
            at the car's current pose.
        resume: folder of a run to resume. The car must be the same; ``episodes``, ``device``, ``ray``, ``live`` and
            ``viewer`` may change, and all other arguments are those of the run.
        out: parent of the folder of a new run; ``runs`` by default.
        name: last part of the name of this folder; ``learn`` by default.
        rerun: also record .rrd files (the default).
        live: as for ``carlab.drive``.
        viewer: as for ``carlab.drive``.
        vehicle: as for ``carlab.drive``.
        reality: as for ``carlab.drive``.
        dry_run: as for ``carlab.drive``.
        ray: train on Ray: ``local``, or the address of a cluster; empty: a child process. The car stays here.
        ray_wait: time without an answer of the cluster after which a training runs on this computer [s].
        hooks: callbacks: ``carlab.LearnHooks``, or ``carlab.RunHooks``.

    Returns:
        The run; ``is_complete`` is False after an interruption or a safety stop.

    Raises:
        ConfigError, DataError: an argument is invalid or differs from the run to resume, or training failed.
        NotReadyError, ActuatorFaultError, PoseLostError: the car cannot be driven and has not moved.
    """
    given: dict[str, Any] = {name: value for name, value in locals().items() if value is not None and name != "hooks"}
    callbacks = {f.name: getattr(hooks, f.name) for f in fields(LearnHooks) if hasattr(hooks, f.name)}
    return _learn(learn_request(given), LearnHooks(**callbacks))


@dataclass(slots=True)
class _Progress:
    """Figures of the episodes so far."""

    run: RunDirectory
    hooks: LearnHooks
    rows: list[EpisodeFigures] = field(default_factory=list)

    def on_figures(self, row: EpisodeFigures) -> None:
        from carlab.experiment.campaign.report import save_row

        self.rows.append(row)
        save_row(self.run, row)
        self.hooks.on_figures(row)

    def on_check(self, check: EpisodeCheck) -> None:
        from carlab.experiment.campaign.report import save_check

        if self.rows and self.rows[-1].episode == check.episode:
            self.rows[-1] = self.rows[-1].with_check(check)
        save_check(self.run, check)
        self.hooks.on_check(check)


def _learn(request: LearnRequest, hooks: LearnHooks) -> LearnRun:
    from carlab.cars import choose_car
    from carlab.experiment.campaign.campaign import saved_seed
    from carlab.experiment.campaign.live_view import LiveSettings, LiveView
    from carlab.experiment.campaign.report import write_report

    _check(request)
    connect = viewer_connection(request.live, request.viewer)
    if request.resume is not None:
        check_learning_run(request.resume)
    started = None if request.resume is None else saved_seed(request.resume)
    choice = choose_car(
        request.car,
        vehicle=request.vehicle,
        reality=request.reality,
        dry_run=request.dry_run,
        seed=request.seed if started is None else started,
    )
    results: list[EpisodeResult] = []
    with contextlib.ExitStack() as signals, contextlib.ExitStack() as stack:
        campaign = (_begun if request.resume is None else _resumed)(request, choice, hooks, stack)
        if connect is not None:
            settings = LiveSettings(campaign.run.path, request.episodes or campaign.episodes, True, connect)
            hooks = _with_view(hooks, stack.enter_context(LiveView(settings)))
        if request.ray:
            campaign.trainer = stack.enter_context(_cluster_trainer(request, campaign, hooks))
        progress = _Progress(campaign.run, hooks)
        stack.enter_context(choice.car)
        campaign.hooks = replace(hooks, on_figures=progress.on_figures, on_check=progress.on_check)
        campaign.stop = signals.enter_context(Interrupts()).requested.is_set  # until the car is closed
        if request.resume is None:
            campaign.write_plan()
        elif request.episodes is not None and request.episodes != campaign.episodes:
            campaign.episodes = request.episodes
            campaign.write_plan()
        for result in campaign.run_episodes():
            results.append(result)
            write_report(campaign.run, campaign.plan, progress.rows[-1])
            write_result(campaign.run, results)
    return LearnRun(campaign.run.path, campaign.episodes, tuple(progress.rows), tuple(results))


def _cluster_trainer(request: LearnRequest, campaign: Campaign, hooks: LearnHooks) -> ClusterTrainer:
    """The trainer of ``ray``. Raises ConfigError if Ray is not installed, or the task cannot be sent."""
    from carlab.experiment.cluster.link_process import LinkProcess
    from carlab.experiment.cluster.order import check_task
    from carlab.experiment.cluster.trainer import ClusterTrainer
    from carlab.jobs.ray_executor import require_ray

    require_ray()
    check_task(campaign.plan)
    settings = LinkSettings(wait_s=request.ray_wait)
    run = hashlib.sha256(f"{platform.node()} {campaign.run.path.absolute()}".encode()).hexdigest()[:16]
    link = LinkProcess(request.ray, f"training {VERSION} {run}", campaign.plan.device)
    return ClusterTrainer(request.ray, link, hooks.on_link, settings)


def _with_view(hooks: LearnHooks, view: LiveView) -> LearnHooks:
    """Hooks that also pass everything to a live view."""
    return replace(
        hooks,
        on_document=followed_by(hooks.on_document, view.emit),
        on_training=followed_by(hooks.on_training, view.report_activity),
        on_figures=followed_by(hooks.on_figures, view.emit),
        on_check=followed_by(hooks.on_check, view.emit),
    )


def _check(request: LearnRequest) -> None:
    from carlab.experiment.campaign.prior_correction import LARGEST_GIVEN_HISTORY
    from learning.devices import available

    check_main_thread()
    counts = {name: getattr(request, name) for name in ("episodes", "updates", "ticks", "model_steps")}
    above_zero(**counts)
    whole_number(**counts)
    at_least(0, history=request.history)
    valid_seed(seed=request.seed)
    at_most(LARGEST_GIVEN_HISTORY, history=request.history)
    at_most(MAX_TICKS, ticks=request.ticks)
    above_zero(ray_wait=request.ray_wait)
    if not request.ray:
        available(request.device or "cpu")
    if request.method not in get_args(Method):
        raise ConfigError(f"--method {request.method}: choose one of {', '.join(get_args(Method))}.")
    if request.particles not in get_args(Particles):
        raise ConfigError(f"--particles {request.particles}: choose one of {', '.join(get_args(Particles))}.")
    if request.particles == "simulator" and request.method != "gp-sim-posterior":
        raise ConfigError(
            f"--particles simulator corrects the simulator of --method gp-sim-posterior; {request.method} has none."
        )
    if request.prior == AUTO and request.method != "gp-sim-posterior":
        raise ConfigError(
            f"--prior auto: its corrections are for --method gp-sim-posterior; {request.method} needs another --prior."
        )


def _begun(request: LearnRequest, choice: CarChoice, hooks: LearnHooks, stack: contextlib.ExitStack) -> Campaign:
    from carlab.experiment.campaign.campaign import Campaign

    plan = training_plan(request, choice)
    run = stack.enter_context(new_run(request.out, request.name, choice, hooks, keep="models"))
    return Campaign(
        choice, plan, request.episodes or EPISODES, run, hooks, request.ticks, request.place, request.rerun,
        checked_simulator(request), request.car_options, request.prior == AUTO,
    )  # fmt: skip


def _resumed(request: LearnRequest, choice: CarChoice, hooks: LearnHooks, stack: contextlib.ExitStack) -> Campaign:
    from carlab.experiment.campaign.campaign import check_same_car, resumed_campaign
    from carlab.experiment.campaign.report import learning_curve, restore_missing_rows, write_report
    from carlab.experiment.campaign.run_recording import warn_of_recovered_files
    from learning.devices import available

    assert request.resume is not None
    run = stack.enter_context(existing_run(request.resume, choice, hooks))
    check_same_car(run, choice, request.car_options)
    with learning_run(request.resume):
        campaign = resumed_campaign(run, choice, request.device)
    task_choice = campaign.plan.task_choice.named_again(given_task(request.task, request.track, choice.track))
    campaign.plan = replace(campaign.plan, task_choice=task_choice)
    load_checked(task_choice, choice.envelope.arena_m)
    check_trainable(task_choice)
    if not request.ray:
        available(campaign.plan.device)
    _check_as_before(request, campaign, choice)
    campaign.move_stopped_episode()
    warn_of_recovered_files(run, partial=False)
    if unreported := restore_missing_rows(run, campaign.plan.task):
        write_report(run, campaign.plan, learning_curve(run)[-1])
        write_result(run, unreported)
    return campaign


def _check_as_before(request: LearnRequest, campaign: Campaign, choice: CarChoice) -> None:
    """Raise ConfigError for a given argument that differs from the run to resume."""
    for name in ("out", "name"):
        if name in request.given:
            raise ConfigError(f"--{name}: a resumed run stays in its folder; remove the option.")
    plan = campaign.plan
    saved = {name: getattr(plan, name) for name in PLAN_ARGUMENTS}
    saved |= {"place": campaign.place, "rerun": campaign.record_rerun}
    for name, value in saved.items():
        if name in request.given and getattr(request, name) != value:
            start = "without it" if value is None else f"with {_option(name, value)}"
            raise ConfigError(
                f"{_option(name, getattr(request, name))}: this run was started {start}; remove the option, or start "
                "a new run."
            )
    is_same = campaign.corrects_prior == (request.prior == AUTO)
    if "prior" in request.given and not (is_same and training_plan(request, choice).prior_toml == plan.prior_toml):
        raise ConfigError("--prior: this run was started with another prior; remove the option, or start a new run.")


def _option(name: str, value: Any) -> str:
    """An argument as a command-line option."""
    if isinstance(value, bool):
        return f"--{name}" if value else f"--no-{name}"
    return f"--{name.replace('_', '-')} {value}"
