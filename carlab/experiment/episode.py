"""One episode: observe, decide, pass the gate, send, wait; and, whatever happens, neutral at the end.

observe ──> encode ──> policy ──> SafeCar (the gate) ──> Car.command ──> wait for the next deadline ─┐
^                                                                                                 │
└──────────────── emit Tick, Transition (recorders listen; the loop knows none of them) <─────────┘
"""

from __future__ import annotations

import contextlib
import logging
import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from carlab.core.car import Car
from carlab.core.clock import Pacer, TickTiming, wall_clock_ns
from carlab.core.documents import Document, EpisodeEnded, EpisodeStarted, HealthReading, Tick, Transition
from carlab.core.episode_data import EpisodeData
from carlab.core.errors import (
    ActuatorFaultError,
    CarlabError,
    NotReadyError,
    PoseLostError,
)
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
    """What an episode asks of its surroundings; the defaults ask nothing."""

    emit: Callable[[Document], None] = lambda document: None
    stop_requested: Callable[[], EndReason | None] = lambda: None
    recorder_failed: Callable[[], str | None] = lambda: None
    heartbeat: Callable[[str], None] = lambda where: None


@dataclass(slots=True)
class _Rows:
    """The arrays of an episode while they grow."""

    times_s: list[float] = field(default_factory=list)
    states: list[FloatArray] = field(default_factory=list)
    requested: list[FloatArray] = field(default_factory=list)
    sent: list[FloatArray] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)
    poses: list[tuple[float, float, float, float]] = field(default_factory=list)

    def observed(self, now_s: float, observation: Observation) -> None:
        self.times_s.append(now_s)
        self.states.append(observation.state.to_array())
        self.poses.extend((p.t_capture_s, p.x_m, p.y_m, p.yaw_rad) for p in observation.poses if p.tracked)

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
    """Ends an episode when more than half of the last ticks woke later than half a period."""

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._late: deque[bool] = deque(maxlen=LATE_WINDOW_TICKS)

    def add(self, timing: TickTiming) -> bool:
        self._late.append(timing.late_s > 0.5 * self._period_s or timing.skipped > 0)
        return len(self._late) == LATE_WINDOW_TICKS and sum(self._late) > LATE_WINDOW_TICKS // 2


class _End(Exception):
    """Leaves the loop with a reason."""

    def __init__(self, reason: EndReason, detail: str = "") -> None:
        self.reason, self.detail = reason, detail
        super().__init__(reason.name)


