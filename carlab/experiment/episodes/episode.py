"""The control loop of one episode. The car is in neutral at the end, whatever the end reason.

observe ──> encode ──> policy ──> SafeCar (the gate) ──> Car.command ──> wait for the next deadline ─┐
^                                                                                                 │
└──────────────── emit Tick, Transition to ``EpisodeHooks.emit`` (recorders) <────────────────────┘
"""

from __future__ import annotations

import contextlib
import json
import logging
import math
import numbers
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from carlab.core.car import Car
from carlab.core.clock import Pacer, TickTiming, wall_clock_ns
from carlab.core.documents import Document, EpisodeEnded, EpisodeStarted, HealthReading, Tick, Transition
from carlab.core.episode_data import EpisodeData
from carlab.core.errors import ActuatorFaultError, CarlabError, NotReadyError, PoseLostError
from carlab.core.keep_out import Corners
from carlab.core.observation import ActionHistory, encode
from carlab.core.outcome import EndReason
from carlab.core.policy import Policy, PolicyInput
from carlab.core.quantities import Action, FloatArray, Observation
from carlab.core.safety import SafeCar, SafetyEnvelope, SafetyState, SafetyStop
from carlab.core.task import Task

log = logging.getLogger(__name__)

FIRST_POSE_TIMEOUT_S = 2.0
HEALTH_PERIOD_S = 1.0
LATE_WINDOW_TICKS = 30


@dataclass(slots=True)
class EpisodeHooks:
    """Callbacks of an episode; the defaults do nothing.

    Attributes:
        emit: receives each document.
        stop_requested: reason to end the episode, or None; called before each tick.
        recorder_failed: error of the recording, or None; called before each tick.
        heartbeat: called with the name of the next stage before it begins.
    """

    emit: Callable[[Document], None] = lambda document: None
    stop_requested: Callable[[], EndReason | None] = lambda: None
    recorder_failed: Callable[[], str | None] = lambda: None
    heartbeat: Callable[[str], None] = lambda where: None


@dataclass(slots=True)
class _Rows:
    """The rows of a running episode, and the newest observation."""

    times_s: list[float] = field(default_factory=list)
    states: list[FloatArray] = field(default_factory=list)
    requested: list[FloatArray] = field(default_factory=list)
    sent: list[FloatArray] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)
    poses: list[tuple[float, float, float, float]] = field(default_factory=list)
    newest: Observation | None = None

    def add_observation(self, now_s: float, observation: Observation) -> None:
        self.times_s.append(now_s)
        self.states.append(observation.state.to_array())
        self.poses.extend((p.t_capture_s, p.x_m, p.y_m, p.yaw_rad) for p in observation.poses if p.tracked)

    def add_step(self, requested: Action, sent: Action, reward: float) -> None:
        self.requested.append(requested.to_array())
        self.sent.append(sent.to_array())
        self.rewards.append(reward)

    def finish(self, metadata: Mapping[str, str]) -> EpisodeData:
        ticks = len(self.rewards)
        return EpisodeData(
            times_s=np.array(self.times_s[: ticks + 1]),
            states=np.array(self.states[: ticks + 1]).reshape(-1, 6),
            requested=np.array(self.requested[:ticks]).reshape(-1, 2),
            sent=np.array(self.sent[:ticks]).reshape(-1, 2),
            rewards=np.array(self.rewards),
            poses=np.array(self.poses).reshape(-1, 4),
            metadata=metadata,
        )


class _LateTicks:
    """Detects a late loop: more than half of the last ticks started later than half a period."""

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._late: deque[bool] = deque(maxlen=LATE_WINDOW_TICKS)
        self._policy_s: deque[float] = deque(maxlen=LATE_WINDOW_TICKS)
        self._task_s: deque[float] = deque(maxlen=LATE_WINDOW_TICKS)

    def add(self, timing: TickTiming, policy_s: float, task_s: float) -> bool:
        """Add a tick with the computation times of policy and task [s]; whether the loop is late."""
        self._late.append(timing.late_s > 0.5 * self._period_s or timing.skipped > 0)
        self._policy_s.append(policy_s)
        self._task_s.append(task_s)
        return len(self._late) == LATE_WINDOW_TICKS and sum(self._late) > LATE_WINDOW_TICKS // 2

    def describe(self, skipped: int) -> str:
        """The number of skipped ticks, and the median computation times of policy and task."""
        policy_ms, task_ms = (1e3 * float(np.median(times)) for times in (self._policy_s, self._task_s))
        return (
            f"{skipped} ticks were skipped. A tick has {1e3 * self._period_s:.0f} ms; the median computation time of "
            f"the policy was {policy_ms:.1f} ms, that of the task's functions {task_ms:.1f} ms."
        )


