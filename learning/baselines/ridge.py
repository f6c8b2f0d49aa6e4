"""Ridge regression with leave-one-out errors: the simplest baseline."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from carlab.core.errors import DataError
from carlab.core.quantities import FloatArray

PENALTIES = tuple(float(p) for p in np.geomspace(1e-4, 1e3, 22))


@dataclass(frozen=True, slots=True)
class Ridge:
    """A linear model of normalised inputs.

    Attributes:
        weights: (D + 1, O) with the constant last.
        mean, scale: of the inputs (D,).
        errors: leave-one-out errors of the rows (n, O).
    """

    weights: FloatArray
    mean: FloatArray
    scale: FloatArray
    errors: FloatArray

    @classmethod
    def fit(cls, inputs: FloatArray, targets: FloatArray) -> Ridge:
        """Fit in closed form, with the penalty that minimises the leave-one-out error of each output.

        Args:
            inputs: (n, D).
            targets: (n, O).

        Raises:
            DataError: fewer than three rows.
        """
        if len(inputs) < 3:
            raise DataError(f"A regression needs at least three rows, not {len(inputs)}; record more.")
        mean, scale = inputs.mean(axis=0), inputs.std(axis=0)
        scale = np.where(scale > 1e-9, scale, 1.0)
        design = (inputs - mean) / scale
        centre = targets.mean(axis=0)
        left, singular, right = np.linalg.svd(design, full_matrices=False)
        rotated = left.T @ (targets - centre)
        best = np.full(targets.shape[1], np.inf)
        weights, errors = np.zeros((inputs.shape[1] + 1, targets.shape[1])), np.zeros(targets.shape)
        for penalty in PENALTIES:
            shrink = singular**2 / (singular**2 + penalty)
            fitted = left @ (shrink[:, None] * rotated)
            leverage = np.minimum((left**2 * shrink).sum(axis=1) + 1.0 / len(inputs), 1.0 - 1e-9)
            # The leave-one-out error is the residual divided by one minus the leverage (Allen 1974).
            error = (targets - centre - fitted) / (1.0 - leverage)[:, None]
            square = (error**2).mean(axis=0)
            better = square < best
            best = np.where(better, square, best)
            slopes = right.T @ ((singular / (singular**2 + penalty))[:, None] * rotated)
            weights[:-1, better], errors[:, better] = slopes[:, better], error[:, better]
        weights[-1] = centre
        return cls(weights, mean, scale, errors)

    def __call__(self, inputs: FloatArray) -> FloatArray:
        """Mean (n, O) at inputs (n, D)."""
        return np.asarray((inputs - self.mean) / self.scale @ self.weights[:-1] + self.weights[-1])
