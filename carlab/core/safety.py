"""The safety gate for all commands: limits as pure functions, and SafeCar, which applies them to a car.

The default limits are those of common drivers. A stale pose gives neutral after 100 ms and ends the episode after
500 ms; so does a pose further from the last one than the car can drive (another body taken for the car). Commands are
clipped and slew-limited, except towards zero. The geofence checks whether the car can still stop inside. Recordings
contain the commands that this gate has sent. Every comparison rejects NaN.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Callable, Mapping
from dataclasses import astuple, dataclass, fields, replace
from typing import NoReturn

from carlab.core.angles import wrap
from carlab.core.car import Car
from carlab.core.documents import SafetyEvent
from carlab.core.errors import ActionOutOfRangeError, ActuatorFaultError, CarlabError, ConfigError, NotArmedError
from carlab.core.geofence import can_stop_inside
from carlab.core.outcome import EndReason
from carlab.core.quantities import NEUTRAL, Action, CarState, Observation, PoseSample
from carlab.core.safety_bounds import SAFETY_BOUNDS, Bound, check_bound

FROZEN_POSITION_M, FROZEN_YAW_RAD = 2e-5, 1e-4
"""Smallest change of a live pose: below the noise of motion capture, above the resolution of 32-bit numbers. The pose
of a car that is blocked with turning wheels still changes by the noise, so it does not count as frozen."""
CLOCK_TOLERANCE_S = 0.01
"""Largest time of arrival ahead of the car's clock [s]; a later one belongs to another clock."""
POSE_REASONS = (EndReason.POSE_STALE, EndReason.POSE_JUMP, EndReason.POSE_FROZEN, EndReason.TRACKING_LOST)
"""Ends of an episode that an error of motion capture may explain."""
UPPER_BOUNDS: Mapping[str, Bound] = {
    "max_speed_mps": SAFETY_BOUNDS.speed,
    "max_yaw_rate_radps": SAFETY_BOUNDS.yaw_rate,
    "steering_rate_per_s": SAFETY_BOUNDS.command_rate,
    "throttle_rate_per_s": SAFETY_BOUNDS.command_rate,
    "jump_margin_m": SAFETY_BOUNDS.jump_distance,
    "jump_margin_rad": SAFETY_BOUNDS.jump_angle,
    "stale_pose_s": SAFETY_BOUNDS.deadline,
    "lost_pose_s": SAFETY_BOUNDS.deadline,
    "frozen_pose_s": SAFETY_BOUNDS.deadline,
    "reaction_s": SAFETY_BOUNDS.deadline,
    "deceleration_mps2": SAFETY_BOUNDS.deceleration,
}
"""Upper bound of each limit of an envelope that has a unit."""


@dataclass(frozen=True, slots=True)
class SafetyEnvelope:
    """Limits of a car in an arena. Rates are per second of normalised command; the arena is corners [m] or empty.

    Between two observations the pose may move by ``max_speed_mps`` and turn by ``max_yaw_rate_radps`` times the time
    between them, plus the jump margins. A pose that is unchanged for ``frozen_pose_s`` while the motor turns on command
    ends the episode.

    Raises:
        ConfigError: a limit is not a finite number or out of range (``carlab.core.safety_bounds``).
    """

    max_steering: float = 1.0
    max_throttle: float = 1.0
    steering_rate_per_s: float = 20.0
    throttle_rate_per_s: float = 20.0
    max_speed_mps: float = 5.0
    max_yaw_rate_radps: float = 20.0
    jump_margin_m: float = 0.1
    jump_margin_rad: float = 0.5
    stale_pose_s: float = 0.1
    lost_pose_s: float = 0.5
    frozen_pose_s: float = 0.4
    reaction_s: float = 0.15
    deceleration_mps2: float = 3.0
    arena_m: tuple[tuple[float, float], ...] = ()

    def __post_init__(self) -> None:
        for name, bound in UPPER_BOUNDS.items():
            check_bound(name, "[hardware.limits]", getattr(self, name), bound)
        for name in (f.name for f in fields(self) if f.name not in ("reaction_s", "arena_m")):
            if not getattr(self, name) > 0:
                raise ConfigError(f"{name} must be above zero, not {getattr(self, name)}.")
        for name in ("max_steering", "max_throttle"):
            if not 0 < getattr(self, name) <= 1:
                raise ConfigError(f"{name} is {getattr(self, name):g}; it must lie in (0, 1].")
        if self.lost_pose_s < self.stale_pose_s:
            raise ConfigError("lost_pose_s must not be shorter than stale_pose_s.")

    def with_default_arena(self, arena_m: tuple[tuple[float, float], ...]) -> SafetyEnvelope:
        """These limits, with another arena if they have none."""
        return self if self.arena_m else replace(self, arena_m=arena_m)