class _End(Exception):
    """Ends the loop with a reason."""

    def __init__(self, reason: EndReason, detail: str = "") -> None:
        self.reason, self.detail = reason, detail
        super().__init__(reason.name)


def first_observation(car: Car, heartbeat: Callable[[str], None] = lambda where: None) -> Observation:
    """Wait for the first pose with a valid velocity. Raises PoseLostError after two seconds of the car's clock."""
    deadline_s = car.clock.now_s() + FIRST_POSE_TIMEOUT_S
    while True:
        heartbeat("waiting for the first pose")
        try:
            observation = car.observe()
            if observation.tracked and observation.velocity_valid:
                return observation
        except PoseLostError:
            if car.clock.now_s() > deadline_s:
                raise
        else:
            if car.clock.now_s() > deadline_s:
                if observation.tracked:
                    raise PoseLostError(
                        "The frame rate of motion capture is too low to estimate the car's velocity; raise it."
                    )
                remedy = " ".join(car.pose_problems()) or "check its markers and the volume."
                raise PoseLostError(f"Motion capture runs but does not see the car; {remedy}")
        car.clock.sleep_until(car.clock.now_s() + 0.01)


def run_episode(
    car: Car,
    policy: Policy,
    task: Task,
    envelope: SafetyEnvelope,
    *,
    period_s: float,
    max_ticks: int | None = None,
    hooks: EpisodeHooks | None = None,
    episode: int = 1,
    seed: int = 0,
    config_toml: str = "",
    metadata: Mapping[str, str] | None = None,
) -> EpisodeData:
    """Drive one episode on an open car and return it as arrays.

    Args:
        car: an open car. The episode arms it, and finally stops and disarms it.
        policy: called at each tick; None from ``act`` ends the episode.
        task: reward, termination, goal and length of the action history.
        envelope: limits of the safety gate.
        period_s: control period [s].
        max_ticks: ticks to drive; None: the task's number.
        hooks: callbacks that receive documents and may stop the episode.
        episode: number of this episode, from 1.
        seed: written into the recording.
        config_toml: configuration as text, written into the recording.
        metadata: further texts for the recording.

    Returns:
        The episode, complete or ended early; ``metadata`` has ``end_reason``, ``end_sentence`` and ``end_detail``.

    Raises:
        NotReadyError, ActuatorFaultError, PoseLostError: the car has not moved. Other errors: it was stopped.
    """
    hooks = hooks or EpisodeHooks()
    safe, rows, pacer = SafeCar(car, envelope, hooks.emit), _Rows(), Pacer(car.clock, period_s)
    hooks.emit(EpisodeStarted(
        episode=episode, t_s=car.clock.now_s(), wall_ns=wall_clock_ns(), car=car.name, reality=car.reality,
        policy=policy.name, task=task.name, seed=seed, period_s=period_s, history_length=task.history_length,
        goal=_goal_of(task), arena_m=_floats(envelope.arena_m), path_m=_floats(task.path_m), config_toml=config_toml,
        metadata={**(metadata or {}), **_outlines_text(task)},
    ))  # fmt: skip
    reason, detail = EndReason.CRASHED, ""
    try:
        # The first call imports modules for seconds; it precedes the first heartbeat.
        encode(np.zeros(6), ActionHistory(task.history_length).rows)
        policy.reset()
        first_observation(car, hooks.heartbeat)
        hooks.heartbeat("arming")
        safe.arm()
        reason = _drive(safe, policy, task, pacer, rows, hooks, task.max_ticks if max_ticks is None else max_ticks)
    except BaseException as error:
        reason, detail, is_expected = _end_of(error, safe.state, driven=bool(rows.rewards))
        if not is_expected:
            raise
    finally:
        _stop(safe, pacer, rows, hooks, reason, detail)
    origin = {"car": car.name, "reality": car.reality.value, "policy": policy.name, "task": task.name}
    return rows.finish({**origin, "seed": str(seed), **(metadata or {}), **reason.texts(detail)})


