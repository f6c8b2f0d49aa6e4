"""Commands that act later than the car file says."""

from __future__ import annotations

from sim_backends.array_ops import Value
from sim_backends.effects.base import DelayEffect, EffectParameter, Parameters


class CommandDelay(DelayEffect):
    """Both commands act ``extra_delay`` later; may be negative as long as the total delay is not."""

    id = "command_delay"
    sentence = "Both commands act later than the car file says."
    parameters = (EffectParameter("extra_delay", "s", 0.0, -1.0, 1.0, 0.03),)
    look_alikes = ("mocap_latency",)

    def extra_delays_s(self, values: Parameters) -> tuple[Value, Value]:
        """Same for both."""
        return values["extra_delay"], values["extra_delay"]


class SteeringDelay(DelayEffect):
    """The steering command acts ``delay`` later."""

    id = "steering_delay"
    sentence = "The steering command acts later than the throttle command."
    parameters = (EffectParameter("delay", "s", 0.0, 0.0, 1.0, 0.03),)
    look_alikes = ("steering_lag",)

    def extra_delays_s(self, values: Parameters) -> tuple[Value, Value]:
        """Steering alone."""
        return values["delay"], 0.0


class ThrottleDelay(DelayEffect):
    """The throttle command acts ``delay`` later."""

    id = "throttle_delay"
    sentence = "The throttle command acts later than the steering command."
    parameters = (EffectParameter("delay", "s", 0.0, 0.0, 1.0, 0.03),)
    look_alikes = ("motor_lag",)

    def extra_delays_s(self, values: Parameters) -> tuple[Value, Value]:
        """Throttle alone."""
        return 0.0, values["delay"]
