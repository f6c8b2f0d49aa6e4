"""Named forms of measured curves: equations with a few parameters that textbooks and data sheets have names for.

Each form is a function of the inputs of its curve, in the curve's unit. Sources: Pacejka 2012, "Tire and Vehicle
Dynamics", ch. 1 and 4 (tyre curve, friction ellipse); the equivalent circuit of a DC motor (drive force that falls with
speed).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from carlab.core.quantities import FloatArray
from sim_backends.array_ops import ARRAYS
from sim_backends.effects.curves import DriveMap, FrontTyreMap, RearTyreMap, SteeringCurve
from sim_backends.effects.drive import (
    DragBrake,
    MotorSaturation,
    SpeedController,
    drag_brake_share,
    limited_by_direction,
)
from sim_backends.effects.steering import SteeringAsymmetry, SteeringDeadband, SteeringNonlinearity
from sim_backends.effects.throttle import ThrottleAsymmetry, ThrottleDeadband, ThrottleNonlinearity

SLOW_MPS = 0.1
"""Speed below which dry friction falls to 0, so that a form is continuous."""
MIN_WIDTH = 1e-6
"""Smallest throttle at which a drag brake ends."""


@dataclass(frozen=True, slots=True)
class FormParameter:
    """A parameter of a form: name in the text, unit, values at which a fit starts, and bounds, both in ``unit``."""

    name: str
    unit: str
    starts: tuple[float, ...]
    low: float = 0.0
    high: float = np.inf


@dataclass(frozen=True, slots=True)
class Form:
    """A named form: id, a noun phrase, its parameters, and the function of parameters and inputs.

    ``function`` receives the p parameters, then the inputs; their shapes broadcast.
    """

    id: str
    name: str
    parameters: tuple[FormParameter, ...]
    function: Callable[..., FloatArray]

    def value(self, parameters: FloatArray, inputs: tuple[FloatArray, ...]) -> FloatArray:
        """Values of the form.

        Args:
            parameters: (p,), or (p, m, 1) for m sets; with a further axis of length 1 for inputs (A, B).
            inputs: each (n,), or each (A, B).

        Returns:
            (n,) or (A, B); (m, n) or (m, A, B) for m sets.
        """
        shape = np.broadcast_shapes(*(np.shape(p) for p in parameters), inputs[0].shape)
        return np.broadcast_to(self.function(*parameters, *inputs), shape)


def dead_band(x: FloatArray, width: float) -> FloatArray:
    """0 within the band, stretched outside so that 1 stays 1 (as the effect ``throttle_deadband``); ``x`` (...)."""
    return np.asarray(np.sign(x) * np.maximum(np.abs(x) - width, 0.0) / (1.0 - width))


def power(x: FloatArray, exponent: float) -> FloatArray:
    """``sign(x) |x|^exponent``, element by element of ``x`` (...)."""
    return np.asarray(np.sign(x) * np.abs(x) ** exponent)


def _saturated_drive(
    gain: float, brake: float, drive: float, damping: float, u: FloatArray, v: FloatArray
) -> FloatArray:
    return np.clip(gain * u, -brake, drive) - damping * v


def _drag_brake(gain: float, damping: float, width: float, brake: float, u: FloatArray, v: FloatArray) -> FloatArray:
    share = drag_brake_share(ARRAYS, u, v, np.maximum(width, MIN_WIDTH))
    return np.asarray(gain * dead_band(u, width) - damping * v + brake * share)


def _speed_controller(
    speed: float, width: float, gain: float, brake: float, drive: float, u: FloatArray, v: FloatArray
) -> FloatArray:
    return np.asarray(limited_by_direction(ARRAYS, gain * (speed * dead_band(u, width) - v), drive, brake, 0.0))


def _dc_motor(
    stall: float, fall: float, width: float, friction: float, damping: float, u: FloatArray, v: FloatArray
) -> FloatArray:
    motor = (stall - fall * v) * dead_band(u, width)
    return np.asarray(motor - friction * np.clip(v / SLOW_MPS, -1.0, 1.0) - damping * v)


def _two_slopes(negative: float, positive: float, x: FloatArray) -> FloatArray:
    return np.where(x < 0.0, negative, positive) * x


_GAIN = FormParameter("gain", "m/s2", (4.0, 15.0))
_DAMPING = FormParameter("damping", "1/s", (0.5,), -5.0)
_WIDTH = FormParameter("dead band", "1", (0.05, 0.15), 0.0, 0.6)
_BRAKE = FormParameter("braking limit", "m/s2", (4.0,))
_DRIVE = FormParameter("driving limit", "m/s2", (4.0,))
_EXPONENT = FormParameter("exponent", "1", (0.6, 1.5), 0.1, 5.0)
_STEERING_GAIN = FormParameter("gain", "1", (1.0,))
_STIFFNESS = FormParameter("cornering stiffness per load", "1/rad", (5.0,))
_GRIP = FormParameter("grip", "1", (0.6,), 0.0, 5.0)

DRIVE_FORMS = (
    Form("linear_drive", "a drive force proportional to throttle, with viscous damping", (_GAIN, _DAMPING),
         lambda gain, damping, u, v: gain * u - damping * v),
    Form(ThrottleDeadband.id, "a throttle dead band", (_GAIN, _WIDTH, _DAMPING),
         lambda gain, width, damping, u, v: gain * dead_band(u, width) - damping * v),
    Form(ThrottleNonlinearity.id, "an exponent of the throttle", (_GAIN, _EXPONENT, _DAMPING),
         lambda gain, exponent, damping, u, v: gain * power(u, exponent) - damping * v),
    Form(ThrottleAsymmetry.id, ThrottleAsymmetry.name,
         (FormParameter("forward gain", "m/s2", (4.0, 15.0)), FormParameter("gain in reverse", "m/s2", (4.0, 15.0)),
          _DAMPING),
         lambda forward, reverse, damping, u, v: _two_slopes(reverse, forward, u) - damping * v),
    Form(MotorSaturation.id, "a limit of the motor's force", (_GAIN, _BRAKE, _DRIVE, _DAMPING), _saturated_drive),
    Form(DragBrake.id, DragBrake.name,
         (_GAIN, _DAMPING, _WIDTH, FormParameter("brake", "m/s2", (2.0,))), _drag_brake),
    Form(SpeedController.id, SpeedController.name,
         (FormParameter("speed at full throttle", "m/s", (3.0, 12.0)), _WIDTH,
          FormParameter("controller gain", "1/s", (2.0, 8.0)), _BRAKE, _DRIVE), _speed_controller),
    Form("dc_motor", "a DC motor, whose force falls with speed, with dead band and dry friction",
         (FormParameter("acceleration at rest", "m/s2", (6.0, 15.0)), FormParameter("fall with speed", "1/s", (2.0,)),
          _WIDTH, FormParameter("dry friction", "m/s2", (0.5,)), _DAMPING), _dc_motor),
)  # fmt: skip
STEERING_FORMS = (
    Form("linear_steering", "a constant gain of the steering", (_STEERING_GAIN,), lambda gain, d: gain * d),
    Form(SteeringAsymmetry.id, "an asymmetry of the steering",
         (FormParameter("gain to the right", "1", (1.0,)), FormParameter("gain to the left", "1", (1.0,))),
         _two_slopes),
    Form(SteeringNonlinearity.id, "a saturation of the steering towards full lock",
         (_STEERING_GAIN, FormParameter("limit", "rad", (0.3, 0.6), 1e-3)),
         lambda gain, limit, d: limit * np.tanh(gain * d / limit)),
    Form(SteeringDeadband.id, "a dead band of the steering",
         (_STEERING_GAIN, FormParameter("dead band", "rad", (0.03, 0.1), 0.0, 0.4)),
         lambda gain, width, d: gain * np.sign(d) * np.maximum(np.abs(d) - width, 0.0)),
    Form("steering_exponent", "an exponent of the steering",
         (FormParameter("angle at 1 rad", "rad", (1.0,)), _EXPONENT),
         lambda gain, exponent, d: gain * power(d, exponent)),
)  # fmt: skip
TYRE_FORMS = (
    Form("linear_tyre", "a linear tyre", (_STIFFNESS,), lambda stiffness, slip: stiffness * slip),
    Form("limited_tyre", "a linear tyre up to a limit of grip", (_STIFFNESS, _GRIP),
         lambda stiffness, grip, slip: np.minimum(stiffness * slip, grip)),
    Form("saturating_tyre", "a tyre that saturates", (_STIFFNESS, _GRIP),
         lambda stiffness, grip, slip: grip * np.tanh(stiffness * slip / np.maximum(grip, 1e-9))),
    Form("pacejka_tyre", "a Pacejka tyre",
         (_GRIP, FormParameter("B", "1/rad", (6.0,)), FormParameter("C", "1", (1.5,), 0.5, 2.5)),
         lambda grip, b, c, slip: grip * np.sin(c * np.arctan(b * slip))),
)  # fmt: skip


def _with_ellipse(tyre: Form) -> tuple[Form, Form]:
    """The tyre with a friction ellipse of one limit, and of different limits of braking and driving."""

    def shared(*values: Any) -> FloatArray:
        *own, limit, x, slip = values
        return np.asarray(tyre.function(*own, slip) * np.sqrt(np.maximum(1.0 - (x / limit) ** 2, 0.0)))

    def shared_by_two(*values: Any) -> FloatArray:
        *own, brake, drive, x, slip = values
        return shared(*own, np.where(x < 0.0, brake, drive), x, slip)

    limit, brake, drive = (FormParameter(name, "m/s2", (8.0,), 0.1) for name in _LIMITS)
    name = f"{tyre.name} with a friction ellipse"
    return (
        Form(f"{tyre.id}_friction_ellipse", name, (*tyre.parameters, limit), shared),
        Form(
            f"{tyre.id}_two_limits",
            f"{name} of different limits of braking and driving",
            (*tyre.parameters, brake, drive),
            shared_by_two,
        ),
    )


def _at_any_force(tyre: Form) -> Form:
    return replace(tyre, function=lambda *values: tyre.function(*values[:-2], values[-1]))


_LIMITS = ("longitudinal limit", "braking limit", "driving limit")
TYRE_MAP_FORMS = tuple(form for tyre in TYRE_FORMS for form in (_at_any_force(tyre), *_with_ellipse(tyre)))
FORMS: Mapping[str, tuple[Form, ...]] = {
    DriveMap.id: DRIVE_FORMS,
    SteeringCurve.id: STEERING_FORMS,
    FrontTyreMap.id: TYRE_MAP_FORMS,
    RearTyreMap.id: TYRE_MAP_FORMS,
}
"""Forms by the id of a measured curve, the simplest first."""
