"""Calibration of one car for normalised commands: servo trim, end stops and sign, motor mode, limits. Pure."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass
from typing import Literal

from carlab.core.errors import ActionOutOfRangeError, ConfigError
from carlab.core.quantities import Action

CURRENT_SCALE, DUTY_SCALE, SERVO_SCALE = 1e3, 1e5, 1e3
"""Device steps per ampere, per unit of duty, and over the servo's range."""


class MotorKind(enum.IntEnum):
    """Quantity that the motor number of a command sets."""

    CURRENT = 0
    BRAKE = 1
    DUTY = 2


MOTOR_SCALES = {MotorKind.CURRENT: CURRENT_SCALE, MotorKind.BRAKE: CURRENT_SCALE, MotorKind.DUTY: DUTY_SCALE}


@dataclass(frozen=True, slots=True)
class DeviceCommand:
    """A command in whole device steps: mA or 1e-5 duty for the motor, 1/1000 of the servo's range."""

    motor_kind: MotorKind
    motor_steps: int
    servo_steps: int

    @property
    def motor_value(self) -> float:
        """Current [A] or duty in [-1, 1]."""
        return self.motor_steps / MOTOR_SCALES[self.motor_kind]

    @property
    def servo_position(self) -> float:
        """Servo position in [0, 1]."""
        return self.servo_steps / SERVO_SCALE


