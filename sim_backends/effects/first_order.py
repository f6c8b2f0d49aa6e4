"""A first-order lag over one integration step, by its closed form: a pole is never integrated numerically.

``T dy/dt = u - y`` over a step of length h. The closed form is exact for an input that is held, or linear over each
half of the step. With ``ratio = T / h`` every weight has a limit at T = 0, where the output is the input, and is
differentiable there, so that a search over T may begin at none.
"""

from __future__ import annotations

from typing import NamedTuple

from sim_backends.array_ops import Ops, Value

NO_STEP_S = 1e-15
"""Added to a step, so that one of no length divides and has a derivative [s]."""
_LEAST_RATIO = 1e-3
"""Below it exp(-h / 2T) is 0 in any floating-point type."""


class LagWeights(NamedTuple):
    """Weights for the output at start, middle and end of a step."""

    start: Value
    """Share of the old output in what counts as the output at the start.

    It is 1 for a slow lag. For a fast one it is such that Simpson's rule (as Runge-Kutta has it) over start, middle and
    end gives the exact mean of the response to a jump at the start.
    """
    decay: Value
    """Share of the old output that is left after half a step."""
    ramp: Value
    """Share of the input's change over half a step that the output has followed."""

    def after_half(self, output: Value, first: Value, last: Value) -> Value:
        """Output after half a step in which the input goes from ``first`` to ``last``."""
        return first + (output - first) * self.decay + (last - first) * self.ramp


def lag_weights(ops: Ops, time_constant_s: Value, step_s: Value) -> LagWeights:
    """Weights for a time constant and a step [s], each a number or one per car; both may be 0."""
    ratio = time_constant_s / (step_s + NO_STEP_S)
    span = 0.5 / ops.floor(ratio, _LEAST_RATIO)  # half a step in time constants
    decay = ops.exp(-span)
    whole = decay * decay
    # The differences lose digits in slow lags: there their series, or their limit (off by less than 1e-5).
    series = span * (0.5 - span * (1.0 / 6.0 - span * (1.0 / 24.0)))
    ramp = ops.where(span < 0.01, series, 1.0 - 2.0 * ratio * (1.0 - decay))
    start = ops.where(span < 0.125, 1.0, 6.0 * ratio * (1.0 - whole) - 4.0 * decay - whole)
    return LagWeights(start, decay, ramp)
