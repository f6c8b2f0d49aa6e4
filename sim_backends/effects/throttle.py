"""Effects between the throttle command and the motor (speed controller), except lag and delay.

Acting order: dead band, nonlinearity, asymmetry, lag. Throttle in [-1, 1].
"""

from __future__ import annotations

from carlab.core.quantities import FloatArray
from sim_backends.array_ops import Ops, Value
from sim_backends.effects.base import ActuatorEffect, Confusable, EffectParameter, Parameters, ScreeningProbe

_MIN_THROTTLE = 1e-12
_CUBIC_SHARES = (0.0, 1.0)
"""Shares of the cubic term of an "expo" curve: a negative one is a saturation, one above 1 reverses small commands."""


class ThrottleDeadband(ActuatorEffect):
    """``u = sign(u_t) max(|u_t| - width, 0) / (1 - width)``."""

    id = "throttle_deadband"
    represented_by = ("drive_map", "throttle_curve")
    name = "a dead band of the throttle"
    summary = "The motor does not respond to small throttle commands."
    sentence = "the motor does not respond to throttle commands smaller than {width:percent} of full"
    refuted_if = "the car slows down just as strongly when it rolls with no throttle at all (a resistance)"
    command = "throttle"
    order = 10
    parameters = (EffectParameter("width", "1", 0.0, 0.0, 0.99, 0.08),)
    confusable = (
        Confusable(
            "rolling_resistance",
            "coast_down",
            "without throttle a dead band has no effect, while a resistance still slows the car",
        ),
    )

    def apply(self, ops: Ops, command: Value, values: Parameters) -> Value:
        """Nothing within the band, stretched outside."""
        width = values["width"]
        outside = (command - ops.sign(command) * width) / (1.0 - width)
        return ops.where(ops.abs(command) < width, 0.0 * command, outside)


class ThrottleNonlinearity(ActuatorEffect):
    """``u = sign(u_t) |u_t|^exponent``, or with the curve "expo" ``u = (1 - k) u_t + k u_t^3``, k = (exponent - 1) / 2.

    "expo" is the curve of remote controls, with k between 0 and 1. Both are linear with exponent 1 and cubic with
    exponent 3.
    """

    id = "throttle_nonlinearity"
    represented_by = ("drive_map", "throttle_curve")
    name = "a curved throttle response"
    summary = "The motor's force is not proportional to the throttle command."
    sentence = (
        "the motor's force is not proportional to the throttle; it follows the {curve:choice power|expo} curve with "
        "exponent {exponent} (an expo curve with exponent n has a cubic share of (n - 1) / 2)"
    )
    refuted_if = "the curve has a sharp corner (a dead band or a limit) rather than a bend over the whole range"
    command = "throttle"
    order = 20
    parameters = (
        EffectParameter("exponent", "1", 1.0, 0.0, 5.0, 1.3, positive=True),
        EffectParameter("curve", "1", 0.0, 0.0, 1.0, 0.0, choices=("power", "expo")),
    )
    confusable = (
        Confusable(
            "motor_saturation",
            "throttle_ramp",
            "a limit is a corner in the force over the throttle, a curve bends over the whole range",
        ),
        Confusable(
            "throttle_deadband",
            "throttle_ramp",
            "a dead band is a corner at small throttle, a curve bends over the whole range",
        ),
    )

    def screening_points(self, probe: ScreeningProbe) -> FloatArray:
        """Powers above and below 1, and the other curve."""
        curves = ({"exponent": e, "curve": c} for e, c in ((1.0, 0.0), (-1.0, 0.0), (1.0, 1.0)))
        return probe.points(probe.sized(curves, held=("curve",)))

    def apply(self, ops: Ops, command: Value, values: Parameters) -> Value:
        """The curve; the power has no derivative at zero, so there it is the command itself."""
        size = ops.abs(command)
        large = size > _MIN_THROTTLE
        power = ops.pow(ops.where(large, size, 1.0), values["exponent"])
        cubic = ops.clip(0.5 * (values["exponent"] - 1.0), *_CUBIC_SHARES)
        expo = command + cubic * command * (size * size - 1.0)
        return ops.where(values["curve"] < 0.5, ops.where(large, ops.sign(command) * power, command), expo)


class ThrottleAsymmetry(ActuatorEffect):
    """``u = gain_ratio u_t`` for a negative throttle ``u_t``; motor controllers have such a setting for reverse."""

    id = "throttle_asymmetry"
    represented_by = ("drive_map", "throttle_curve")
    name = "a gain in reverse that differs from the forward gain"
    summary = "The motor's gain differs between forward and reverse throttle."
    sentence = "in reverse, the motor has {gain_ratio} times the force that it has forwards at the same throttle"
    refuted_if = "the car is as fast backwards as forwards at the same throttle"
    command = "throttle"
    order = 25
    parameters = (EffectParameter("gain_ratio", "1", 1.0, 0.0, 10.0, 1.5),)
    confusable = (
        Confusable(
            "brake_asymmetry",
            "throttle_steps",
            "a weak reverse drives the car slowly backwards too; a weak brake only brakes less",
        ),
    )

    def apply(self, ops: Ops, command: Value, values: Parameters) -> Value:
        """Scale a negative throttle."""
        return ops.where(command < 0.0, values["gain_ratio"] * command, command)