@dataclass(frozen=True, slots=True)
class ActuatorCalibration:
    """Calibration of a car: the table ``[hardware.calibration]``.

    The servo position is ``servo_centre`` for steering 0, ``servo_range_left`` away from it for +1 (full left) and
    ``servo_range_right`` away on the other side for -1; ``steering_sign`` is +1 if a larger servo position turns left.
    ``throttle_mode`` "current" drives with ``max_current_a`` at full throttle, "duty" with ``max_duty``; a negative
    throttle drives backwards. ``throttle_sign`` is -1 if the motor is wired backwards. ``throttle_dead_band`` is the
    share of full throttle that the car needs before it moves; it is added to every throttle that is not zero.
    Neutral (steering 0 and throttle 0) is zero current, or ``neutral_brake_a`` of brake current (at most
    ``max_brake_a``), and the centred servo. Throttle 0 with another steering does not brake.
    """

    servo_centre: float = 0.5
    servo_range_left: float = 0.3
    servo_range_right: float = 0.3
    steering_sign: Literal[-1, 1] = 1
    servo_min: float = 0.15
    servo_max: float = 0.85
    throttle_mode: Literal["current", "duty"] = "current"
    max_current_a: float = 10.0
    max_brake_a: float = 10.0
    neutral_brake_a: float = 0.0
    max_duty: float = 0.2
    throttle_sign: Literal[-1, 1] = 1
    throttle_dead_band: float = 0.0

    def __post_init__(self) -> None:
        """Raise ConfigError for a calibration whose commands exceed its limits."""
        if not 0.0 <= self.servo_min < self.servo_max <= 1.0:
            raise ConfigError(
                f"servo_min {self.servo_min:g} and servo_max {self.servo_max:g} must satisfy 0 <= min < max <= 1."
            )
        for name in ("servo_range_left", "servo_range_right", "max_current_a", "max_duty"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ConfigError(f"{name} is {getattr(self, name):g}; it must be positive.")
        for text, end in (
            ("the centre", self.servo_centre),
            ("full left", self.servo_centre + self.steering_sign * self.servo_range_left),
            ("full right", self.servo_centre - self.steering_sign * self.servo_range_right),
        ):
            if not self.servo_min - 1e-9 <= end <= self.servo_max + 1e-9:
                raise ConfigError(
                    f"Servo position {end:g} at {text} is outside servo_min {self.servo_min:g} ... servo_max "
                    f"{self.servo_max:g}; reduce the range on that side or move the centre."
                )
        if self.max_duty > 1.0 or self.max_current_a > 1000.0:
            raise ConfigError("max_duty must be at most 1 and max_current_a at most 1000 A.")
        if not 0.0 <= self.neutral_brake_a <= self.max_brake_a <= 1000.0:
            raise ConfigError(
                f"neutral_brake_a {self.neutral_brake_a:g} must lie between 0 and max_brake_a {self.max_brake_a:g}."
            )
        if not 0.0 <= self.throttle_dead_band < 0.9:
            raise ConfigError(f"throttle_dead_band is {self.throttle_dead_band:g}; it must lie in [0, 0.9).")

    @property
    def neutral(self) -> DeviceCommand:
        """Neutral: no motor current (or the brake current ``neutral_brake_a``), servo at its centre."""
        servo = round(self.servo_centre * SERVO_SCALE)
        if self.neutral_brake_a > 0.0:
            return DeviceCommand(MotorKind.BRAKE, round(self.neutral_brake_a * CURRENT_SCALE), servo)
        return DeviceCommand(MotorKind.CURRENT, 0, servo)

    def to_device(self, action: Action) -> DeviceCommand:
        """Convert an action to device steps, clamped to [-1, 1] and to the limits.

        Raises ActionOutOfRangeError for an action that is not a number.
        """
        if not action.is_finite:
            raise ActionOutOfRangeError(f"{action} is not a number; the policy that made it has diverged.")
        if action.is_neutral and self.neutral_brake_a > 0.0:
            return self.neutral
        steering = min(1.0, max(-1.0, action.steering))
        throttle = min(1.0, max(-1.0, action.throttle))
        span = self.servo_range_left if steering >= 0.0 else self.servo_range_right
        servo = self.servo_centre + self.steering_sign * steering * span
        servo_steps = round(min(self.servo_max, max(self.servo_min, servo)) * SERVO_SCALE)
        drive = 0.0
        if throttle != 0.0:
            band = self.throttle_dead_band
            drive = self.throttle_sign * math.copysign(band + (1.0 - band) * abs(throttle), throttle)
        motor_steps = round(drive * self._full_steps)
        return DeviceCommand(self._motor_kind, motor_steps, servo_steps)

    def from_device(self, command: DeviceCommand) -> Action:
        """Convert a device command to an action: the inverse of ``to_device`` within one device step."""
        return Action(
            self.steering_of(command.servo_position), self.throttle_of(command.motor_kind, command.motor_steps)
        )

    def steering_of(self, servo_position: float) -> float:
        """Steering in [-1, 1] at a servo position."""
        offset = self.steering_sign * (servo_position - round(self.servo_centre * SERVO_SCALE) / SERVO_SCALE)
        steering = offset / (self.servo_range_left if offset >= 0.0 else self.servo_range_right)
        return min(1.0, max(-1.0, steering))

    def throttle_of(self, kind: MotorKind, steps: float) -> float:
        """Throttle in [-1, 1] of a motor command in device steps; 0 for a brake command."""
        if kind != self._motor_kind or steps == 0:
            return 0.0
        drive = self.throttle_sign * steps / self._full_steps
        band = self.throttle_dead_band
        throttle = max(0.0, (abs(drive) - band) / (1.0 - band))
        return math.copysign(min(1.0, throttle), drive) if throttle else 0.0

    def is_within_limits(self, command: DeviceCommand) -> bool:
        """Whether a device command respects every limit of this calibration; the sender checks each command."""
        low, high = round(self.servo_min * SERVO_SCALE), round(self.servo_max * SERVO_SCALE)
        if not low <= command.servo_steps <= high:
            return False
        if command.motor_kind == MotorKind.BRAKE:
            return 0 <= command.motor_steps <= round(self.max_brake_a * CURRENT_SCALE)
        if command.motor_kind != self._motor_kind:
            return command == self.neutral
        return abs(command.motor_steps) <= round(self._full_steps)

    @property
    def _motor_kind(self) -> MotorKind:
        return MotorKind.DUTY if self.throttle_mode == "duty" else MotorKind.CURRENT

    @property
    def _full_steps(self) -> float:
        return self.max_duty * DUTY_SCALE if self.throttle_mode == "duty" else self.max_current_a * CURRENT_SCALE