def first_observation(car: Car, heartbeat: Callable[[str], None] = lambda where: None) -> Observation:
    """Wait for the first pose with a speed. Raises PoseLostError after two seconds of the car's clock."""
    give_up_s = car.clock.now_s() + FIRST_POSE_TIMEOUT_S
    while True:
        heartbeat("waiting for the first pose")
        try:
            observation = car.observe()
            if observation.tracked and observation.velocity_valid:
                return observation
        except PoseLostError:
            if car.clock.now_s() > give_up_s:
                raise
        else:
            if car.clock.now_s() > give_up_s:
                raise PoseLostError(
                    "Motion capture comes too rarely to know the car's speed; raise its frame rate."
                    if observation.tracked
                    else "Motion capture runs but does not see the car; check its markers and the volume."
                )
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
        car: an open car; it is armed here and left stopped and disarmed.
        policy: decides each tick; None from ``act`` ends the episode.
        task: gives reward, end, goal and length of the action history.
        envelope: limits of the safety gate.
        period_s: control period [s].
        max_ticks: ticks to drive; the task's number where None.
        hooks: where documents go and who may stop the episode.
        episode: number of this episode, from 1.
        seed: written into the recording.
        config_toml: configuration as text, written into the recording.
        metadata: further texts for the recording.

    Returns:
        The episode; ``metadata`` has ``end_reason``, ``end_sentence`` and ``end_detail``. An episode that ended early,
        by a safety stop, a policy's error or a request, is returned too.

    Raises:
        NotReadyError, ActuatorFaultError: the car cannot be armed; PoseLostError: no pose comes. Nothing has moved.
        Anything unexpected is raised again after the car was stopped and the recording was told.
    """
    hooks = hooks or EpisodeHooks()
    safe = SafeCar(car, envelope, hooks.emit)
    history = ActionHistory(task.history_length)
    rows = _Rows()
    pacer = Pacer(car.clock, period_s)
    late = _LateTicks(period_s)
    ticks = task.max_ticks if max_ticks is None else max_ticks
    texts = {
        "car": car.name,
        "reality": car.reality.value,
        "policy": policy.name,
        "task": task.name,
        "seed": str(seed),
        **(metadata or {}),
    }
    reason, detail = EndReason.CRASHED, ""
    observation: Observation | None = None

    def observe(where: str) -> tuple[float, Observation]:
        hooks.heartbeat(where)
        seen = car.observe()
        return car.clock.now_s(), seen

    hooks.emit(
        EpisodeStarted(
            episode=episode,
            t_s=car.clock.now_s(),
            wall_ns=wall_clock_ns(),
            car=car.name,
            reality=car.reality,
            policy=policy.name,
            task=task.name,
            seed=seed,
            period_s=period_s,
            history_length=task.history_length,
            goal=task.goal,
            arena_m=envelope.arena_m,
            path_m=task.path_m,
            config_toml=config_toml,
            metadata=dict(metadata or {}),
        )
    )
    next_health_s = -math.inf
    try:
        policy.reset()
        first_observation(car, hooks.heartbeat)
        hooks.heartbeat("arming")
        safe.arm()
        start_s = pacer.start()
        now_s, observation = observe("observing")
        rows.observed(now_s, observation)
        features = encode(observation.state.to_array(), history.rows)
        timing = TickTiming(now_s, 0.0, 0)
        for step in range(ticks):
            requested_end = hooks.stop_requested()
            if requested_end is not None:
                raise _End(requested_end)
            failed = hooks.recorder_failed()
            if failed is not None:
                raise _End(EndReason.RECORDER_ERROR, failed)
            requested, policy_s = _ask(policy, PolicyInput(features, observation, step, now_s - start_s), car, hooks)
            if policy_s > envelope.lost_pose_s:
                raise _End(EndReason.LATE_LOOP, f"The policy '{policy.name}' took {policy_s:.1f} s for one tick.")
            hooks.heartbeat("commanding")
            sent = safe.command(requested, observation, period_s)
            history.push(sent)
            hooks.emit(
                Tick(step, now_s, timing.late_s, observation, features, requested, sent, policy_s, safe.state.value)
            )
            if now_s >= next_health_s:
                hooks.emit(HealthReading(now_s, car.health()))
                next_health_s = now_s + HEALTH_PERIOD_S
            hooks.heartbeat("waiting for the next tick")
            timing = pacer.wait()
            now_s, observation = observe("observing")
            next_features = encode(observation.state.to_array(), history.rows)
            action = sent.to_array()
            reward = float(task.reward(features, action, next_features))
            terminated = bool(task.terminated(next_features))
            rows.requested.append(requested.to_array())
            rows.sent.append(action)
            rows.rewards.append(reward)
            rows.observed(now_s, observation)
            truncated = step + 1 == ticks and not terminated
            hooks.emit(Transition(step, now_s, features, sent, reward, next_features, terminated, truncated))
            features = next_features
            if terminated:
                raise _End(EndReason.GOAL_REACHED if task.goal is not None else EndReason.COMPLETED)
            if late.add(timing):
                raise _End(EndReason.LATE_LOOP, f"{pacer.skipped} ticks were skipped.")
        reason = EndReason.COMPLETED
    except _End as end:
        reason, detail = end.reason, end.detail
    except SafetyStop as stop:
        reason, detail = stop.reason, stop.detail
    except PoseLostError as error:
        reason, detail = EndReason.POSE_STALE, str(error)
        if not rows.rewards:
            raise
    except ActuatorFaultError as error:
        reason, detail = EndReason.ACTUATOR_FAULT, str(error)
        if not rows.rewards:
            raise
    except NotReadyError as error:
        if safe.state is SafetyState.DISARMED:
            reason = EndReason.NOT_READY
        detail = str(error)
        raise
    except BaseException as error:
        detail = f"{type(error).__name__}: {error}"
        raise
    finally:
        # A car that was never armed has done nothing that a fault would have to remember.
        planned = safe.state is SafetyState.DISARMED or not reason.is_safety_stop

        def tell() -> None:
            hooks.emit(
                EpisodeEnded(
                    t_s=car.clock.now_s(),
                    reason=reason,
                    detail=detail,
                    steps=len(rows.rewards),
                    total_reward=float(np.sum(rows.rewards)),
                    last=observation,
                    statistics=pacer.statistics_ms(),
                )
            )

        with contextlib.ExitStack() as last:  # From the bottom up, each whatever became of the one before.
            last.callback(tell)
            last.callback(safe.stop, planned=planned)
            last.callback(hooks.heartbeat, "stopping the car")
    texts |= {"end_reason": reason.name, "end_sentence": reason.value, "end_detail": detail}
    return rows.finish(texts)


def _ask(policy: Policy, view: PolicyInput, car: Car, hooks: EpisodeHooks) -> tuple[Action, float]:
    """The policy's action and how long it thought [s]; its errors and its end become the episode's."""
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
        raise _End(EndReason.POLICY_ERROR, f"It returned a {type(action).__name__} where an Action is wanted.")
    return action, car.clock.now_s() - began_s