def clip(value: float, limit: float) -> float:
    """Clip to [-limit, limit]."""
    return min(max(value, -limit), limit)


def slew(target: float, previous: float, max_step: float) -> float:
    """Move from ``previous`` towards ``target`` by at most ``max_step``; motion towards zero is not limited."""
    if target * previous < 0.0:
        previous = 0.0
    if abs(target) <= abs(previous):
        return target
    return min(max(target, previous - max_step), previous + max_step)


def limit(requested: Action, previous: Action, dt_s: float, envelope: SafetyEnvelope) -> Action:
    """Clip and slew-limit a command. ``previous`` is the command sent ``dt_s`` ago."""
    dt_s = max(dt_s, 0.0)
    steering = clip(requested.steering, envelope.max_steering)
    throttle = clip(requested.throttle, envelope.max_throttle)
    return Action(
        slew(steering, previous.steering, envelope.steering_rate_per_s * dt_s),
        slew(throttle, previous.throttle, envelope.throttle_rate_per_s * dt_s),
    )


def _moved(now: CarState | PoseSample, then: CarState | PoseSample) -> tuple[float, float]:
    """Distance [m] and angle [rad] between two poses."""
    return math.hypot(now.x_m - then.x_m, now.y_m - then.y_m), abs(float(wrap(now.yaw_rad - then.yaw_rad)))


def _newest_pose(observation: Observation) -> PoseSample:
    """The pose of the observation's state."""
    o, state = observation, observation.state
    return PoseSample(o.sequence, o.t_capture_s, o.t_receive_s, state.x_m, state.y_m, state.yaw_rad)


def _is_valid(pose: PoseSample) -> bool:
    """Whether a raw pose is tracked and finite; the estimator ignores others."""
    return pose.tracked and all(map(math.isfinite, (pose.x_m, pose.y_m, pose.yaw_rad)))


def pose_jump(observation: Observation, previous: Observation, envelope: SafetyEnvelope) -> str | None:
    """Describe a pose change since ``previous`` that exceeds the car's speed or yaw rate; None if it is possible.

    Every pose between the observations is checked: a wrong one also falsifies the estimated speed.
    """
    then = _newest_pose(previous)
    for now in (*filter(_is_valid, observation.poses), _newest_pose(observation)):
        dt_s = max(
            now.t_capture_s - then.t_capture_s, now.t_receive_s - then.t_receive_s, 0.0
        )  # Capture times alone fail after a step of the camera's clock, arrival times alone in a burst.
        moved_m, turned_rad = _moved(now, then)
        if not (
            moved_m <= envelope.max_speed_mps * dt_s + envelope.jump_margin_m
            and turned_rad <= envelope.max_yaw_rate_radps * dt_s + envelope.jump_margin_rad
        ):
            return f"It moved by {moved_m:.3g} m and turned by {turned_rad:.2f} rad within {dt_s * 1e3:.0f} ms."
        then = now
    return None


def violation(
    observation: Observation, previous: Observation | None, now_s: float, envelope: SafetyEnvelope
) -> tuple[EndReason, str] | None:
    """Reason to end the episode now, with its figures; None if there is none.

    ``previous`` is the observation of the previous tick, None at the first.
    """
    state = observation.state
    age_s, taken_s = now_s - observation.t_receive_s, now_s - observation.t_capture_s
    if not (age_s <= envelope.lost_pose_s and taken_s <= envelope.lost_pose_s):
        reason = EndReason.POSE_STALE if observation.tracked else EndReason.TRACKING_LOST
        ages = f"arrived {age_s * 1e3:.0f} ms ago and was captured {taken_s * 1e3:.0f} ms ago"
        return reason, f"The newest usable pose {ages}."
    if age_s < -CLOCK_TOLERANCE_S:
        return EndReason.POSE_STALE, f"The newest pose is {-age_s:.2f} s ahead of the car's clock."
    if not all(map(math.isfinite, astuple(state))):
        return EndReason.TRACKING_LOST, f"The estimated state is not a number: {state}."
    if previous is not None and (jump := pose_jump(observation, previous, envelope)) is not None:
        return EndReason.POSE_JUMP, jump
    if state.speed_mps > envelope.max_speed_mps:
        return (
            EndReason.OVERSPEED,
            f"The speed is {state.speed_mps:.2f} m/s, limit {envelope.max_speed_mps:.2f} m/s.",
        )
    if envelope.arena_m and not can_stop_inside(
        envelope.arena_m, state, envelope.reaction_s, envelope.deceleration_mps2
    ):
        return EndReason.GEOFENCE, f"At ({state.x_m:.2f}, {state.y_m:.2f}) m with {state.speed_mps:.2f} m/s."
    return None


