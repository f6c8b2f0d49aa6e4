"""Additional delays of commands."""

from __future__ import annotations

from sim_backends.array_ops import Value
from sim_backends.effects.base import Confusable, DelayEffect, EffectParameter, Parameters


class CommandDelay(DelayEffect):
    """Both commands act ``extra_delay`` later; may be negative as long as the total delay is not."""

    id = "command_delay"
    fitted_with_curves = True
    name = "a command delay that differs from the car file"
    summary = "Both commands act later than the car file states."
    sentence = "both commands act {extra_delay:size} {extra_delay:later|earlier} than the car file states"
    refuted_if = (
        "steering and throttle have different delays, or a delay measured at the car equals that of the car file"
    )
    lag_parameter = "extra_delay"
    split_into = (("steering_delay", "steering_lag"), ("throttle_delay", "motor_lag"))
    parameters = (
        EffectParameter("extra_delay", "s", 0.0, -1.0, 1.0, 0.03, reduces="timing.command_delay", is_delay=True),
    )

    def extra_delays_s(self, values: Parameters) -> tuple[Value, Value]:
        """The same delay for both [s]."""
        return values["extra_delay"], values["extra_delay"]


class SteeringDelay(DelayEffect):
    """The steering command acts ``delay`` later."""

    id = "steering_delay"
    name = "a delay of the steering"
    summary = "The steering command has a delay in addition to that of the car file."
    sentence = "the steering command has an additional delay of {delay}"
    refuted_if = (
        "the wheels start to move at once but reach their angle late, or fast steering has a weaker response than slow"
    )
    lag_parameter = "delay"
    parameters = (EffectParameter("delay", "s", 0.0, 0.0, 1.0, 0.03, is_delay=True),)
    confusable = (
        Confusable(
            "steering_lag",
            "steering_steps",
            "a delay shifts every step by the same pause; a lag starts at once and rounds it off",
        ),
    )

    def extra_delays_s(self, values: Parameters) -> tuple[Value, Value]:
        """A delay of the steering alone [s]."""
        return values["delay"], 0.0


class ThrottleDelay(DelayEffect):
    """The throttle command acts ``delay`` later."""

    id = "throttle_delay"
    command = "throttle"
    name = "a delay of the throttle"
    summary = "The throttle command has a delay in addition to that of the car file."
    sentence = "the throttle command has an additional delay of {delay}"
    refuted_if = "the car accelerates at once after a step of throttle, but less at first"
    lag_parameter = "delay"
    parameters = (EffectParameter("delay", "s", 0.0, 0.0, 1.0, 0.03, is_delay=True),)
    confusable = (
        Confusable(
            "motor_lag",
            "throttle_steps",
            "a delay shifts every step by the same pause; a lag starts at once and rounds it off",
        ),
    )

    def extra_delays_s(self, values: Parameters) -> tuple[Value, Value]:
        """A delay of the throttle alone [s]."""
        return 0.0, values["delay"]
