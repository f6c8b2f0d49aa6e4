"""Distribution of a model's errors on prediction windows, with its covariance.

The errors of a window, by step and channel, have a multivariate Student-t distribution. Its covariance contains the
error of the model. Directions in which the model errs count little.

In a comparison the covariance is that of the first group. It fits the windows that it is estimated from better than
others. So the errors of the first group are decorrelated by covariances of other folds (cross-fitting, Chernozhukov et
al. 2018, "Double/debiased machine learning for treatment and structural parameters"), and the ridge has the largest
likelihood on the folds that are left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy import stats

from carlab.core.quantities import FloatArray
from carlab.diagnosis.settings import COMPARISON
from carlab.prediction.windows import IndexArray

SCATTER_ITERATIONS = 20


@dataclass(frozen=True, slots=True)
class ErrorModel:
    """Student-t distribution of errors (S, D) with ``dof`` degrees of freedom; ``root`` (D, D) decorrelates them."""

    root: FloatArray
    dof: float

    @classmethod
    def of(cls, errors: FloatArray, ridge_share: float) -> Self:
        """Scatter of errors (S, D) by expectation maximisation (Liu and Rubin 1995), with a ridge.

        Args:
            errors: of the model.
            ridge_share: added to the diagonal of the scatter, as a share of it.
        """
        count, size = errors.shape
        scatter = errors.T @ errors / count
        for _ in range(SCATTER_ITERATIONS):
            distance_sq = _distance_sq(errors, scatter + 1e-6 * np.eye(size))
            weighted = errors * ((COMPARISON.student_dof + size) / (COMPARISON.student_dof + distance_sq))[:, None]
            scatter = weighted.T @ errors / count
        scatter = scatter + ridge_share * np.diag(np.diag(scatter)) + COMPARISON.ridge_variance * np.eye(size)
        scatter = scatter * np.median(_distance_sq(errors, scatter)) / stats.chi2.median(size)
        return cls(np.asarray(np.linalg.cholesky(np.linalg.inv(scatter))), COMPARISON.student_dof)

    def decorrelated(self, errors: FloatArray) -> FloatArray:
        """Errors (..., D) in standard deviations along independent directions."""
        return np.asarray(errors @ self.root)

    def weights(self, decorrelated: FloatArray) -> FloatArray:
        """Weights (...) of windows by their decorrelated errors (..., D)."""
        distance_sq = (decorrelated**2).sum(axis=-1)
        return np.asarray((self.dof + decorrelated.shape[-1]) / (self.dof + distance_sq))

    def loss(self, decorrelated: FloatArray) -> FloatArray:
        """Negative log-likelihood (...) of windows by their decorrelated errors (..., D), without its constant."""
        distance_sq = (decorrelated**2).sum(axis=-1)
        return np.asarray(0.5 * (self.dof + decorrelated.shape[-1]) * np.log1p(distance_sq / self.dof))

    def log_determinant(self) -> float:
        """Logarithm of the determinant of ``root``."""
        return float(np.linalg.slogdet(self.root)[1])


@dataclass(frozen=True, slots=True)
class CrossFittedErrors:
    """Error models of the windows of the first group.

    Attributes:
        whole: from all windows; for the second group.
        without: from the windows outside each fold.
        fold: (S,) fold of each window of the first group.
    """

    whole: ErrorModel
    without: tuple[ErrorModel, ...]
    fold: IndexArray

    @classmethod
    def of(cls, errors: FloatArray, fold: IndexArray) -> Self:
        """Error models with the ridge that has the largest likelihood on the folds that are left out.

        Args:
            errors: (S, D) of the reference model on the first group.
            fold: (S,) fold of each window, from 0 on.
        """
        folds = range(int(fold.max()) + 1)

        def without_each(share: float) -> tuple[ErrorModel, ...]:
            return tuple(ErrorModel.of(errors[fold != k], share) for k in folds)

        def loss_left_out(models: tuple[ErrorModel, ...]) -> float:
            left_out = [errors[fold == k] for k in folds]
            return sum(
                float(m.loss(m.decorrelated(e)).sum()) - len(e) * m.log_determinant()
                for m, e in zip(models, left_out, strict=True)
            )

        tried = [(share, without_each(share)) for share in COMPARISON.ridge_shares]
        share, models = min(tried, key=lambda one: loss_left_out(one[1]))
        return cls(ErrorModel.of(errors, share), models, fold)

    def decorrelated(self, errors: FloatArray) -> FloatArray:
        """Errors (..., S, D) of the first group, each by the model without its fold."""
        found = np.empty_like(errors)
        for k, model in enumerate(self.without):
            own = self.fold == k
            found[..., own, :] = model.decorrelated(errors[..., own, :])
        return found


def _distance_sq(errors: FloatArray, scatter: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("si,ij,sj->s", errors, np.linalg.inv(scatter), errors))
