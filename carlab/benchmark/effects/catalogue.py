"""Effects that may be concealed: ids, confusable effects, and the class of a form. Only ids of the catalogue count."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from carlab.benchmark.world.base_car import BaseCar
from carlab.benchmark.world.physics import Instant, World

Parameters = Mapping[str, float]
Attach = Callable[[World, Parameters], None]
FormName = Literal["catalogue", "other", "outside", "random"]

# Confusable effects of each effect.
CONFUSABLE: dict[str, tuple[str, ...]] = {
    "command_delay": ("mocap_latency",),
    "steering_delay": ("steering_lag",),
    "throttle_delay": ("motor_lag",),
    "steering_lag": ("steering_delay", "steering_rate_limit", "tyre_relaxation"),
    "steering_rate_limit": ("steering_lag",),
    "steering_deadband": ("steering_backlash",),
    "steering_backlash": ("steering_deadband",),
    "steering_offset": ("lateral_bias", "mocap_yaw_misalignment"),
    "steering_asymmetry": ("steering_offset",),
    "steering_nonlinearity": ("tyre_saturation",),
    "throttle_deadband": ("rolling_resistance",),
    "throttle_nonlinearity": ("motor_saturation", "throttle_deadband"),
    "throttle_asymmetry": ("brake_asymmetry",),
    "motor_lag": ("throttle_delay",),
    "motor_saturation": ("throttle_nonlinearity", "traction_limit"),
    "traction_limit": ("motor_saturation", "friction_ellipse"),
    "all_wheel_drive": ("friction_ellipse", "load_transfer"),
    "brake_asymmetry": ("throttle_asymmetry",),
    "battery_sag": ("friction_drift",),
    "rolling_resistance": ("throttle_deadband",),
    "aerodynamic_drag": ("motor_saturation",),
    "cornering_drag": (),
    "wheelbase": (),
    "centre_of_mass": ("marker_offset",),
    "tyre_saturation": ("steering_nonlinearity",),
    "front_wheel_play": ("steering_deadband", "steering_backlash"),
    "friction_ellipse": ("load_transfer",),
    "combined_slip": ("friction_ellipse", "traction_limit", "speed_controller", "longitudinal_slip"),
    "longitudinal_slip": ("motor_lag", "traction_limit"),
    "tyre_relaxation": ("steering_lag",),
    "load_transfer": ("friction_ellipse",),
    "roll_dynamics": ("load_transfer",),
    "friction_drift": ("battery_sag",),
    "low_friction_patch": (),
    "aerodynamic_downforce": (),
    "yaw_damping": (),
    "torque_steer": (),
    "lateral_bias": ("steering_offset",),
    "road_slope": ("lateral_bias",),
    "mocap_latency": ("command_delay",),
    "marker_offset": ("centre_of_mass",),
    "mocap_yaw_misalignment": ("steering_offset",),
    "velocity_filter_lag": ("motor_lag", "steering_lag"),
    "speed_controller": ("motor_saturation", "traction_limit"),
    "drag_brake": ("rolling_resistance", "throttle_deadband"),
}
EFFECT_IDS = tuple(CONFUSABLE)
LAG_PARAMETERS = {
    "command_delay": "extra_delay",
    "steering_delay": "delay",
    "throttle_delay": "delay",
    "steering_lag": "time_constant",
    "motor_lag": "time_constant",
    "velocity_filter_lag": "time_constant",
}
DRIFTS = ("battery_sag", "friction_drift")


def are_confusable(a: str, b: str) -> bool:
    """Whether two effects are confusable."""
    return b in CONFUSABLE.get(a, ()) or a in CONFUSABLE.get(b, ())


@dataclass(frozen=True)
class Draw:
    """Random draws of a concealed effect except its size."""

    car: BaseCar
    sign: float
    shares: tuple[float, float, float]
    place: tuple[float, float]

    @classmethod
    def from_rng(
        cls, rng: np.random.Generator, car: BaseCar, places: np.ndarray[tuple[int, ...], np.dtype[np.float64]]
    ) -> Draw:
        """Draw sign, three shares in [0, 1] and one of the places (N, 2) [m] on the track."""
        place = places[int(rng.integers(len(places)))]
        shares = rng.random(3)
        return cls(
            car,
            float(rng.choice((-1.0, 1.0))),
            (float(shares[0]), float(shares[1]), float(shares[2])),
            (float(place[0]), float(place[1])),
        )


@dataclass(frozen=True)
class Form:
    """One form of one effect.

    ``sized`` turns a size (0: identity, growing with the effect) into parameters; in the catalogue form these are the
    catalogue's. ``attach`` puts the effect into a world; a form that ``changes_car`` is attached before the others,
    because those read the dimensions of the car. ``typical`` and ``largest`` are sizes: where the search for a
    strength begins, and beyond which nothing is sensible; below ``smallest`` the equations are too stiff to integrate.
    """

    id: str
    form: FormName
    sized: Callable[[float, Draw], dict[str, float]]
    attach: Attach
    typical: float
    largest: float
    fixed: Mapping[str, str] | None = None
    nominal_kind: Literal["dynamic", "linear_tyre"] = "dynamic"
    class_words: tuple[tuple[str, ...], ...] = ()
    smallest: float = 0.0
    changes_car: bool = False


def hook(stage: str, *, first: bool = False) -> Callable[[Callable[[Instant, Parameters, BaseCar], None]], Attach]:
    """Decorate an effect without states of its own, which changes the variables of ``stage`` (see ``Instant``).

    Args:
        stage: stage of the equations of motion.
        first: the effect comes before the other effects of the stage.
    """

    def decorate(change: Callable[[Instant, Parameters, BaseCar], None]) -> Attach:
        def attach(world: World, p: Parameters) -> None:
            hooks = world.hooks[stage]
            hooks.insert(0 if first else len(hooks), lambda now: change(now, p, world.car))

        return attach

    return decorate


def plain(key: str) -> Callable[[float, Draw], dict[str, float]]:
    """The size is the parameter."""
    return lambda size, draw: {key: size}


def signed(key: str) -> Callable[[float, Draw], dict[str, float]]:
    """The size with the drawn sign is the parameter."""
    return lambda size, draw: {key: draw.sign * size}


def inverse(key: str) -> Callable[[float, Draw], dict[str, float]]:
    """The parameter is one over the size: identity at infinity."""
    return lambda size, draw: {key: 1.0 / max(size, 1e-9)}


def heading(key: str, angle_key: str) -> Callable[[float, Draw], dict[str, float]]:
    """The size, and a random heading [rad]."""
    return lambda size, draw: {key: size, angle_key: math.pi * (2.0 * draw.shares[0] - 1.0)}


def factor(key: str) -> Callable[[float, Draw], dict[str, float]]:
    """The parameter is exp(+-size): identity at 1."""
    return lambda size, draw: {key: float(np.exp(draw.sign * size))}
