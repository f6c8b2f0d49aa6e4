"""First-order lags of the actuators, stepped exactly."""

from __future__ import annotations

from sim_backends.array_ops import Ops, Value
from sim_backends.effects.base import ActuatorEffect, EffectParameter, Parameters, Triple
from sim_backends.effects.first_order import lag_weights


class FirstOrderLag(ActuatorEffect):
    """``time_constant * dy/dt = command - y``, by its closed form (``first_order``)."""

    has_state = True
    parameters = (EffectParameter("time_constant", "s", 0.0, 0.0, 5.0, 0.08),)

    def step(
        self, ops: Ops, command: Triple, state: Value, duration_s: Value, values: Parameters
    ) -> tuple[Triple, Value]:
        """Exponential approach; a time constant of zero passes the command on unchanged."""
        start, middle, end = command
        weights = lag_weights(ops, values["time_constant"], duration_s)
        first = start + (state - start) * weights.start
        if start is middle and middle is end:
            central = start + (state - start) * weights.decay
            last = start + (state - start) * (weights.decay * weights.decay)
        else:
            central = weights.after_half(state, start, middle)
            last = weights.after_half(central, middle, end)
        return (first, central, last), last


class SteeringLag(FirstOrderLag):
    """The wheel angle follows the steering servo's command with a lag."""

    id = "steering_lag"
    sentence = "The steering servo lags behind its command."
    channel = "steering"
    order = 30
    look_alikes = ("steering_delay", "steering_rate_limit", "tyre_relaxation")


class MotorLag(FirstOrderLag):
    """The drive force follows the throttle with a lag."""

    id = "motor_lag"
    sentence = "The motor's force lags behind the throttle."
    channel = "throttle"
    order = 30
    look_alikes = ("throttle_delay",)
