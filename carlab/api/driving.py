"""Driving episodes on any car."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from carlab.api.arguments import above_zero, at_least, at_most, valid_seed
from carlab.api.drive_run import DriveRun, run_results
from carlab.api.recordings import Recording, load
from carlab.api.runs import (
    collecting,
    followed_by,
    has_screen,
    learning_run,
    new_run,
    viewer_connection,
)
from carlab.api.tasks import given_task, load_checked
from carlab.core.clock import Clock, MonotonicClock
from carlab.core.documents import Tick
from carlab.core.episode_data import EpisodeData
from carlab.core.errors import ConfigError, NotReadyError
from carlab.core.geofence import rectangle
from carlab.core.manoeuvres import MANOEUVRES
from carlab.core.policy import Policy
from carlab.core.quantities import CarState, Reality
from carlab.core.task import ParkingTask, RecordedTask, Task
from carlab.core.ticks import MAX_TICKS
from carlab.experiment.episodes.hooks import RunHooks
from carlab.experiment.episodes.interrupts import Interrupts, check_main_thread
from carlab.experiment.episodes.result import EpisodeResult
from carlab.experiment.episodes.teleop_policy import GamepadSource, KeyboardSource, TeleopPolicy

if TYPE_CHECKING:
    from rerun import RecordingStream

    from carlab.cars import CarChoice, CarFile
    from carlab.core.safety import SafetyEnvelope
    from carlab.core.task_choice import TaskChoice
    from carlab.experiment.campaign.live_view import LiveView
    from carlab.recording.run_folder import RunDirectory
    from sim_backends.car_parameters import SimulatorConfig

KEY_THROTTLE = 0.4
EXCITATION, EXCITATION_S = "excitation", 60.0
"""Name of the policy, and duration [s] of an episode with it."""


def drive(
    car: str | Path | CarFile = "sim", *, policy: str | Path | Policy = "parking", task: str | Task | None = None,
    track: Path | str | None = None, episodes: int = 1, ticks: int | None = None, seed: int = 0,
    max_throttle: float | None = None, place: bool = True, out: Path | str = Path("runs"), name: str = "drive",
    rerun: bool = True, picture: bool = True, live: bool = False, viewer: str | None = None,
    vehicle: str | Path | CarFile | None = None, reality: str | Path | CarFile | None = None, dry_run: bool = False,
    hooks: RunHooks | None = None,
) -> DriveRun:  # fmt: skip
    """Drive episodes with a policy on a car, and record them. ^C ends after the tick, a second ^C at once.

    Args:
        car: ``sim``, ``emulated`` (serial), ``emulated-can``, a preset (``eth_rc_car``, ``dart_jetracer`` ...:
            simulated), or a car file: a real car with ``[hardware]``, else a simulated car.
        policy: ``parking`` (feedback), ``excitation`` (random commands), a manoeuvre, ``neutral``, ``keyboard``,
            ``gamepad``, folder of a ``carlab.learn`` run or of its model, or a ``carlab.core.policy.Policy``.
        task: name, FILE.py:CLASS, or an object, see ``carlab.core.task.Task``; default: a learned policy's, or parking.
            Without it, a manoeuvre of a simulated or emulated car has no arena.
        track: CSV file for ``laps``: x, y (centre line in driving direction), width [m]; default: the car's, or an
            oval.
        episodes: number of episodes.
        ticks: control periods (ticks) per episode; by default the task's number (parking: 100 at 30 Hz), a whole
            manoeuvre, a minute of ``excitation``, or a million (the maximum) for ``keyboard`` and ``gamepad``.
        seed: seed of start poses, sensor noise and the commands of ``excitation``.
        max_throttle: upper limit of the throttle in the safety gate, in (0, 1].
        place: start each episode at the task's start pose; otherwise at the car's current pose.
        out: parent of the run's folder, whose result.json is written after each episode.
        name: last part of the run folder's name.
        rerun: also record .rrd files.
        picture: draw summary.png.
        live: open the rerun viewer, which follows the run. A slow viewer loses data; the car does not wait for it.
        viewer: address of an open rerun viewer that follows the run, on any computer: ``rerun+http://HOST:9876/proxy``.
        vehicle: car file with physics and motion capture of ``sim`` and ``emulated``, which replaces the default car.
        reality: car file with the true physics of a simulated or emulated car, unlike the file of ``car`` or
            ``vehicle``. Learning and diagnosis do not read it; they see the difference only in recordings.
        dry_run: measure and compute commands, but send none to the car.
        hooks: callbacks.

    Returns:
        The run; ``episodes`` is empty if it was interrupted before the first.

    Raises:
        ConfigError, DataError: an argument is invalid, a file cannot be written, or this is not the main thread.
        NotReadyError, ActuatorFaultError, PoseLostError: the car has not moved. SafetyStop: the control loop hung.
    """
    from carlab.cars import choose_car

    hooks = hooks or RunHooks()
    _check(policy, max_throttle, episodes=episodes, ticks=ticks, seed=seed)
    connect = viewer_connection(live, viewer)
    choice = choose_car(car, vehicle=vehicle, reality=reality, dry_run=dry_run, seed=seed)
    options = {"seed": seed, "max_ticks": ticks, "place": place, "record_rerun": rerun}
    driver, chosen_task = _policy_and_task(policy, task, track, choice)
    with new_run(out, name, choice, hooks) as run, contextlib.ExitStack() as stack:
        if connect is not None:
            view = stack.enter_context(_live_view(run, episodes, connect))
            hooks = replace(hooks, on_document=followed_by(hooks.on_document, view.emit))
        with run_results(run, picture) as results:
            _drive(choice, driver, chosen_task, max_throttle, run, episodes, collecting(hooks, run, results), options)
    return DriveRun(run.path, tuple(results))


def _live_view(run: RunDirectory, episodes: int, connect: Callable[[RecordingStream], None]) -> LiveView:
    """The view of a run in a rerun viewer; it loads torch."""
    from carlab.experiment.campaign.live_view import LiveSettings, LiveView

    return LiveView(LiveSettings(run.path, episodes, False, connect))


def replay(
    recording: Path | str | Recording | EpisodeData,
    car: str | Path | CarFile = "sim",
    *,
    seconds: float | None = None,
    seed: int = 0,
    out: Path | str = Path("runs"),
    vehicle: str | Path | CarFile | None = None,
    reality: str | Path | CarFile | None = None,
    dry_run: bool = False,
    hooks: RunHooks | None = None,
) -> tuple[EpisodeData, DriveRun]:
    """Put a car at the start of a recording, send the recorded actions at their times, and record the drive.

    Args:
        recording: an MCAP or CSV file, or a loaded recording, whose longest episode is replayed; or an episode.
        car: as for ``drive``. The arena of an emulated or simulated car extends 20 m beyond the recording by default.
        seconds: length of the first part of the recording that is driven [s]; by default the whole recording.
        seed: seed of the sensor noise.
        out: parent of the run's folder.
        vehicle: as for ``drive``.
        reality: as for ``drive``.
        dry_run: as for ``drive``.
        hooks: as for ``drive``.

    Returns:
        The recorded episode, and the run; its ``episodes`` are empty if it was interrupted before the first.

    Raises:
        ConfigError, DataError: an argument or the recording is invalid.
        NotReadyError, ActuatorFaultError, PoseLostError: the car cannot be driven and has not moved.
    """
    from carlab.cars import choose_car
    from carlab.experiment.episodes.scripted_policies import ReplayPolicy

    above_zero(seconds=seconds)
    valid_seed(seed=seed)
    # ``drive``, which is called below, checks the car and warns.
    choice = choose_car(car, vehicle=vehicle, reality=reality, dry_run=dry_run, seed=seed, is_driven=False)
    if isinstance(recording, EpisodeData):
        episode = recording
    else:
        episode = (recording if isinstance(recording, Recording) else load(recording)).episode
    run = drive(
        car,
        policy=ReplayPolicy(episode.times_s[:-1], episode.sent),
        task=_recorded_task(episode, choice, seconds),
        seed=seed,
        out=out,
        name="replay",
        picture=False,
        vehicle=vehicle,
        reality=reality,
        dry_run=dry_run,
        hooks=hooks,
    )
    return episode, run


def _recorded_task(episode: EpisodeData, choice: CarChoice, seconds: float | None) -> Task:
    duration_s = float(episode.times_s[-1] - episode.times_s[0])
    ticks = max(round(min(duration_s, seconds or duration_s) / choice.control_period_s), 1)
    x, y = episode.states[:, 0], episode.states[:, 1]
    is_real = choice.car.reality is Reality.REAL
    arena_m = () if is_real else rectangle(x.min() - 20, x.max() + 20, y.min() - 20, y.max() + 20)
    return RecordedTask(CarState.from_array(episode.states[0]), max_ticks=ticks, arena_m=arena_m)


def _drive(
    choice: CarChoice,
    policy: str | Policy,
    task: Task,
    max_throttle: float | None,
    run: RunDirectory,
    episodes: int,
    hooks: RunHooks,
    options: dict[str, Any],
) -> list[EpisodeResult]:
    """Open policy and car and drive the episodes; ``options`` go to ``Session``.

    From the first episode until the car is closed, a signal such as ^C interrupts nothing but the driving.
    """
    from carlab.experiment.episodes.session import Session

    envelope = _envelope(choice.envelope, task, max_throttle)
    driver, teleop = _policy(policy, max_throttle, choice.simulator, envelope, options["seed"])
    if options["max_ticks"] is None:
        options = {**options, "max_ticks": _ticks(policy, choice.control_period_s)}
    with contextlib.ExitStack() as signals, contextlib.ExitStack() as stack:
        if teleop is not None:
            hooks = _in_real_time(hooks, choice.car.clock)
            max_ticks = options["max_ticks"] or MAX_TICKS
            options = {**options, "max_ticks": max_ticks, "stop_reason": teleop.stop_reason}
            stack.enter_context(teleop)
        stack.enter_context(choice.car)
        signals.enter_context(Interrupts())
        session = Session(
            choice.car, driver, task, envelope, run, choice.control_period_s, config_toml=choice.config_toml,
            hooks=hooks, **options,
        )  # fmt: skip
        return session.drive(episodes)


def _ticks(policy: str | Policy, period_s: float) -> int | None:
    """Ticks of a manoeuvre or of excitation; None for other policies."""
    if policy == EXCITATION:
        return round(EXCITATION_S / period_s)
    if isinstance(policy, str) and policy in MANOEUVRES:
        # One tick more than the manoeuvre, so that the script ends the episode.
        return math.ceil(MANOEUVRES[policy]().duration_s / period_s) + 1
    return None


def _policy_names() -> tuple[str, ...]:
    return ("parking", EXCITATION, "neutral", "keyboard", "gamepad", *MANOEUVRES)


def _check(
    policy: str | Path | Policy, max_throttle: float | None, *, episodes: int, ticks: int | None, seed: int
) -> None:
    check_main_thread()
    at_least(1, episodes=episodes, ticks=ticks)
    at_most(MAX_TICKS, ticks=ticks)
    valid_seed(seed=seed)
    if isinstance(policy, (str, Path)) and str(policy) not in _policy_names() and not Path(policy).is_dir():
        if len(Path(policy).parts) > 1 and not Path(policy).exists():
            raise ConfigError(f"--policy {policy}: this folder does not exist; name the folder of a run.")
        raise ConfigError(
            f"--policy {policy}: choose one of {', '.join(_policy_names())}, or the folder of a run of carlab learn. A "
            "policy of your own is an object in a Python script: carlab.drive(policy=...), see examples/own_policy.py."
        )
    if not isinstance(policy, (str, Path)):
        _check_object(policy)
    if max_throttle is not None and not 0.0 < max_throttle <= 1.0:
        raise ConfigError(f"--max-throttle {max_throttle:g}: give a number above 0 and at most 1.")
    if policy == "keyboard" and not has_screen():
        raise NotReadyError("Keyboard", ["its window needs a screen, which is missing; use --policy gamepad."])


def _check_object(policy: Policy) -> None:
    """Raise ConfigError if an object is no policy; the message names what it lacks."""
    if isinstance(policy, type):
        raise ConfigError(f"--policy {policy.__name__}: it is a class; give an object of it, {policy.__name__}(...).")
    missing = [f"the method {name}" for name in ("act", "reset") if not callable(getattr(policy, name, None))]
    missing += [] if isinstance(getattr(policy, "name", None), str) else ["the attribute name (a string)"]
    if missing:
        raise ConfigError(
            f"--policy {policy!r}: give a name, the folder of a run, or an object like carlab.core.policy.Policy; "
            f"this one lacks {' and '.join(missing)}."
        )


def _policy_and_task(
    policy: str | Path | Policy, task: str | Task | None, track: Path | str | None, choice: CarChoice
) -> tuple[str | Policy, Task]:
    """The policy, which is read if it is a run's, and the task; that of the run by default."""
    from carlab.core.task_choice import PARKING

    given = given_task(task, track, choice.track)
    if isinstance(policy, (str, Path)) and str(policy) not in _policy_names():
        return _learned(Path(policy), given, choice)
    chosen = _task_to_drive(given or PARKING, choice)
    if policy == "parking" and not isinstance(chosen, ParkingTask):
        raise ConfigError(f"The parking policy only parks; choose another --policy for --task {chosen.name}.")
    policy = str(policy) if isinstance(policy, Path) else policy
    return policy, chosen if given is not None else _without_arena(policy, chosen, choice)


