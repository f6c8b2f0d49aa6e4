"""Closed form of a first-order lag over one integration step, instead of numerical integration.

``T dy/dt = u - y`` over a step of length h. The closed form is exact for an input that is held, or linear over each
half of the step. With ``ratio = T / h`` every weight has a limit at T = 0, where the output is the input, and is
differentiable there, so that a search over T may start at 0.
"""

from __future__ import annotations

from typing import NamedTuple

from sim_backends.array_ops import Ops, Value

NO_STEP_S = 1e-15
"""Added to a step length to avoid a division by zero [s]."""
_MIN_RATIO = 1e-3
"""Below it exp(-h / 2T) is 0 in any floating-point type."""


class LagWeights(NamedTuple):
    """Weights [1] for the output at start, middle and end of a step; each () or (cars,)."""

    start: Value
    """Weight of the old output in the effective output at the start.

    It is 1 for a slow lag. For a fast lag it makes Simpson's rule (as in Runge-Kutta) over start, middle and end give
    the exact mean of the step response.
    """
    decay: Value
    """Weight of the old output after half a step."""
    ramp: Value
    """Share of the input's change over half a step in the output."""

    def after_half(self, output: Value, first: Value, last: Value) -> Value:
        """Output after half a step in which the input goes linearly from ``first`` to ``last``; all in one unit."""
        return first + (output - first) * self.decay + (last - first) * self.ramp


def lag_weights(ops: Ops, time_constant_s: Value, step_s: Value) -> LagWeights:
    """Weights for a time constant and a step [s], each a number or one per car (cars,); both may be 0."""
    ratio = time_constant_s / (step_s + NO_STEP_S)
    span = 0.5 / ops.at_least(ratio, _MIN_RATIO)  # half a step in time constants
    decay = ops.exp(-span)
    whole = decay * decay
    # For slow lags the differences lose digits: use their series, or their limit (error below 1e-5).
    series = span * (0.5 - span * (1.0 / 6.0 - span * (1.0 / 24.0)))
    ramp = ops.where(span < 0.01, series, 1.0 - 2.0 * ratio * (1.0 - decay))
    start = ops.where(span < 0.125, 1.0, 6.0 * ratio * (1.0 - whole) - 4.0 * decay - whole)
    return LagWeights(start, decay, ramp)