class FrozenPoseDetector:
    """Detects a pose that does not change although the motor turns on command.

    Fresh stamps do not prove a fresh pose: paused motion-capture software may repeat the last one.
    """

    def __init__(self, frozen_pose_s: float) -> None:
        self.frozen_pose_s = frozen_pose_s
        self._pose: CarState | None = None
        self._since_s = 0.0

    def reset(self) -> None:
        """Reset the detector."""
        self._pose = None

    def problem(self, observation: Observation, sent: Action, now_s: float) -> str | None:
        """Describe a frozen pose after the last command that was sent; None if the pose is not frozen."""
        state = observation.state
        must_move = observation.motor_is_turning is True and sent.throttle != 0.0
        moved_m, turned_rad = (math.inf, 0.0) if self._pose is None else _moved(state, self._pose)
        if not must_move or moved_m > FROZEN_POSITION_M or turned_rad > FROZEN_YAW_RAD:
            self._pose, self._since_s = state, now_s
            return None
        frozen_s = now_s - self._since_s
        return None if frozen_s <= self.frozen_pose_s else f"It was unchanged for {frozen_s:.2f} s."


class LatePoseDetector:
    """Detects poses that still arrive, but ever later after their exposure (a busy camera computer or network).

    The smallest latency from exposure to arrival since ``reset`` is the normal one: it contains neither jitter nor
    waiting times, and a drift of the clocks by 100 ppm changes it by 0.1 s within 17 minutes only.
    """

    def __init__(self, envelope: SafetyEnvelope) -> None:
        self._envelope = envelope
        self.reset()

    def reset(self) -> None:
        """Reset the detector."""
        self._normal_latency_s = math.inf
        self._late_since_s: float | None = None

    def age_s(self, observation: Observation, now_s: float) -> float:
        """Age of the pose beyond the normal latency [s]."""
        self._normal_latency_s = min(self._normal_latency_s, observation.t_receive_s - observation.t_capture_s)
        return now_s - observation.t_capture_s - self._normal_latency_s

    def problem(self, observation: Observation, now_s: float) -> str | None:
        """Describe poses that have been older than ``stale_pose_s`` for ``lost_pose_s``; None if they have not."""
        if self.age_s(observation, now_s) <= self._envelope.stale_pose_s:
            self._late_since_s = None
            return None
        if self._late_since_s is None:
            self._late_since_s = now_s
        if now_s - self._late_since_s <= self._envelope.lost_pose_s:
            return None
        latency_ms = (observation.t_receive_s - observation.t_capture_s) * 1e3
        normal_ms = self._normal_latency_s * 1e3
        return f"The poses arrive {latency_ms:.0f} ms after their exposure; before, it was {normal_ms:.0f} ms."


class SafetyState(enum.Enum):
    """State of the gate."""

    DISARMED = "disarmed"
    ARMED = "armed"
    PAUSED = "paused"
    FAULT = "fault"


class SafetyStop(CarlabError):
    """The gate has sent neutral and ended the episode, for ``reason`` with the figures in ``detail``."""

    exit_code = 4

    def __init__(self, reason: EndReason, detail: str) -> None:
        self.reason = reason
        self.detail = detail
        super().__init__(reason.sentences(detail))