def _learned(folder: Path, given: TaskChoice | None, choice: CarChoice) -> tuple[Policy, Task]:
    """The policy of a run, and its task or a given one, with the policy's past actions and the run's ticks."""
    from carlab.experiment.campaign.campaign import PERIOD_TOLERANCE
    from carlab.experiment.campaign.learned_policy import load_policy

    with learning_run(folder.parent.parent if folder.parent.name == "models" else folder):
        learned = load_policy(folder)
    period_s, own = learned.plan.control_period_s, learned.plan.task_choice
    if abs(period_s - choice.control_period_s) > PERIOD_TOLERANCE * period_s:
        raise ConfigError(
            f"The policy in {folder} was trained with a control period of {period_s:.4g} s, the car has "
            f"{choice.control_period_s:.4g} s; choose a car with the same control_period."
        )
    chosen = own.named_again(given) if given is None or given.name == own.name else given
    task = _task_to_drive(chosen, choice)
    return learned.policy, task.resized(learned.history, learned.plan.ticks)


def _task_to_drive(chosen: TaskChoice, choice: CarChoice) -> Task:
    """The task, checked; not carlab's parking and a recorded task, because such a drive may start at another place."""
    task = chosen.load()
    is_unchecked = isinstance(task, RecordedTask) or (isinstance(task, ParkingTask) and not chosen.sha256)
    if not is_unchecked:
        load_checked(chosen, choice.envelope.arena_m)
    return task.at_period(choice.control_period_s)