def _floats(points_m: Corners) -> Corners:
    """Points as Python numbers: those of a user's task may be NumPy's, which JSON does not have."""
    return tuple((float(x), float(y)) for x, y in points_m)


def _goal_of(task: Task) -> tuple[float, float, float] | None:
    if task.goal is None:
        return None
    x, y, yaw = task.goal
    return float(x), float(y), float(yaw)


def _outlines_text(task: Task) -> dict[str, str]:
    return {"outlines_m": json.dumps([_floats(line) for line in task.outlines_m])} if task.outlines_m else {}


def _drive(
    safe: SafeCar,
    policy: Policy,
    task: Task,
    pacer: Pacer,
    rows: _Rows,
    hooks: EpisodeHooks,
    ticks: int,
) -> EndReason:
    """Drive the ticks of an episode on an armed car into ``rows``. Raises _End for an end other than the task's."""
    car, period_s = safe.car, pacer.period_s
    history, late = ActionHistory(task.history_length), _LateTicks(period_s)
    next_health_s = -math.inf
    start_s = pacer.start()
    now_s, observation = _observe(car, rows, hooks)
    rows.add_observation(now_s, observation)
    features = encode(observation.state.to_array(), history.rows)
    timing = TickTiming(now_s, 0.0, 0)
    for step in range(ticks):
        _raise_requested_end(hooks)
        view = PolicyInput(features, observation, step, now_s - start_s)
        requested, policy_s = _act(policy, view, car, hooks, safe.envelope.lost_pose_s)
        hooks.heartbeat("commanding")
        sent = safe.command(requested, observation, period_s)
        history.push(sent)
        hooks.emit(Tick(step, now_s, timing.late_s, observation, features, requested, sent, policy_s, safe.state.value))
        if now_s >= next_health_s:
            hooks.emit(HealthReading(now_s, car.health()))
            next_health_s = now_s + HEALTH_PERIOD_S
        hooks.heartbeat("waiting for the next tick")
        timing = pacer.wait()
        now_s, observation = _observe(car, rows, hooks)
        next_features = encode(observation.state.to_array(), history.rows)
        began_s = car.clock.now_s()
        reward, terminated, success = _evaluate_transition(task, features, sent, next_features)
        task_s = car.clock.now_s() - began_s
        rows.add_step(requested, sent, reward)
        rows.add_observation(now_s, observation)
        truncated = step + 1 == ticks and not terminated
        hooks.emit(Transition(step, now_s, features, sent, reward, next_features, terminated, truncated))
        features = next_features
        if terminated:
            return EndReason.GOAL_REACHED if success else EndReason.TASK_ENDED
        if late.add(timing, policy_s, task_s):
            raise _End(EndReason.LATE_LOOP, late.describe(pacer.skipped))
    return EndReason.COMPLETED


def _observe(car: Car, rows: _Rows, hooks: EpisodeHooks) -> tuple[float, Observation]:
    """The time [s] and the newest observation."""
    hooks.heartbeat("observing")
    observation = car.observe()
    now_s = car.clock.now_s()
    rows.newest = observation
    return now_s, observation


def _raise_requested_end(hooks: EpisodeHooks) -> None:
    """Raise _End if a stop was requested or the recording failed."""
    requested_end = hooks.stop_requested()
    if requested_end is not None:
        raise _End(requested_end)
    recorder_error = hooks.recorder_failed()
    if recorder_error is not None:
        raise _End(EndReason.RECORDER_ERROR, recorder_error)


