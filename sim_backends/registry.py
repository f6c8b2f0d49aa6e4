"""Every number of a simulator by its dotted name, with unit, default and physical bounds.

The names are those of the car file (``motor.drive_gain``, ``effects.steering_lag.time_constant``), so that system
identification, the prior over simulators and the diagnosis treat every number alike.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from dataclasses import dataclass

from carlab.core.errors import ConfigError
from sim_backends.effects import CATALOGUE, EFFECTS, Effect


@dataclass(frozen=True, slots=True)
class ParameterInfo:
    """One number of the car file.

    ``default`` applies if the file does not state the number; None if the number ``same_as`` replaces it. ``positive``
    excludes ``low`` itself. A choice among ``choices`` is a word in car files and its position elsewhere.
    """

    name: str
    unit: str
    default: float | None
    low: float
    high: float
    positive: bool = False
    field: str = ""
    same_as: str = ""
    choices: tuple[str, ...] = ()

    def number(self, value: object, where: str = "the simulator") -> float:
        """Convert a value of a car file to a number; a choice becomes its position. Raises ConfigError."""
        if isinstance(value, str) and value in self.choices:
            return float(self.choices.index(value))
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            expected = f"one of {', '.join(map(repr, self.choices))}" if self.choices else "a number"
            raise ConfigError(f"{self.name} of {where} must be {expected}, not {value!r}.")
        return float(value)

    def problem(self, value: float) -> str | None:
        """Message with the remedy if ``value`` is invalid; None if it is valid."""
        if self.choices and value not in range(len(self.choices)):
            return f"{self.name} is {value:g}; it must be one of {', '.join(self.choices)}, by position from 0."
        if math.isnan(value) or (math.isinf(value) and not self.name.startswith("effects.")):
            return f"{self.name} is {value}; give a finite number in {self.unit}."
        if value < self.low or (self.positive and value <= self.low):
            bound = f"greater than {self.low:g}" if self.positive else f"at least {self.low:g}"
            return f"{self.name} is {value:g} {self.unit}; it must be {bound} (SI units: is it in another unit?)."
        if value > self.high:
            return f"{self.name} is {value:g} {self.unit}; it must be at most {self.high:g} (is it in another unit?)."
        return None


MIN_MASS_KG = 0.05
"""Lower limit of the mass [kg]: the smallest model cars (1:64) weigh about as much. It refuses a mass in tonnes."""

_INF = math.inf
_BASE = (
    ParameterInfo("vehicle.mass", "kg", 1.65, MIN_MASS_KG, 500.0, True, "mass_kg"),
    ParameterInfo("vehicle.yaw_inertia", "kg m2", 0.06, 0.0, _INF, True, "yaw_inertia_kgm2"),
    ParameterInfo("vehicle.front_axle", "m", 0.13, 0.0, 10.0, True, "front_axle_m"),
    ParameterInfo("vehicle.rear_axle", "m", 0.17, 0.0, 10.0, True, "rear_axle_m"),
    ParameterInfo("tyre.front.B", "1/rad", 2.75, 0.0, _INF, True, "front_b"),
    ParameterInfo("tyre.front.C", "1", 1.45, 0.0, _INF, True, "front_c"),
    ParameterInfo("tyre.front.mu", "1", 0.43, 0.0, _INF, False, "front_mu"),
    ParameterInfo("tyre.rear.B", "1/rad", 5.0, 0.0, _INF, True, "rear_b"),
    ParameterInfo("tyre.rear.C", "1", 1.3, 0.0, _INF, True, "rear_c"),
    ParameterInfo("tyre.rear.mu", "1", 0.42, 0.0, _INF, False, "rear_mu"),
    ParameterInfo("motor.drive_gain", "N", 8.2, 0.0, _INF, False, "drive_gain_n"),
    ParameterInfo("motor.damping", "N s/m", 1.56, 0.0, _INF, False, "damping_nspm"),
    ParameterInfo("steering.max_angle", "rad", 0.6, 0.0, 1.5, True, "max_angle_rad"),
    ParameterInfo("timing.control_period", "s", 0.0333333333, 0.0, 10.0, True, "control_period_s"),
    ParameterInfo("timing.command_delay", "s", 0.08, 0.0, 10.0, False, "command_delay_s"),
    ParameterInfo("mocap.rate", "Hz", 120.0, 0.0, 10_000.0, True, "rate_hz"),
    ParameterInfo("mocap.position_std", "m", 0.0003, 0.0, _INF, False, "position_std_m"),
    ParameterInfo("mocap.yaw_std", "rad", 0.002, 0.0, math.pi, False, "yaw_std_rad"),
    ParameterInfo("mocap.latency", "s", 0.008, 0.0, 1.0, False, "latency_s"),
    ParameterInfo("mocap.dropout", "1", 0.0, 0.0, 1.0, False, "dropout"),
)


def _numbers_of(effect: Effect) -> dict[str, ParameterInfo]:
    return {
        (name := f"effects.{effect.id}.{p.name}"): ParameterInfo(
            name, p.unit, p.identity, p.low, p.high, p.positive, same_as=p.same_as, choices=p.choices
        )
        for p in effect.parameters
    }


REGISTRY: dict[str, ParameterInfo] = {info.name: info for info in _BASE}
for _effect in EFFECTS.values():
    REGISTRY |= _numbers_of(_effect)


def register(effect: Effect) -> None:
    """Add an effect to car files, all engines, the diagnosis, its reports, and the prior of learning.

    Raises:
        ConfigError: it is a class, has an invalid or known id, has no parameters, lacks a method, or changes nothing.
    """
    if isinstance(effect, type):
        raise ConfigError(f"The effect {effect.__name__} is a class; give an object of it, {effect.__name__}().")
    if not (name := getattr(effect, "id", "")).isidentifier():
        raise ConfigError(
            f"The id of the effect {type(effect).__name__} is {name!r}; set id in its class, of letters, digits and _."
        )
    if effect.id in EFFECTS:
        raise ConfigError(f"There is an effect '{effect.id}' already; choose another id for the new effect.")
    if not effect.parameters:
        raise ConfigError(f"Effect '{effect.id}' has no parameters; give it at least one EffectParameter.")
    method = effect.required_method()
    if method and getattr(type(effect), method).__module__ == Effect.__module__:
        raise ConfigError(f"Effect '{effect.id}' has no method '{method}'; define it in the class of the effect.")
    _check_equation(effect)
    EFFECTS[effect.id] = effect
    if effect.catalogued:
        CATALOGUE[effect.id] = effect
    REGISTRY.update(_numbers_of(effect))


def _check_equation(effect: Effect) -> None:
    """Raise ConfigError if the class of an effect overrides no method of its base class."""
    base = next(cls for cls in type(effect).__mro__ if cls.__module__ == Effect.__module__)
    methods = [name for name, method in vars(base).items() if callable(method) and name != "required_method"]
    if methods and all(getattr(type(effect), name) is getattr(base, name) for name in methods):
        raise ConfigError(
            f"Effect '{effect.id}' changes nothing; define at least one of the methods {', '.join(methods)}."
        )


@contextlib.contextmanager
def registered(*effects: Effect) -> Iterator[None]:
    """Register effects for the time of a ``with`` block. Raises ConfigError as ``register``."""
    known: list[Effect] = []
    try:
        for effect in effects:
            register(effect)
            known.append(effect)
        yield
    finally:
        for effect in known:
            EFFECTS.pop(effect.id)
            CATALOGUE.pop(effect.id, None)
            for name in _numbers_of(effect):
                REGISTRY.pop(name)


def section(prefix: str) -> dict[str, ParameterInfo]:
    """The entries directly under a table, by their last name: ``section("tyre.front")`` has B, C and mu."""
    start = prefix + "."
    return {
        name.removeprefix(start): info
        for name, info in REGISTRY.items()
        if name.startswith(start) and "." not in name.removeprefix(start)
    }
