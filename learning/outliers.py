"""Robust statistics of rows: leave-one-out errors, Student-t noise, correlation of outputs.

A collision, a slipped marker or a stale pose corrupts all outputs of a row at once. With multivariate Student-t noise
the weight of a row decreases with its squared Mahalanobis distance (Lange, Little and Taylor 1989, "Robust statistical
modeling using the t distribution", section 3).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache

import torch
from scipy.stats import chi2
from scipy.stats import t as student
from torch import Tensor

DOF_CANDIDATES = (2.5, 3.0, 4.0, 6.0, 10.0, 20.0, math.inf)
DOF_MIN_GAIN_NATS = 1.0
"""Minimum gain in log-likelihood at which more degrees of freedom replace fewer."""
INITIAL_WEIGHT_ITERATIONS = 5
_MEDIAN_CHI2 = 0.455
"""Median of a squared standard normal number."""
SCALE_RANGE = (0.3, 2.0)
"""Bounds of the correction of a predictive standard deviation."""
SCALE_LOG_STD = 0.1
"""Prior standard deviation of the logarithm of that correction."""
CORRELATION_DOF, CORRELATION_ITERATIONS = 4.0, 20
CORRELATION_PRIOR_ROWS = 1.0
"""Weight of the prior (no correlation), in rows."""
MIN_CORRELATION_Z, MIN_EIGENVALUE = 2.5, 1e-3
"""Correlations of fewer standard errors are set to zero, unless the matrix then has an eigenvalue below the second."""
LOG_MEDIAN_VARIANCE = 1.36
"""Variance of the logarithm of a sample's median |z|, times the sample size: ``1 / (4 f(m)^2 m^2)``, z normal."""


def initial_row_weights(weights: Tensor, standardised_errors: Callable[[Tensor], Tensor]) -> Tensor:
    """Weights (n,) of rows under the prior covariance: low for rows that a typical discrepancy does not explain.

    The weights precede the fit of the covariance, because a fitted covariance would follow gross outliers.

    Args:
        weights: equal initial weights (n,), all 1.
        standardised_errors: leave-one-out errors of a simulator's residual (n, O) for given weights.
    """
    for _ in range(INITIAL_WEIGHT_ITERATIONS):
        square = standardised_errors(weights) ** 2
        # The median row determines the scale; the result does not depend on the size of the prior covariance.
        median_excess = (square.median(dim=0).values / _MEDIAN_CHI2).clamp_min(1.0)
        _, weights = student_weights((square / median_excess).sum(dim=1), square.shape[1])
    return weights


def leave_one_out(
    residual: Tensor, covariance: Tensor, noise_std: Tensor, row_weights: Tensor
) -> tuple[Tensor, Tensor]:
    """Leave-one-out errors of a Gaussian process in closed form (Rasmussen and Williams 2006, equations 5.10 to 5.12).

    Args:
        residual: (n, O).
        covariance: of the rows, their weighted noise included (O, n, n).
        noise_std: of a row of weight 1 (O,).
        row_weights: weights (n,); the noise variance of a row is divided by its weight.

    Returns:
        Errors in units of their predictive standard deviation at weight 1 (n, O), and that variance (n, O).
    """
    precision = torch.cholesky_inverse(torch.linalg.cholesky(covariance))
    diagonal = precision.diagonal(dim1=1, dim2=2)
    error = (precision @ residual.T[:, :, None])[:, :, 0] / diagonal
    at_weight_one = 1.0 / diagonal + (noise_std**2)[:, None] * (1.0 - 1.0 / row_weights)
    variance = at_weight_one.clamp_min(1e-12).T
    return error.T / variance.sqrt(), variance


def output_correlation(standardised: Tensor) -> tuple[Tensor, Tensor]:
    """Robust correlation and scales of errors of several outputs.

    Expectation maximisation of a multivariate Student-t distribution (Lange, Little and Taylor 1989, section 3).
    Correlations that do not differ significantly from zero are set to zero.

    Args:
        standardised: errors in units of their standard deviation (n, O).

    Returns:
        Correlation (O, O) and scales (O,).
    """
    count, outputs = standardised.shape
    correlation = torch.eye(outputs, dtype=standardised.dtype, device=standardised.device)
    scales = (standardised**2).median(dim=0).values.clamp_min(1e-12).sqrt()
    for _ in range(CORRELATION_ITERATIONS):
        scaled = standardised / scales
        weight = (CORRELATION_DOF + outputs) / (CORRELATION_DOF + mahalanobis_sq(scaled, correlation))
        scatter = (weight[:, None] * scaled).T @ scaled / count
        growth = scatter.diagonal().clamp_min(1e-12).sqrt()
        scales = (scales * growth).clamp_min(1e-6)
        correlation = (scatter / (growth[:, None] * growth)) * (count / (count + CORRELATION_PRIOR_ROWS))
        correlation.fill_diagonal_(1.0)
    significant = torch.where(correlation.abs() > MIN_CORRELATION_Z / math.sqrt(count), correlation, 0.0)
    significant = significant.fill_diagonal_(1.0)
    smallest = float(torch.linalg.eigvalsh(significant)[0])
    # With weak entries set to zero, the matrix may not be positive definite.
    return (correlation if smallest < MIN_EIGENVALUE else significant), scales