class SafeCar:
    """Applies the narrower limits of an envelope and a car to every command of an episode.

    Emits a SafetyEvent when the kind of intervention changes, not on every tick.
    """

    def __init__(self, car: Car, envelope: SafetyEnvelope, on_event: Callable[[SafetyEvent], None]) -> None:
        self.car = car
        self.envelope = replace(
            envelope,
            max_steering=min(envelope.max_steering, car.limits.max_steering),
            max_throttle=min(envelope.max_throttle, car.limits.max_throttle),
        )
        self.state = SafetyState.DISARMED
        self._on_event = on_event
        self._sent = NEUTRAL
        self._sent_s: float | None = None
        self._seen: Observation | None = None
        self._frozen = FrozenPoseDetector(envelope.frozen_pose_s)
        self._late = LatePoseDetector(envelope)
        self._pose_problems_since_s: float | None = None
        self._active: frozenset[str] = frozenset()
        self._watchdog_trips = 0

    def arm(self) -> None:
        """Arm the car. Raises the errors of Car.arm."""
        self.car.arm()
        self.state = SafetyState.ARMED
        self._sent, self._sent_s, self._seen = NEUTRAL, None, None
        self._watchdog_trips = self.car.watchdog_trips
        self._pose_problems_since_s = None
        self._frozen.reset()
        self._late.reset()

    def command(self, requested: Action, observation: Observation, period_s: float) -> Action:
        """Limit and send a command; returns the command sent.

        Raises:
            SafetyStop: the episode must end.
            NotArmedError: the gate is not armed.
        """
        now_s = self.car.clock.now_s()
        if self.state not in (SafetyState.ARMED, SafetyState.PAUSED):
            raise NotArmedError("The safety gate is not armed; call arm() first.")
        self._report_watchdog(now_s)
        if not requested.is_finite:
            self._end(EndReason.BAD_COMMAND, f"The requested command is {requested}.", now_s)
        found = violation(observation, self._seen, now_s, self.envelope)
        if found is not None:
            self._end(*found, now_s)
        if (frozen := self._frozen.problem(observation, self._sent, now_s)) is not None:
            self._end(EndReason.POSE_FROZEN, frozen, now_s)
        if (late := self._late.problem(observation, now_s)) is not None:
            self._end(EndReason.POSE_STALE, late, now_s)
        self._seen = observation
        age_s = self._late.age_s(observation, now_s)
        kinds: dict[str, str] = {}
        if age_s > self.envelope.stale_pose_s:
            kinds["stale_pose"] = f"The pose is {age_s * 1e3:.0f} ms old: neutral until a fresh pose arrives."
        elif not observation.velocity_valid:
            kinds["unknown_speed"] = "Too few poses to estimate the speed: neutral until more arrive."
        elif problems := self._pose_problems(now_s):
            kinds["pose_problems"] = f"Neutral while motion capture reports: {problems}"
        if kinds:
            target = NEUTRAL
            self.state = SafetyState.PAUSED
        else:
            dt_s = period_s if self._sent_s is None else min(now_s - self._sent_s, 2.0 * period_s)
            target = limit(requested, self._sent, dt_s, self.envelope)
            if target != requested:
                kinds["limited"] = f"Requested {requested}, limited to {target}."
            self.state = SafetyState.ARMED
        for kind in kinds.keys() - self._active:
            self._on_event(SafetyEvent(now_s, kind, kinds[kind]))
        self._active = frozenset(kinds)
        try:
            sent = self.car.command(target)
        except ActionOutOfRangeError as error:
            self._end(EndReason.BAD_COMMAND, str(error), now_s)
        except (ActuatorFaultError, NotArmedError) as error:
            self._end(EndReason.ACTUATOR_FAULT, str(error), now_s)
        self._sent, self._sent_s = target, now_s
        return sent

    def stop(self, *, planned: bool) -> None:
        """Send neutral and disarm; ``planned=False`` latches a fault."""
        self.state = SafetyState.DISARMED if planned else SafetyState.FAULT
        self.car.stop(planned=planned)

    def _pose_problems(self, now_s: float) -> str:
        """Reasons why the poses may be wrong, as one text. If they last for ``lost_pose_s``, the episode ends.

        Arming checks them too, but a car that drives straight ahead does not show a wrong axis.
        """
        problems = self.car.pose_problems()
        if not problems:
            self._pose_problems_since_s = None
        elif self._pose_problems_since_s is None:
            self._pose_problems_since_s = now_s
        elif now_s - self._pose_problems_since_s > self.envelope.lost_pose_s:
            self._end(EndReason.TRACKING_LOST, "Poses arrive, but they may be wrong.", now_s)
        return " ".join(problems)

    def _report_watchdog(self, now_s: float) -> None:
        """Emit an event if the car's watchdog has replaced a command since the last tick: it was not held."""
        trips = self.car.watchdog_trips
        if trips > self._watchdog_trips:
            text = "The last command became too old before the next one: the watchdog set neutral in between."
            self._on_event(SafetyEvent(now_s, "watchdog", text))
        self._watchdog_trips = trips

    def _end(self, reason: EndReason, detail: str, now_s: float) -> NoReturn:
        self.stop(planned=False)
        if reason in POSE_REASONS and (problems := self.car.pose_problems()):
            detail = f"{detail} Motion capture reports: {' '.join(problems)}"
        self._on_event(SafetyEvent(now_s, reason.name.lower(), reason.sentences(detail)))
        raise SafetyStop(reason, detail)
