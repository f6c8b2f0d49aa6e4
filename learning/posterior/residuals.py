"""Distribution of the errors of a model that predicts only a mean: a multivariate Student-t fitted to its residuals.

It applies to an identified simulator, a regression or the networks of an ensemble. Their likelihood is then comparable
with that of ``function_posterior``, whose errors are correlated and heavy-tailed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from carlab.core.errors import DataError
from learning.evaluation import Mixture
from learning.outliers import DOF_CANDIDATES, log_student, mahalanobis_sq, maximum_likelihood_dof, output_correlation

SCALE_ITERATIONS = 60
"""Iterations of the expectation maximisation of the common scale."""
MIN_DOF = DOF_CANDIDATES[0]
PRIOR_ROWS = 1.0
"""Weight of a prior standard deviation of the errors, in rows."""
MIN_SCALE, MIN_SHARE = 1e-9, 1e-3
"""Lower bounds of an output's error (absolute, and relative to its root mean square), for constant outputs."""


@dataclass(frozen=True, slots=True)
class ResidualDistribution:
    """A zero-mean multivariate Student-t distribution.

    Attributes:
        factor: lower Cholesky factor of its scale matrix (O, O), in the outputs' units.
        dof: its degrees of freedom; infinite for a Gaussian.
    """

    factor: Tensor
    dof: float

    @property
    def scale(self) -> Tensor:
        """Marginal scale of each output (O,)."""
        return self.factor.square().sum(dim=1).sqrt()

    @property
    def whitening(self) -> Tensor:
        """Matrix (O, O) that makes errors uncorrelated and of unit scale, from the left."""
        eye = torch.eye(len(self.factor), dtype=self.factor.dtype, device=self.factor.device)
        whitening: Tensor = torch.linalg.solve_triangular(self.factor, eye, upper=False)
        return whitening

    def mahalanobis_sq(self, errors: Tensor) -> Tensor:
        """Squared Mahalanobis distance (...) of errors (..., O)."""
        white: Tensor = errors @ self.whitening.to(errors).T
        return white.square().sum(dim=-1)

    def centred_at(self, means: Tensor) -> Mixture:
        """The distribution around each of the means (L, N, O), as a mixture."""
        one = torch.ones((1, 1, means.shape[2]), dtype=means.dtype, device=means.device)
        return Mixture(means, one, self.dof, self.whitening.to(means))

    def to(self, like: Tensor) -> ResidualDistribution:
        """Copy with the type and device of another tensor, of any shape."""
        return ResidualDistribution(self.factor.to(like), self.dof)


def fit_residuals(errors: Tensor, prior_std: Tensor | None = None, fitted_rows: float = 0.0) -> ResidualDistribution:
    """Fit a Student-t distribution to residuals by maximum likelihood.

    Correlation and relative scales are those of ``outliers.output_correlation``; the common scale and the degrees of
    freedom maximise the likelihood (``outliers.DOF_MIN_GAIN_NATS`` for lighter tails). The degrees of freedom are at
    most the number of rows less those used by the fit of the mean, since the predictive distribution of a normal
    variable with unknown variance is Student-t (Gelman et al., "Bayesian Data Analysis", 3rd edition, section 3.2).

    Args:
        errors: (n, O).
        prior_std: prior standard deviation (O,), positive, with the weight of ``PRIOR_ROWS`` rows; None: no prior.
        fitted_rows: degrees of freedom used by the fit of the mean, in rows: its parameters divided by the outputs.

    Raises:
        DataError: no row, or errors that are not finite.
    """
    count, outputs = errors.shape
    if not count or not torch.isfinite(errors).all():
        raise DataError("The residuals are empty or not finite; check the inputs of the model.")
    errors = errors.double()
    weight = 0.0 if prior_std is None else PRIOR_ROWS
    unit = errors.square().mean(dim=0).sqrt() if prior_std is None else prior_std.double()
    unit = unit.clamp_min(MIN_SCALE)
    correlation, scales = output_correlation(errors / unit)
    scales = unit * ((count * scales**2 + weight) / (count + weight)).sqrt().clamp_min(MIN_SHARE)
    square = mahalanobis_sq(errors / scales, correlation)
    prior_square = 0.0 if prior_std is None else float((unit / scales).square().sum())
    free_rows = max(count - fitted_rows, 0.0)

    def scale_for(dof: float) -> float:
        return _common_scale(square, outputs, dof, weight, prior_square)

    def log_likelihood(dof: float) -> float:
        s = scale_for(dof)
        return float(log_student(square / s**2, outputs, dof).sum()) - count * outputs * math.log(s)

    dof = maximum_likelihood_dof(log_likelihood)
    max_dof = max(free_rows + weight, MIN_DOF)
    # Residuals of fitted rows are smaller than errors at new rows.
    variance_factor = (count + weight) / max(free_rows + weight, 1.0)
    factor = torch.linalg.cholesky(correlation) * scales[:, None] * scale_for(dof) * math.sqrt(variance_factor)
    return ResidualDistribution(factor, min(dof, max_dof))


def _common_scale(square: Tensor, outputs: int, dof: float, prior_rows: float, prior_square: float) -> float:
    """Scale of all outputs by expectation maximisation (Lange, Little and Taylor 1989, section 3).

    Args:
        square: squared Mahalanobis distances (n,).
        outputs: O.
        dof: degrees of freedom.
        prior_rows: weight of the prior in rows.
        prior_square: squared Mahalanobis distance of a prior row.
    """
    scale_square = 1.0
    rows = len(square) + prior_rows
    for _ in range(SCALE_ITERATIONS):
        weight = 1.0 if math.isinf(dof) else (dof + outputs) / (dof + square / scale_square)
        total = float((weight * square).sum()) + prior_rows * prior_square
        scale_square = max(total / (rows * outputs), MIN_SHARE**2)
    return math.sqrt(scale_square)