def leave_one_out_log_density(standardised: Tensor, variance: Tensor) -> Tensor:
    """Leave-one-out log density (n,) of each row, with tails, scales and correlation fitted to all rows.

    Args:
        standardised: errors (n, O), and
        variance: their variances (n, O), both of ``leave_one_out``.
    """
    correlation, scales = output_correlation(standardised)
    square, outputs = mahalanobis_sq(standardised / scales, correlation), standardised.shape[1]
    dof, _ = student_weights(square, outputs)
    log_volume = (0.5 * variance.log() + scales.log()).sum(dim=1) + 0.5 * torch.logdet(correlation)
    return log_student(square, outputs, dof) - log_volume


def mahalanobis_sq(standardised: Tensor, correlation: Tensor) -> Tensor:
    """Squared Mahalanobis distance (...) of standardised errors (..., O) with a correlation (O, O)."""
    factor = torch.linalg.cholesky_ex(correlation).L
    white: Tensor = torch.linalg.solve_triangular(factor, standardised.flatten(0, -2).T, upper=False)
    return (white**2).sum(dim=0).view(standardised.shape[:-1])


def decorrelation_of(correlation: Tensor, error_std: Tensor) -> Tensor:
    """Matrix (O, O) that decorrelates errors from the left, in the units of each error.

    The largest error is unchanged; each other error is reduced by its regression on the larger ones (Cholesky factor in
    order of size).

    Args:
        correlation: of the errors (O, O).
        error_std: of each error (O,).
    """
    order = error_std.argsort(descending=True)
    factor = torch.linalg.cholesky(correlation[order][:, order])
    eye = torch.eye(len(error_std), dtype=error_std.dtype, device=error_std.device)
    ordered = torch.linalg.solve_triangular(factor, eye, upper=False)
    decorrelation = torch.empty_like(ordered)
    decorrelation[order[:, None], order] = ordered
    return error_std[:, None] * decorrelation / error_std


def maximum_likelihood_dof(log_likelihood: Callable[[float], float]) -> float:
    """Degrees of freedom among ``DOF_CANDIDATES`` by their log-likelihood; more have to gain ``DOF_MIN_GAIN_NATS``."""
    best, dof = -math.inf, math.inf
    for candidate in DOF_CANDIDATES:
        if (found := log_likelihood(candidate)) > best + DOF_MIN_GAIN_NATS:
            best, dof = found, candidate
    return dof


def student_weights(square: Tensor, outputs: int) -> tuple[float, Tensor]:
    """Fit the degrees of freedom of a Student-t distribution of unit scale, and weight its rows.

    Args:
        square: squared Mahalanobis distances (n,).
        outputs: O, the number of outputs in each.

    Returns:
        Degrees of freedom, and the weight of each row (n,), at most 1.
    """
    dof = maximum_likelihood_dof(lambda candidate: float(log_student(square, outputs, candidate).sum()))
    if math.isinf(dof):
        return dof, torch.ones_like(square)
    return dof, ((dof + outputs) / (dof + square)).clamp_max(1.0)


def median_scale(square: Tensor, dof: float) -> Tensor:
    """Factor (O,) on a predictive standard deviation so that its central 50 % interval covers half of the rows.

    The factor is shrunk towards 1 according to the sampling error of the median (``LOG_MEDIAN_VARIANCE``).

    Args:
        square: squared standardised errors (n, O).
        dof: degrees of freedom of the predictive distribution.
    """
    quartile_sq = float(student.ppf(0.75, min(dof, 1e6))) ** 2
    scale = (square.median(dim=0).values / quartile_sq).sqrt().clamp(*SCALE_RANGE)
    shrunk: Tensor = scale ** (SCALE_LOG_STD**2 / (SCALE_LOG_STD**2 + LOG_MEDIAN_VARIANCE / len(square)))
    return shrunk


@cache
def tail_scales(dof: float, count: int) -> Tensor:
    """Scales (count,) of Gaussians whose equally weighted mixture approximates a Student-t distribution.

    Quantiles of its scale mixture (Lange, Little and Taylor 1989, section 2).
    """
    if math.isinf(dof):
        return torch.ones(count)
    quantiles = (torch.arange(count, dtype=torch.float64) + 0.5) / count
    return torch.sqrt(dof / torch.from_numpy(chi2.ppf(quantiles.numpy(), dof))).float()


def log_student(square: Tensor, outputs: int, dof: float) -> Tensor:
    """Log density (...) of a multivariate Student-t distribution of unit scale.

    Args:
        square: squared Mahalanobis distances (...).
        outputs: O, the dimension.
        dof: degrees of freedom; infinite for a Gaussian.
    """
    if math.isinf(dof):
        return -0.5 * (square + outputs * math.log(2.0 * math.pi))
    constant = math.lgamma(0.5 * (dof + outputs)) - math.lgamma(0.5 * dof)
    constant -= 0.5 * outputs * math.log(dof * math.pi)
    return constant - 0.5 * (dof + outputs) * torch.log1p(square / dof)
