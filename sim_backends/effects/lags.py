"""First-order lags of the actuators, stepped exactly."""

from __future__ import annotations

from sim_backends.array_ops import Ops, Value
from sim_backends.effects.base import ActuatorEffect, Confusable, EffectParameter, Parameters, Triple
from sim_backends.effects.first_order import LagWeights, lag_weights


class FirstOrderLag(ActuatorEffect):
    """``time_constant * dy/dt = command - y``, by its closed form (``first_order``)."""

    has_state = True
    lag_parameter = "time_constant"
    parameters = (EffectParameter("time_constant", "s", 0.0, 0.0, 5.0, 0.08),)

    def step_numbers(self, ops: Ops, duration_s: Value, values: Parameters) -> Parameters:
        """The weights of ``first_order.LagWeights`` by name [1]."""
        return lag_weights(ops, values["time_constant"], duration_s)._asdict()

    def step(
        self, ops: Ops, command: Triple, state: Value, duration_s: Value, values: Parameters
    ) -> tuple[Triple, Value]:
        """Exponential approach; with a time constant of zero the output is the command."""
        start, middle, end = command
        weights = LagWeights(**values)
        first = start + (state - start) * weights.start
        if start is middle and middle is end:
            central = start + (state - start) * weights.decay
            last = start + (state - start) * (weights.decay * weights.decay)
        else:
            central = weights.after_half(state, start, middle)
            last = weights.after_half(central, middle, end)
        return (first, central, last), last


class SteeringLag(FirstOrderLag):
    """``time_constant dd/dt = d_cmd - d``."""

    id = "steering_lag"
    fitted_with_curves = True
    name = "a lag of the steering servo"
    summary = "The steering servo lags behind its command."
    sentence = "the steering servo lags by {time_constant}"
    refuted_if = (
        "the wheels reach their angle after the same pause for a small and for a large step (a delay), or later the "
        "larger the step is (a limit of their rate)"
    )
    command = "steering"
    order = 30
    confusable = (
        Confusable(
            "steering_rate_limit",
            "steering_steps",
            "a lag takes as long for a small as for a large step; a limited rate takes longer for the large one",
        ),
        Confusable(
            "tyre_relaxation",
            "steering_steps",
            (
                "a lag lasts as long at any speed; building up side force takes a distance, so drive it twice, the "
                "second time with --max-throttle 0.15"
            ),
        ),
    )


class MotorLag(FirstOrderLag):
    """``time_constant du/dt = u_t - u``."""

    id = "motor_lag"
    fitted_with_curves = True
    name = "a lag of the motor"
    summary = "The motor's force lags behind the throttle."
    sentence = "the motor's force lags behind the throttle by {time_constant}"
    refuted_if = "after a step of throttle nothing happens for a while and then everything at once (a delay)"
    command = "throttle"
    order = 30
