"""The one gate that every command passes: pure limits, and SafeCar which applies them to a car.

Numbers to start from are those of common drivers: a stale pose gives neutral after 100 ms and ends the episode after
500 ms, as does one further from the last than the car can drive (another body taken for the car); commands are
clipped and slew-limited (towards zero is always allowed at once); a geofence asks whether the car could still stop
inside. What is recorded as sent is what came out of this gate. No comparison here lets a NaN pass.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Callable
from dataclasses import astuple, dataclass, fields, replace
from typing import NoReturn

from carlab.core.angles import wrap
from carlab.core.car import Car
from carlab.core.documents import SafetyEvent
from carlab.core.errors import ActionOutOfRangeError, ActuatorFaultError, CarlabError, ConfigError, NotArmedError
from carlab.core.geofence import can_stop_inside
from carlab.core.outcome import EndReason
from carlab.core.quantities import NEUTRAL, Action, CarState, Observation

FROZEN_POSITION_M, FROZEN_YAW_RAD = 2e-5, 1e-4
"""A smaller change of the pose is none: below the noise of motion capture, above the resolution of 32-bit numbers. A
car that is blocked with turning wheels still moves by the noise, so it does not count as frozen."""
CLOCK_TOLERANCE_S = 0.01
"""A pose that claims to arrive further ahead than this was stamped by another clock."""


@dataclass(frozen=True, slots=True)
class SafetyEnvelope:
    """Limits of one car in one place. Rates are per second of normalised command; the arena is corners [m] or empty.

    Between two observations the pose may move by ``max_speed_mps`` and turn by ``max_yaw_rate_radps`` for the time
    between them, and by the jump margins on top. A pose that stays the same for ``frozen_pose_s`` while the motor turns
    on command ends the episode.
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
        for name in (f.name for f in fields(self) if f.name not in ("reaction_s", "arena_m")):
            if not getattr(self, name) > 0:
                raise ConfigError(f"{name} must be above zero, not {getattr(self, name)}.")
        if not self.reaction_s >= 0:
            raise ConfigError(f"reaction_s must not be below zero, and is {self.reaction_s}.")
        if not (0 < self.max_steering <= 1 and 0 < self.max_throttle <= 1):
            raise ConfigError("max_steering and max_throttle must lie in (0, 1].")
        if self.lost_pose_s < self.stale_pose_s:
            raise ConfigError("lost_pose_s must not be shorter than stale_pose_s.")


def clip(value: float, limit: float) -> float:
    """Clip to [-limit, limit]."""
    return min(max(value, -limit), limit)


def slew(target: float, previous: float, max_step: float) -> float:
    """Move from ``previous`` towards ``target`` by at most ``max_step``; the way to zero is never held back."""
    if target * previous < 0.0:
        previous = 0.0
    if abs(target) <= abs(previous):
        return target
    return min(max(target, previous - max_step), previous + max_step)


def limit(requested: Action, previous: Action, dt_s: float, envelope: SafetyEnvelope) -> Action:
    """Clip and slew-limit a command. ``previous`` is what was sent ``dt_s`` ago."""
    dt_s = max(dt_s, 0.0)
    steering = clip(requested.steering, envelope.max_steering)
    throttle = clip(requested.throttle, envelope.max_throttle)
    return Action(
        slew(steering, previous.steering, envelope.steering_rate_per_s * dt_s),
        slew(throttle, previous.throttle, envelope.throttle_rate_per_s * dt_s),
    )


def jump(observation: Observation, previous: Observation, envelope: SafetyEnvelope) -> str | None:
    """What the pose has done since ``previous`` that no car can do, in words; None where it can have driven there."""
    then, now = previous.state, observation.state
    dt_s = max(
        observation.t_capture_s - previous.t_capture_s, observation.t_receive_s - previous.t_receive_s, 0.0
    )  # Either alone is too short: of capture where the camera's clock was set back, of receipt in a burst.
    moved_m = math.hypot(now.x_m - then.x_m, now.y_m - then.y_m)
    turned_rad = abs(float(wrap(now.yaw_rad - then.yaw_rad)))
    if (
        moved_m <= envelope.max_speed_mps * dt_s + envelope.jump_margin_m
        and turned_rad <= envelope.max_yaw_rate_radps * dt_s + envelope.jump_margin_rad
    ):
        return None
    return f"It moved by {moved_m:.2f} m and turned by {turned_rad:.2f} rad within {dt_s * 1e3:.0f} ms."


def violation(
    observation: Observation, previous: Observation | None, now_s: float, envelope: SafetyEnvelope
) -> tuple[EndReason, str] | None:
    """The reason to end the episode now, with its figures; None while all is well.

    ``previous`` is the observation of the tick before, None at the first.
    """
    state = observation.state
    age_s, taken_s = now_s - observation.t_receive_s, now_s - observation.t_capture_s
    if not (age_s <= envelope.lost_pose_s and taken_s <= envelope.lost_pose_s):
        reason = EndReason.POSE_STALE if observation.tracked else EndReason.TRACKING_LOST
        came = f"came {age_s * 1e3:.0f} ms ago and was taken {taken_s * 1e3:.0f} ms ago"
        return reason, f"The newest usable pose {came}."
    if age_s < -CLOCK_TOLERANCE_S:
        return EndReason.POSE_STALE, f"The newest pose is {-age_s:.2f} s ahead of the car's clock; it has another one."
    if not all(map(math.isfinite, astuple(state))):
        return EndReason.TRACKING_LOST, f"The estimated state is not a number: {state}."
    if previous is not None and (leap := jump(observation, previous, envelope)) is not None:
        return EndReason.POSE_JUMP, leap
    if state.speed_mps > envelope.max_speed_mps:
        return EndReason.OVERSPEED, f"{state.speed_mps:.2f} m/s where {envelope.max_speed_mps:.2f} m/s is the limit."
    if envelope.arena_m and not can_stop_inside(
        envelope.arena_m, state, envelope.reaction_s, envelope.deceleration_mps2
    ):
        return EndReason.GEOFENCE, f"At ({state.x_m:.2f}, {state.y_m:.2f}) m with {state.speed_mps:.2f} m/s."
    return None


