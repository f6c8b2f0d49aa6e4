"""Ridge regression with the errors of rows left out: the baseline that every learned model must beat."""

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
        errors: of each row (n, O), when it is left out.
    """

    weights: FloatArray
    mean: FloatArray
    scale: FloatArray
    errors: FloatArray

    @classmethod
    def fit(cls, inputs: FloatArray, targets: FloatArray) -> Ridge:
        """Fit with the penalty of each output that leaves the least error on rows left out, in closed form.

        Args:
            inputs: (n, D).
            targets: (n, O).

        Raises:
            DataError: fewer than three rows.
        """
        if len(inputs) < 3:
            raise DataError(f"A regression needs three rows at least, not {len(inputs)}; record more.")
        mean, scale = inputs.mean(axis=0), inputs.std(axis=0)
        scale = np.where(scale > 1e-9, scale, 1.0)
        design = (inputs - mean) / scale
        middle = targets.mean(axis=0)
        left, singular, right = np.linalg.svd(design, full_matrices=False)
        turned = left.T @ (targets - middle)
        best = np.full(targets.shape[1], np.inf)
        weights, errors = np.zeros((inputs.shape[1] + 1, targets.shape[1])), np.zeros(targets.shape)
        for penalty in PENALTIES:
            shrink = singular**2 / (singular**2 + penalty)
            fitted = left @ (shrink[:, None] * turned)
            leverage = np.minimum((left**2 * shrink).sum(axis=1) + 1.0 / len(inputs), 1.0 - 1e-9)
            # The error of a row left out is its residual over one less its leverage (Allen 1974).
            error = (targets - middle - fitted) / (1.0 - leverage)[:, None]
            square = (error**2).mean(axis=0)
            better = square < best
            best = np.where(better, square, best)
            slopes = right.T @ ((singular / (singular**2 + penalty))[:, None] * turned)
            weights[:-1, better], errors[:, better] = slopes[:, better], error[:, better]
        weights[-1] = middle
        return cls(weights, mean, scale, errors)

    def __call__(self, inputs: FloatArray) -> FloatArray:
        """Mean (n, O) at inputs (n, D)."""
        return np.asarray((inputs - self.mean) / self.scale @ self.weights[:-1] + self.weights[-1])


__all__ = ["Ridge"]
