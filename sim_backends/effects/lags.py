"""First-order lags of the actuators, stepped exactly."""

from __future__ import annotations

from sim_backends.array_ops import Ops, Value
from sim_backends.effects.base import ActuatorEffect, EffectParameter, Parameters, Triple

SHORTEST_S = 1e-15
"""A time constant below this is none: the output follows at once."""


class FirstOrderLag(ActuatorEffect):
    """``time_constant * dy/dt = command - y``, by its closed form: a pole is never integrated numerically.

    Exact for a held command and for one that is linear over each half of the step.
    """

    has_state = True
    parameters = (EffectParameter("time_constant", "s", 0.0, 0.0, 5.0, 0.08),)

    def step(
        self, ops: Ops, command: Triple, state: Value, duration_s: Value, values: Parameters
    ) -> tuple[Triple, Value]:
        """Exponential approach; a time constant of zero passes the command on unchanged."""
        start, middle, end = command
        lagging = values["time_constant"] >= SHORTEST_S
        time_constant_s = ops.floor(values["time_constant"], SHORTEST_S)
        half = 0.5 * duration_s / time_constant_s
        decay = ops.exp(-half)
        first = start + (state - start) * lagging
        if start is middle and middle is end:
            central = start + (state - start) * decay
            last = start + (state - start) * (decay * decay)
            return (first, central, last), last
        # Response to a ramp over one half: y1 = decay y0 + (1 - decay) u0 + (1 - (1 - decay) / half)(u1 - u0).
        ramp = 1.0 - (1.0 - decay) / ops.floor(half, 1e-15)
        central = start + (state - start) * decay + (middle - start) * ramp
        last = middle + (central - middle) * decay + (end - middle) * ramp
        return (first, central, last), last


class SteeringLag(FirstOrderLag):
    """The wheel angle follows the steering servo's command with a lag."""

    id = "steering_lag"
    sentence = "The steering servo lags behind its command."
    channel = "steering"
    order = 90
    look_alikes = ("steering_delay", "steering_rate_limit", "tyre_relaxation")


class MotorLag(FirstOrderLag):
    """The drive force follows the throttle with a lag."""

    id = "motor_lag"
    sentence = "The motor's force lags behind the throttle."
    channel = "throttle"
    order = 90
    look_alikes = ("throttle_delay",)
