"""The Runge-Kutta pair of orders 5 and 4 of Dormand and Prince, with step control and dense output.

Source: Hairer, Norsett and Wanner, "Solving Ordinary Differential Equations I", sections II.4 to II.6 and their code
DOPRI5. A state is a list of six to ten numbers, on which an operation of NumPy takes longer than the sums.
"""

from __future__ import annotations

import math
from collections.abc import Callable

Rates = Callable[[float, list[float]], list[float]]
FIRST_STEP_S = 2e-3
LONGEST_STEP_S = 0.01
"""The stages of this step are at most 5 ms apart, the duration of a short impact."""
SAFETY = 0.9
LEAST_FACTOR, LARGEST_FACTOR = 0.2, 10.0
"""Bounds of the change of the step from one step to the next."""


class DormandPrince:
    """A solution of dy/dt = rates(t, y) that is extended step by step.

    Args:
        rates: Right-hand side; returns n numbers.
        state: Initial state of n numbers at time 0.
        rtol: Tolerated error of a step as a share of the state (absolute: a tenth of it).

    Attributes:
        t: End of the solution [s].
        state: State there.
    """

    def __init__(self, rates: Rates, state: list[float], rtol: float) -> None:
        self.t, self.state = 0.0, state
        self._rates, self._rtol = rates, rtol
        self._step_s = FIRST_STEP_S
        self.restart()

    def restart(self) -> None:
        """Evaluate the right-hand side again, because it has changed."""
        self._slope = self._rates(self.t, self.state)

    def extend(self, end_s: float) -> None:
        """Add one step; it ends at ``end_s`` or before.

        Raises:
            ArithmeticError: the shortest step has a too large error.
        """
        left = end_s - self.t
        error = math.inf
        while not error <= 1.0:  # also if it is not a number
            steps = math.ceil(left / self._step_s)
            h = left / steps
            if self.t + 0.1 * h == self.t:
                raise ArithmeticError("the shortest step has a too large error")
            state, slopes = self._stages(h)
            error = self._error(h, state, slopes)
            factor = SAFETY * max(error, 1e-12) ** -0.2 if math.isfinite(error) else 0.0
            self._step_s = min(h * min(max(factor, LEAST_FACTOR), LARGEST_FACTOR), LONGEST_STEP_S)
        self._last = self.t, h, self.state, state, slopes
        self.t = end_s if steps == 1 else self.t + h
        self.state, self._slope = state, slopes[-1]

    def _stages(self, h: float) -> tuple[list[float], tuple[list[float], ...]]:
        """The state after a step h, and the slopes k1 and k3 to k7 of its stages (k2 is not needed later)."""
        t, y, k1, rates = self.t, self.state, self._slope, self._rates
        a, b = 0.2 * h, h * 3 / 40
        k2 = rates(t + 0.2 * h, [v + a * p for v, p in zip(y, k1, strict=True)])
        a, c = b, h * 9 / 40
        k3 = rates(t + 0.3 * h, [v + a * p + c * q for v, p, q in zip(y, k1, k2, strict=True)])
        a, b, c = h * 44 / 45, h * -56 / 15, h * 32 / 9
        k4 = rates(t + 0.8 * h, [v + a * p + b * q + c * r for v, p, q, r in zip(y, k1, k2, k3, strict=True)])
        a, b, c, d = h * 19372 / 6561, h * -25360 / 2187, h * 64448 / 6561, h * -212 / 729
        k5 = rates(
            t + h * 8 / 9,
            [v + a * p + b * q + c * r + d * s for v, p, q, r, s in zip(y, k1, k2, k3, k4, strict=True)],
        )
        a, b, c, d, e = h * 9017 / 3168, h * -355 / 33, h * 46732 / 5247, h * 49 / 176, h * -5103 / 18656
        k6 = rates(
            t + h,
            [v + a * p + b * q + c * r + d * s + e * u for v, p, q, r, s, u in zip(y, k1, k2, k3, k4, k5, strict=True)],
        )
        a, b, c, d, e = h * 35 / 384, h * 500 / 1113, h * 125 / 192, h * -2187 / 6784, h * 11 / 84
        new = [
            v + a * p + b * r + c * s + d * u + e * w for v, p, r, s, u, w in zip(y, k1, k3, k4, k5, k6, strict=True)
        ]
        return new, (k1, k3, k4, k5, k6, rates(t + h, new))

    def _error(self, h: float, state: list[float], slopes: tuple[list[float], ...]) -> float:
        """Root mean square of the estimated errors of the step, in tolerated errors."""
        a, b, c, d, e, f = h * 71 / 57600, h * -71 / 16695, h * 71 / 1920, h * -17253 / 339200, h * 22 / 525, h / -40
        total = 0.0
        for u, v, p, r, s, w, y, z in zip(self.state, state, *slopes, strict=True):
            tolerated = self._rtol * (0.1 + max(abs(u), abs(v)))
            total += ((a * p + b * r + c * s + d * w + e * y + f * z) / tolerated) ** 2
        return math.sqrt(total / len(state))

    def at(self, t: float) -> list[float]:
        """State within the last step, of order 4."""
        begin_s, h, old, new, slopes = self._last
        x = (t - begin_s) / h
        y = 1.0 - x
        a, b, c = h * -12715105075 / 11282082432, h * 87487479700 / 32700410799, h * -10690763975 / 1880347072
        d, e, f = h * 701980252875 / 199316789632, h * -1453857185 / 822651844, h * 69997945 / 29380423
        found = []
        for u, v, p, r, s, w, z, q in zip(old, new, *slopes, strict=True):
            rise = v - u
            bend = h * p - rise
            fourth = a * p + b * r + c * s + d * w + e * z + f * q
            found.append(u + x * (rise + y * (bend + x * (rise - h * q - bend + y * fourth))))
        return found