def _without_arena(policy: str | Policy, task: Task, choice: CarChoice) -> Task:
    """The task without its arena for a manoeuvre of a car that cannot move, because most manoeuvres leave the arena."""
    is_manoeuvre = isinstance(policy, str) and policy in MANOEUVRES
    cannot_move = choice.car.reality in (Reality.SIMULATED, Reality.EMULATED)
    return replace(task, arena_m=()) if is_manoeuvre and cannot_move and isinstance(task, ParkingTask) else task


def _envelope(car_limits: SafetyEnvelope, task: Task, max_throttle: float | None) -> SafetyEnvelope:
    """The car's limits; the task's arena if the car has no arena."""
    limits = car_limits.with_default_arena(task.arena_m)
    return limits if max_throttle is None else replace(limits, max_throttle=max_throttle)


def _policy(
    policy: str | Policy, max_throttle: float | None, simulator: SimulatorConfig, envelope: SafetyEnvelope, seed: int
) -> tuple[Policy, TeleopPolicy | None]:
    """The policy, and the same object as a TeleopPolicy if a person drives (else None)."""
    from carlab.experiment.episodes.excitation_policy import ExcitationPolicy
    from carlab.experiment.episodes.scripted_policies import ManoeuvrePolicy, NeutralPolicy, ReverseParkingPolicy

    if not isinstance(policy, str):
        return policy, None
    if policy in ("keyboard", "gamepad"):
        # Full travel of a gamepad is the maximum throttle; a key gives KEY_THROTTLE, at most the maximum.
        maximum = max_throttle or 1.0
        source = KeyboardSource(min(KEY_THROTTLE / maximum, 1.0)) if policy == "keyboard" else GamepadSource()
        teleop = TeleopPolicy(source, maximum)
        return teleop, teleop
    if policy == "neutral":
        return NeutralPolicy(), None
    if policy == EXCITATION:
        return ExcitationPolicy(simulator, envelope, seed), None
    if policy == "parking":
        return ReverseParkingPolicy.for_car(simulator), None
    return ManoeuvrePolicy(MANOEUVRES[policy]()), None


def _in_real_time(hooks: RunHooks, clock: Clock) -> RunHooks:
    """Hooks with which a simulated car runs in real time, for teleoperation."""
    if isinstance(clock, MonotonicClock):
        return hooks
    wall = MonotonicClock()
    offset_s = [0.0]
    on_episode: Callable[[int, int], None] = hooks.on_episode
    on_tick: Callable[[Tick], None] = hooks.on_tick

    def begin(number: int, ticks: int) -> None:
        on_episode(number, ticks)
        offset_s[0] = wall.now_s() - clock.now_s()

    def wait(tick: Tick) -> None:
        on_tick(tick)
        wall.sleep_until(offset_s[0] + tick.t_s)

    return replace(hooks, on_episode=begin, on_tick=wait)
