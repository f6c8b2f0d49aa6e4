"""What stands between the throttle command and the motor, lag and delay apart: what the speed controller does to it.

Acting order: dead band, nonlinearity, lag. Throttle in [-1, 1].
"""

from __future__ import annotations

from sim_backends.array_ops import Ops, Value
from sim_backends.effects.base import ActuatorEffect, EffectParameter, Parameters

_SMALLEST = 1e-12


class ThrottleDeadband(ActuatorEffect):
    """``u = sign(u_t) max(|u_t| - width, 0) / (1 - width)``."""

    id = "throttle_deadband"
    sentence = "The motor does not answer to small throttle commands."
    channel = "throttle"
    order = 10
    parameters = (EffectParameter("width", "1", 0.0, 0.0, 0.99, 0.08),)
    look_alikes = ("rolling_resistance",)

    def apply(self, ops: Ops, command: Value, values: Parameters) -> Value:
        """Nothing within the band, stretched outside."""
        width = values["width"]
        outside = (command - ops.sign(command) * width) / (1.0 - width)
        return ops.where(ops.abs(command) < width, 0.0 * command, outside)


class ThrottleNonlinearity(ActuatorEffect):
    """``u = sign(u_t) |u_t|^exponent``."""

    id = "throttle_nonlinearity"
    sentence = "The motor's force is not proportional to the throttle command."
    channel = "throttle"
    order = 20
    parameters = (EffectParameter("exponent", "1", 1.0, 0.0, 5.0, 1.3, positive=True),)
    look_alikes = ("motor_saturation", "throttle_deadband")

    def apply(self, ops: Ops, command: Value, values: Parameters) -> Value:
        """Power of the size; at zero, where a power has no derivative, the command itself."""
        size = ops.abs(command)
        large = size > _SMALLEST
        power = ops.pow(ops.where(large, size, 1.0), values["exponent"])
        return ops.where(large, ops.sign(command) * power, command)
