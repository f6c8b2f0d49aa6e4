"""Distribution of the reference model's errors on windows of the untouched recordings.

The errors of a window, by step and channel, have a multivariate Student-t distribution with the covariance that the
first group shows. It contains the error of the model. Directions in which the model errs count little.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy import stats

from carlab.core.quantities import FloatArray
from carlab.diagnosis.settings import ComparisonSettings

SCATTER_ITERATIONS = 20


@dataclass(frozen=True, slots=True)
class ErrorModel:
    """Student-t distribution of errors (S, D); ``root`` (D, D) decorrelates them."""

    root: FloatArray
    dof: float

    @classmethod
    def of(cls, errors: FloatArray, settings: ComparisonSettings) -> Self:
        """Scatter of errors (S, D) by expectation maximisation (Liu and Rubin 1995), with a ridge."""
        count, size = errors.shape
        scatter = errors.T @ errors / count
        for _ in range(SCATTER_ITERATIONS):
            distance_sq = _distance_sq(errors, scatter + 1e-6 * np.eye(size))
            weighted = errors * ((settings.student_dof + size) / (settings.student_dof + distance_sq))[:, None]
            scatter = weighted.T @ errors / count
        share, variance = settings.covariance_ridge
        scatter = scatter + share * np.diag(np.diag(scatter)) + variance * np.eye(size)
        scatter = scatter * np.median(_distance_sq(errors, scatter)) / stats.chi2.median(size)
        return cls(np.asarray(np.linalg.cholesky(np.linalg.inv(scatter))), settings.student_dof)

    def decorrelated(self, errors: FloatArray) -> FloatArray:
        """Errors (..., D) in standard deviations along independent directions."""
        return np.asarray(errors @ self.root)

    def weights(self, decorrelated: FloatArray) -> FloatArray:
        """Weights (...) of windows by their decorrelated errors (..., D)."""
        distance_sq = (decorrelated**2).sum(axis=-1)
        return np.asarray((self.dof + decorrelated.shape[-1]) / (self.dof + distance_sq))

    def loss(self, decorrelated: FloatArray) -> FloatArray:
        """Negative log-likelihood (...) of windows, without its constant."""
        distance_sq = (decorrelated**2).sum(axis=-1)
        return np.asarray(0.5 * (self.dof + decorrelated.shape[-1]) * np.log1p(distance_sq / self.dof))


def _distance_sq(errors: FloatArray, scatter: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("si,ij,sj->s", errors, np.linalg.inv(scatter), errors))


__all__ = ["ErrorModel"]
