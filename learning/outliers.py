"""Outliers among rows: noise with heavy tails as a multivariate Student distribution.

A collision, a slipped marker or a stale pose spoils all outputs of a row at once. With Student noise each row has a
weight, high for ordinary and low for surprising rows, which follow from what the other rows predict (Lange, Little and
Taylor 1989, "Robust statistical modeling using the t distribution", section 3).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache

import torch
from scipy.stats import chi2
from scipy.stats import t as student
from torch import Tensor

FREEDOMS = (2.5, 3.0, 4.0, 6.0, 10.0, 20.0, math.inf)
FIRST_ROUNDS = 5
_MEDIAN_SQUARE = 0.455
"""Median of a squared standard normal number."""
SCALES = (0.3, 2.0)
"""Within which a doubt is corrected."""
WIDTH_DOUBT = 0.1
"""Standard deviation of the logarithm of what a doubt is wrong by, before rows tell."""
CORRELATION_FREEDOM, CORRELATION_ROUNDS = 4.0, 20
CORRELATION_ROWS = 1.0
"""Rows of uncorrelated errors that are believed in before there are any."""
TELLING, LEAST_EIGENVALUE = 2.5, 1e-3
"""Correlations of fewer standard errors than this are none."""
VARIANCE_OF_MEDIAN = 1.36
"""Of the logarithm of half of the rows' error, times their number: ``1 / (4 f(m)^2 m^2)`` for a normal one's size."""


def first_trust(left: Tensor, covariance: Callable[[Tensor], Tensor], noise: Tensor) -> Tensor:
    """Weights (n,) of rows before anything is fitted: low for those that an ordinary gap does not explain.

    A gap that may choose its lengthscales would follow gross outliers, and they would surprise it no more.

    Args:
        left: what a simulator leaves (n, O).
        covariance: of the rows (O, n, n) for their weights, before there is data.
        noise: expected standard deviation (O,).
    """
    trust = torch.ones(len(left), dtype=left.dtype, device=left.device)
    for _ in range(FIRST_ROUNDS):
        white, _ = left_out(left, covariance(trust), noise, trust)
        surprise = white**2
        # The ordinary row sets the scale, whatever the expected gap and noise were.
        ordinary = (surprise.median(dim=0).values / _MEDIAN_SQUARE).clamp_min(1.0)
        _, trust = student_weights((surprise / ordinary).sum(dim=1), left.shape[1])
    return trust


def left_out(left: Tensor, covariance: Tensor, noise: Tensor, trust: Tensor) -> tuple[Tensor, Tensor]:
    """How far (n, O) each row is off what all others say, in units of an ordinary row's doubt, and its variance.

    Leave-one-out residuals in closed form (Rasmussen and Williams 2006, equations 5.10 to 5.12).

    Args:
        left: residuals (n, O).
        covariance: of the rows, noise as trusted included (O, n, n).
        noise: standard deviation of an ordinary row (O,).
        trust: what each row's noise variance is divided by (n,).
    """
    precision = torch.cholesky_inverse(torch.linalg.cholesky(covariance))
    own = precision.diagonal(dim1=1, dim2=2)
    error = (precision @ left.T[:, :, None])[:, :, 0] / own
    ordinary = 1.0 / own + (noise**2)[:, None] * (1.0 - 1.0 / trust)
    doubt = ordinary.clamp_min(1e-12).T
    return error.T / doubt.sqrt(), doubt


def output_correlation(white: Tensor) -> tuple[Tensor, Tensor]:
    """Correlation (O, O) and scales (O,) of errors, such as of a step and of the velocity that is its difference.

    That of a multivariate Student distribution by expectation maximisation (Lange, Little and Taylor 1989, section 3),
    with degrees of freedom few enough that outliers have little say; none where rows are too few to tell it from none.

    Args:
        white: errors in units of their doubt (n, O).
    """
    count, outputs = white.shape
    found = torch.eye(outputs, dtype=white.dtype, device=white.device)
    width = (white**2).median(dim=0).values.clamp_min(1e-12).sqrt()
    for _ in range(CORRELATION_ROUNDS):
        own = white / width
        weight = (CORRELATION_FREEDOM + outputs) / (CORRELATION_FREEDOM + joint_surprise(own, found))
        scatter = (weight[:, None] * own).T @ own / count
        wider = scatter.diagonal().clamp_min(1e-12).sqrt()
        width = (width * wider).clamp_min(1e-6)
        found = (scatter / (wider[:, None] * wider)) * (count / (count + CORRELATION_ROWS))
        found.fill_diagonal_(1.0)
    told = torch.where(found.abs() > TELLING / math.sqrt(count), found, 0.0).fill_diagonal_(1.0)
    least = float(torch.linalg.eigvalsh(told)[0])
    # Entries that are left out may leave what is no correlation.
    return (found if least < LEAST_EIGENVALUE else told), width


def left_out_density(white: Tensor, doubt: Tensor) -> Tensor:
    """Log density (n,) of each row by what all others say, with tails, sizes and correlation as the rows tell them.

    Args:
        white: how far off each row is, in units of its doubt (n, O), and
        doubt: its variance (n, O), both of ``left_out``.
    """
    correlation, width = output_correlation(white)
    surprise, outputs = joint_surprise(white / width, correlation), white.shape[1]
    freedom, _ = student_weights(surprise, outputs)
    size = (0.5 * doubt.log() + width.log()).sum(dim=1) + 0.5 * torch.logdet(correlation)
    return log_student(surprise, outputs, freedom) - size


def joint_surprise(white: Tensor, correlation: Tensor) -> Tensor:
    """Squared surprise (...) of all outputs of errors (..., O) in units of their doubt, that are correlated (O, O)."""
    factor = torch.linalg.cholesky_ex(correlation).L
    alone: Tensor = torch.linalg.solve_triangular(factor, white.flatten(0, -2).T, upper=False)
    return (alone**2).sum(dim=0).view(white.shape[:-1])


def turn_of(correlation: Tensor, size: Tensor) -> Tensor:
    """What errors are multiplied by (O, O) to be uncorrelated, each of its own size as before.

    The largest stays as it is, and each other one is told from those before (Cholesky's factor): a step less its share
    of the velocity that is its difference.

    Args:
        correlation: of the errors (O, O).
        size: of each error (O,).
    """
    order = size.argsort(descending=True)
    factor = torch.linalg.cholesky(correlation[order][:, order])
    eye = torch.eye(len(size), dtype=size.dtype, device=size.device)
    alone = torch.linalg.solve_triangular(factor, eye, upper=False)
    turn = torch.empty_like(alone)
    turn[order[:, None], order] = alone
    return size[:, None] * turn / size


def student_weights(surprise: Tensor, outputs: int) -> tuple[float, Tensor]:
    """Degrees of freedom, and the weight of each row; lighter tails are believed if they beat heavier ones by a nat.

    Args:
        surprise: squared, summed over outputs (n,).
        outputs: how many were summed.
    """
    best, freedom = -math.inf, math.inf
    for candidate in FREEDOMS:
        likelihood = float(log_student(surprise, outputs, candidate).sum())
        if likelihood > best + 1.0:
            best, freedom = likelihood, candidate
    if math.isinf(freedom):
        return freedom, torch.ones_like(surprise)
    return freedom, ((freedom + outputs) / (freedom + surprise)).clamp_max(1.0)


def typical_scale(surprise: Tensor, freedom: float) -> Tensor:
    """Of each output, by what a doubt is to be multiplied for half of the rows to lie within it (O,).

    As far as rows can tell: half of a few is itself a guess, and a doubt is rarely wrong by much.

    Args:
        surprise: squared (n, O).
        freedom: of the Student distribution that the doubt stands for.
    """
    half = float(student.ppf(0.75, min(freedom, 1e6))) ** 2
    scale = (surprise.median(dim=0).values / half).sqrt().clamp(*SCALES)
    told: Tensor = scale ** (WIDTH_DOUBT**2 / (WIDTH_DOUBT**2 + VARIANCE_OF_MEDIAN / len(surprise)))
    return told


@cache
def tail_scales(freedom: float, count: int) -> Tensor:
    """Scales (count,) of Gaussians whose even mixture is nearly a Student distribution."""
    if math.isinf(freedom):
        return torch.ones(count)
    shares = (torch.arange(count, dtype=torch.float64) + 0.5) / count
    return torch.sqrt(freedom / torch.from_numpy(chi2.ppf(shares.numpy(), freedom))).float()


def log_student(surprise: Tensor, outputs: int, freedom: float) -> Tensor:
    """Log density of squared surprises, each summed over ``outputs``, of unit scale."""
    if math.isinf(freedom):
        return -0.5 * (surprise + outputs * math.log(2.0 * math.pi))
    constant = math.lgamma(0.5 * (freedom + outputs)) - math.lgamma(0.5 * freedom)
    constant -= 0.5 * outputs * math.log(freedom * math.pi)
    return constant - 0.5 * (freedom + outputs) * torch.log1p(surprise / freedom)


__all__ = [
    "first_trust",
    "joint_surprise",
    "left_out",
    "left_out_density",
    "log_student",
    "output_correlation",
    "student_weights",
    "tail_scales",
    "turn_of",
    "typical_scale",
]