class FrozenPoseWatch:
    """Notices a pose that does not change although the motor turns on command.

    Fresh stamps do not prove a fresh pose: paused motion-capture software may repeat the last one.
    """

    def __init__(self, frozen_pose_s: float) -> None:
        self.frozen_pose_s = frozen_pose_s
        self._pose: CarState | None = None
        self._since_s = 0.0

    def reset(self) -> None:
        """Forget everything."""
        self._pose = None

    def problem(self, observation: Observation, sent: Action, now_s: float) -> str | None:
        """Return what is wrong, None while all is well.

        Args:
            observation: the newest observation.
            sent: the last command that was sent.
            now_s: the time of the car's clock [s].
        """
        state = observation.state
        must_move = observation.motor_is_turning is True and sent.throttle != 0.0
        if self._pose is None or not must_move or _has_moved(state, self._pose):
            self._pose, self._since_s = state, now_s
            return None
        frozen_s = now_s - self._since_s
        return None if frozen_s <= self.frozen_pose_s else f"It was the same for {frozen_s:.2f} s."


def _has_moved(now: CarState, then: CarState) -> bool:
    moved_m = math.hypot(now.x_m - then.x_m, now.y_m - then.y_m)
    turned_rad = abs(float(wrap(now.yaw_rad - then.yaw_rad)))
    return moved_m > FROZEN_POSITION_M or turned_rad > FROZEN_YAW_RAD


class SafetyState(enum.Enum):
    """State of the gate."""

    DISARMED = "disarmed"
    ARMED = "armed"
    PAUSED = "paused"
    FAULT = "fault"


class SafetyStop(CarlabError):
    """The gate has put the car in neutral and ended the episode. ``reason`` says why, ``detail`` with what figures."""

    exit_code = 4

    def __init__(self, reason: EndReason, detail: str) -> None:
        self.reason = reason
        self.detail = detail
        super().__init__(f"{reason.value} {detail}".strip())


class SafeCar:
    """Applies an envelope to a car, and the car's own limits where they are narrower. Every episode commands by it.

    Emits a SafetyEvent whenever the kind of intervention changes, not on every tick that it lasts.
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
        self._frozen = FrozenPoseWatch(envelope.frozen_pose_s)
        self._active: frozenset[str] = frozenset()

    def arm(self) -> None:
        """Arm the car. Raises what Car.arm raises."""
        self.car.arm()
        self.state = SafetyState.ARMED
        self._sent, self._sent_s, self._seen = NEUTRAL, None, None
        self._frozen.reset()

    def command(self, requested: Action, observation: Observation, period_s: float) -> Action:
        """Pass a command through the gate and return what was sent; raise SafetyStop where the episode must end."""
        now_s = self.car.clock.now_s()
        if self.state not in (SafetyState.ARMED, SafetyState.PAUSED):
            raise NotArmedError("The safety gate is not armed; call arm() first.")
        if not requested.is_finite:
            self._end(EndReason.BAD_COMMAND, f"It asked for {requested}.", now_s)
        found = violation(observation, self._seen, now_s, self.envelope)
        if found is not None:
            self._end(*found, now_s)
        if (frozen := self._frozen.problem(observation, self._sent, now_s)) is not None:
            self._end(EndReason.POSE_FROZEN, frozen, now_s)
        self._seen = observation
        age_s = now_s - observation.t_receive_s
        kinds: dict[str, str] = {}
        if age_s > self.envelope.stale_pose_s:
            kinds["stale_pose"] = f"The pose is {age_s * 1e3:.0f} ms old: neutral until it is fresh."
        elif not observation.velocity_valid:
            kinds["unknown_speed"] = "Too few poses have come to know the speed: neutral until there are."
        if kinds:
            target = NEUTRAL
            self.state = SafetyState.PAUSED
        else:
            dt_s = period_s if self._sent_s is None else min(now_s - self._sent_s, 2.0 * period_s)
            target = limit(requested, self._sent, dt_s, self.envelope)
            if target != requested:
                kinds["limited"] = f"Asked for {requested}, limited to {target}."
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
        """Neutral and disarm; ``planned=False`` latches."""
        self.state = SafetyState.DISARMED if planned else SafetyState.FAULT
        self.car.stop(planned=planned)

    def _end(self, reason: EndReason, detail: str, now_s: float) -> NoReturn:
        self.stop(planned=False)
        self._on_event(SafetyEvent(now_s, reason.name.lower(), f"{reason.value} {detail}"))
        raise SafetyStop(reason, detail)