def _act(policy: Policy, view: PolicyInput, car: Car, hooks: EpisodeHooks, timeout_s: float) -> tuple[Action, float]:
    """The policy's action and its computation time [s]. Raises _End for no action, an error or a time-out."""
    hooks.heartbeat(f"inside the policy '{policy.name}'")
    began_s = car.clock.now_s()
    try:
        action = policy.act(view)
    except CarlabError:
        raise
    except Exception as error:
        log.exception("The policy '%s' raised an error at tick %d", policy.name, view.step)
        raise _End(EndReason.POLICY_ERROR, f"{type(error).__name__}: {error}") from error
    if action is None:
        raise _End(EndReason.POLICY_FINISHED)
    if not isinstance(action, Action):
        raise _End(EndReason.POLICY_ERROR, f"It returned a {type(action).__name__} instead of an Action.")
    policy_s = car.clock.now_s() - began_s
    if policy_s > timeout_s:
        raise _End(EndReason.LATE_LOOP, f"The policy '{policy.name}' took {policy_s:.1f} s for one tick.")
    return _as_numbers(action), policy_s


def _as_numbers(action: Action) -> Action:
    """The action as Python numbers. Raises _End if a channel is no number, for example an array of shape (1,)."""
    channels: tuple[object, object] = (action.steering, action.throttle)
    # Scalars of array libraries (0 dimensions) count as numbers.
    if all(isinstance(value, numbers.Real) or getattr(value, "ndim", None) == 0 for value in channels):
        with contextlib.suppress(TypeError, ValueError, OverflowError):
            return Action(float(action.steering), float(action.throttle))
    raise _End(EndReason.POLICY_ERROR, f"It returned {action}; steering and throttle must be single numbers.")


def _evaluate_transition(
    task: Task, features: FloatArray, sent: Action, next_features: FloatArray
) -> tuple[float, bool, bool]:
    """Reward, whether the episode ends, and whether it ends with success. Raises _End for an error of the task."""
    try:
        reward = float(task.reward(features, sent.to_array(), next_features))
        terminated = bool(task.terminated(next_features))
        success = terminated and bool(task.success(next_features))
    except (Exception, SystemExit) as error:
        log.debug("The task '%s' raised an error", task.name, exc_info=True)
        raise _End(EndReason.TASK_ERROR, f"{type(error).__name__}: {error}") from error
    if not math.isfinite(reward):
        raise _End(EndReason.TASK_ERROR, f"The reward is {reward:g}.")
    return reward, terminated, success


def _end_of(error: BaseException, state: SafetyState, *, driven: bool) -> tuple[EndReason, str, bool]:
    """End reason and detail of an error, and whether ``run_episode`` returns the episode instead of raising.

    ``driven`` states whether a tick was completed.
    """
    match error:
        case _End() | SafetyStop():
            return error.reason, error.detail, True
        case PoseLostError():
            return EndReason.POSE_STALE, str(error), driven
        case ActuatorFaultError():
            return EndReason.ACTUATOR_FAULT, str(error), driven
        case NotReadyError():
            reason = EndReason.NOT_READY if state is SafetyState.DISARMED else EndReason.CRASHED
            return reason, str(error), False
        case _:
            return EndReason.CRASHED, f"{type(error).__name__}: {error}", False


def _stop(safe: SafeCar, pacer: Pacer, rows: _Rows, hooks: EpisodeHooks, reason: EndReason, detail: str) -> None:
    """Stop the car, then emit the end of the episode; an error of one step does not prevent the other."""
    # A car that was never armed has not moved: its stop must not latch a fault.
    planned = safe.state is SafetyState.DISARMED or not reason.is_safety_stop

    def emit_end() -> None:
        hooks.emit(
            EpisodeEnded(
                t_s=safe.car.clock.now_s(),
                reason=reason,
                detail=detail,
                steps=len(rows.rewards),
                total_reward=float(np.sum(rows.rewards)),
                last=rows.newest,
                statistics=pacer.statistics_ms(),
            )
        )

    with contextlib.ExitStack() as stack:  # Callbacks run from the last to the first.
        stack.callback(emit_end)
        stack.callback(safe.stop, planned=planned)
        stack.callback(hooks.heartbeat, "stopping the car")
