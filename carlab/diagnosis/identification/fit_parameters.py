"""Free parameters of a fit: those of the base model and those of effects, each with a scaled coordinate."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from carlab.core.quantities import FloatArray
from carlab.diagnosis.settings import IDENTIFICATION
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.effects import CATALOGUE, EFFECTS
from sim_backends.measurement import COMMAND_DELAY, LATENCY
from sim_backends.registry import REGISTRY

BASE_PARAMETERS = (
    "vehicle.yaw_inertia",
    "tyre.front.B",
    "tyre.front.C",
    "tyre.front.mu",
    "tyre.rear.B",
    "tyre.rear.C",
    "tyre.rear.mu",
    "motor.drive_gain",
    "motor.damping",
    "steering.max_angle",
)
TYRE_PARAMETERS = tuple(name for name in BASE_PARAMETERS if name.startswith("tyre."))
MIN_POSITIVE_SHARE = 1e-3
"""Smallest value of a parameter that must be positive, over its typical size."""

MAX_EXPONENT = 700.0
"""Largest exponent of a finite number of double precision, rounded down."""
DIFFERENCE_STEP = 0.02
"""Step of a coordinate for finite differences."""
DELAY_DIFFERENCE_STEP = 0.3
"""The same for delays. With measured maps, the prediction of a window that starts at rest is discontinuous in a delay.
A small step would overstate the information of such windows, and the interval of the delay would be too narrow."""


@dataclass(frozen=True, slots=True)
class FitParameter:
    """A free parameter of a fit with coordinate z.

    Attributes:
        name: dotted name.
        origin: value at z = 0.
        size: change of the value (of its logarithm) per unit of z.
        low, high: bounds of the value.
        logarithmic: whether the value is ``origin * exp(size * z)``.
        prior_z: prior standard deviation of z about 0.
        choice: whether the value is the index of a discrete option.
        is_delay: whether the value is a delay or a latency.
    """

    name: str
    origin: float
    size: float
    low: float
    high: float
    logarithmic: bool = False
    prior_z: float = math.inf
    choice: bool = False
    is_delay: bool = False

    def value(self, z: FloatArray) -> FloatArray:
        """Values at coordinates z, both (...)."""
        if self.choice:
            return np.asarray(np.round(np.clip(self.origin + z, self.low, self.high)))
        exponent = np.minimum(self.size * z, MAX_EXPONENT)
        raw = self.origin * np.exp(exponent) if self.logarithmic else self.origin + self.size * z
        return np.asarray(np.clip(raw, self.low, self.high))

    def coordinate(self, value: float) -> float:
        """Coordinate of a value."""
        value = min(max(value, self.low), self.high)
        if self.logarithmic:
            return math.log(max(value, 1e-12) / self.origin) / self.size
        return (value - self.origin) / self.size


def base_parameters(config: SimulatorConfig, *, uses_std: bool = False) -> tuple[FitParameter, ...]:
    """Free base parameters: ``BASE_PARAMETERS``, those with a range in the car file, and an unknown latency or delay.

    Args:
        config: the simulator.
        uses_std: whether a standard deviation in the car file, as a diagnosis writes it, is the width of the prior,
            together with the usual change of a car (``prior_change_share``).
    """
    values = config.values()
    names = list(BASE_PARAMETERS)
    if config.kind == "kinematic":
        names = [name for name in names if name not in (*TYRE_PARAMETERS, "vehicle.yaw_inertia")]
    names += [n for n in config.priors if n not in names and not n.startswith(("effects.", "timing.", "mocap."))]
    found = []
    for name in names:
        info, value = REGISTRY[name], values[name]
        low, high = max(info.low, 0.05 * value), min(info.high, 20.0 * value)
        share = IDENTIFICATION.prior_std_share
        if name in config.priors:
            low, high = config.priors[name]
            share = max((high - low) / (4.0 * abs(value)), 1e-3)
        if uses_std and name in config.parameter_std and value > 0:
            share = min(share, math.hypot(config.parameter_std[name] / value, IDENTIFICATION.prior_change_share))
        if value > 0:
            found.append(FitParameter(name, value, 0.1, low, high, True, share / 0.1))
        else:
            found.append(FitParameter(name, 0.0, 0.1, info.low, 1.0, False))
    if LATENCY in config.unknown:
        found.append(
            FitParameter(
                LATENCY, values[LATENCY], IDENTIFICATION.latency_std_s, 0.0, IDENTIFICATION.max_latency_s, prior_z=1.0,
                is_delay=True,
            )
        )  # fmt: skip
    if COMMAND_DELAY in config.unknown:
        delay_s = values[COMMAND_DELAY]
        found.append(
            FitParameter(
                COMMAND_DELAY, delay_s, IDENTIFICATION.delay_std_s, 0.0, delay_s + IDENTIFICATION.max_added_delay_s,
                prior_z=1.0, is_delay=True,
            )
        )  # fmt: skip
    return tuple(found)


def effect_parameters(effect_id: str, config: SimulatorConfig) -> tuple[FitParameter, ...]:
    """Parameters of one effect; z = 0 is the value that the car file states, or else the identity value.

    A negative extra delay is at most the delay of the car file. A range in the car file bounds its parameter.
    """
    found = []
    values, stated_by_name = config.values(), stated_values(config, effect_id)
    ranges = EFFECTS[effect_id].ranges(values | {name: low for name, (low, _) in config.priors.items()})
    for p in EFFECTS[effect_id].parameters:
        name = f"effects.{effect_id}.{p.name}"
        size = abs(p.typical) or 1.0
        stated = stated_by_name.get(p.name)
        if p.choices:
            found.append(FitParameter(name, stated or 0.0, 1.0, 0.0, len(p.choices) - 1.0, choice=True))
        elif p.identity is not None and math.isinf(p.identity):
            origin = p.typical if stated is None or math.isinf(stated) else stated
            low, high = max(p.low, min(0.02 * p.typical, origin)), max(50.0 * p.typical, origin)
            found.append(FitParameter(name, origin, 0.3, low, high, True))
        else:
            identity = float(values.get(p.same_as, 0.0)) if p.identity is None else p.identity
            origin = identity if stated is None else stated
            low = max(p.low + MIN_POSITIVE_SHARE * size * p.positive, min(identity - 20.0 * size, origin))
            if p.reduces:
                low = max(low, -values[p.reduces])
            high = min(p.high, max(identity + 20.0 * size, origin))
            lowest, highest = ranges.get(p.name, (low, high))
            low, high = max(low, lowest), min(high, highest)
            found.append(FitParameter(name, origin, size, low, high, is_delay=p.is_delay))
    return tuple(_within_range(each, config) for each in found)


def _within_range(parameter: FitParameter, config: SimulatorConfig) -> FitParameter:
    """The parameter with the range of the car file as bounds, if the car file states one."""
    low, high = config.priors.get(parameter.name, (parameter.low, parameter.high))
    return replace(parameter, low=max(parameter.low, low), high=min(parameter.high, high))


def tyre_effects(config: SimulatorConfig) -> tuple[str, ...]:
    """Effects of the car file whose parameters replace those of the tyres; they are base parameters of a fit."""
    return tuple(
        name
        for name in config.effects
        if (own := EFFECTS[name].parameters) and all(p.same_as in TYRE_PARAMETERS for p in own)
    )


def stated_parameters(config: SimulatorConfig) -> tuple[FitParameter, ...]:
    """Base parameters, and those of the effects of the catalogue that the car file states."""
    return (*base_parameters(config), *(f for name in stated_effects(config) for f in effect_parameters(name, config)))


def stated_effects(config: SimulatorConfig) -> tuple[str, ...]:
    """Effects of the catalogue that the car file states, without measured curves and uncatalogued physics."""
    return tuple(name for name in config.effects if name in CATALOGUE)


def stated_values(config: SimulatorConfig, effect_id: str) -> dict[str, float]:
    """Values by parameter that the car file states for an effect; empty without the effect."""
    if effect_id not in config.effects:
        return {}
    values = config.values()
    return {p.name: float(values[f"effects.{effect_id}.{p.name}"]) for p in EFFECTS[effect_id].parameters}


def difference_steps(free: Sequence[FitParameter]) -> FloatArray:
    """Steps (n,) of the coordinates for finite differences."""
    return np.array([DELAY_DIFFERENCE_STEP if f.is_delay else DIFFERENCE_STEP for f in free])


def coordinates_in(config: SimulatorConfig, free: Sequence[FitParameter]) -> FloatArray:
    """Coordinates (n,) of n parameters at the values of a simulator; 0 for a parameter that it lacks."""
    values = config.values()
    return np.array([f.coordinate(values[f.name]) if f.name in values else 0.0 for f in free])


def numbers_at(free: Sequence[FitParameter], z: FloatArray) -> dict[str, float]:
    """Values by dotted name at coordinates z (n,)."""
    return {f.name: float(f.value(np.asarray(v))) for f, v in zip(free, z, strict=True)}


def values_at(free: Sequence[FitParameter], z: FloatArray) -> dict[str, FloatArray]:
    """Values (1,) by dotted name at coordinates z (n,)."""
    return {f.name: np.atleast_1d(f.value(np.asarray(v))) for f, v in zip(free, z, strict=True)}


def with_effect(config: SimulatorConfig, effect_id: str) -> SimulatorConfig:
    """Add an effect at its identity value or, if that is infinite, at a value with no influence.

    An effect that the car file states keeps its values.
    """
    if effect_id in config.effects:
        return config
    effect = EFFECTS[effect_id]
    given = {}
    for p in effect.parameters:
        identity = p.typical if p.identity is None else p.identity
        given[p.name] = min(50.0 * p.typical, p.high) if math.isinf(identity) else identity
    return replace(config, effects={**config.effects, effect_id: given})
