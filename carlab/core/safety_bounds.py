"""Upper bounds of the safety limits: a larger limit has another unit, or disables its guard."""

from __future__ import annotations

import math
from dataclasses import dataclass

from carlab.core.errors import ConfigError


@dataclass(frozen=True, slots=True)
class Bound:
    """Largest value of a limit, with its unit as in messages."""

    high: float
    unit: str


@dataclass(frozen=True, slots=True)
class SafetyBounds:
    """Largest values of the limits of a car file, in SI units.

    They apply to cars up to the size of a large model car. Each is several times the default of its limit, and smaller
    than the default in the next smaller unit (milliseconds, millimetres, degrees).
    """

    deadline: Bound = Bound(2.0, "s")
    """Ages of poses, telemetry and commands, and the reaction time: at 5 m/s a car drives 10 m in this time."""
    speed: Bound = Bound(30.0, "m/s")
    """The fastest model cars in use for research stay below it; a number in km/h that exceeds it is found."""
    deceleration: Bound = Bound(20.0, "m/s2")
    """A tyre with a friction coefficient of 2 does not exceed it; the stopping distance must not vanish."""
    yaw_rate: Bound = Bound(100.0, "rad/s")
    """Five times the default, below the default in degrees (1146)."""
    jump_distance: Bound = Bound(2.0, "m")
    """A larger jump is another body."""
    jump_angle: Bound = Bound(math.pi, "rad")
    """The largest difference of two angles."""
    command_rate: Bound = Bound(1000.0, "1/s")
    """A faster command passes its whole range within a millisecond, so the rate is not limited."""
    rest_speed: Bound = Bound(1.0, "m/s")
    """A car that is armed at a higher speed is not at rest, whatever the noise of the speed."""
    rest_motor_speed: Bound = Bound(10_000.0, "eRPM")
    """Above it the motor of every model car turns."""


SAFETY_BOUNDS = SafetyBounds()


def check_bound(name: str, where: str, value: float, bound: Bound) -> None:
    """Raise ConfigError if limit ``name`` of the table ``where`` is not finite, negative, or beyond its bound."""
    if not math.isfinite(value):
        raise ConfigError(f"{name} in {where} is {value}; give a finite number of at most {bound.high:g} {bound.unit}.")
    if value < 0.0:
        raise ConfigError(f"{name} in {where} is {value:g} {bound.unit}; it must not be below zero.")
    if value > bound.high:
        raise ConfigError(
            f"{name} in {where} is {value:g} {bound.unit}; it must be at most {bound.high:g} {bound.unit} "
            "(is it in another unit?)."
        )
