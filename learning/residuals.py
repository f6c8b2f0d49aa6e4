"""The distribution of what a model of one mean leaves: outputs that err together, with tails as heavy as rows tell.

For models that say no more than a mean (an identified simulator, a regression, networks of an ensemble), so that they
are judged by what they foretell and not by a likelihood that was chosen badly: the errors of particles of
``function_posterior`` are correlated and heavy-tailed alike.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from carlab.core.errors import DataError
from learning.evaluation import Mixture
from learning.outliers import FREEDOMS, joint_surprise, log_student, output_correlation

ROUNDS = 60
"""Of expectation maximisation of one scale."""
LEAST_FREEDOM = FREEDOMS[0]
LEAST_SCALE, LEAST_SHARE = 1e-9, 1e-3
"""Of an output's errors, in its units and of their mean size: it may be constant in the rows."""
MARGIN = 1.0
"""In nats of all rows."""


@dataclass(frozen=True, slots=True)
class Residuals:
    """A multivariate Student distribution about nothing.

    Attributes:
        factor: lower Cholesky factor of its scale matrix (O, O), in the outputs' units.
        freedom: its degrees of freedom; infinite for a Gaussian.
    """

    factor: Tensor
    freedom: float

    @property
    def scale(self) -> Tensor:
        """Of each output on its own (O,)."""
        return self.factor.square().sum(dim=1).sqrt()

    @property
    def turn(self) -> Tensor:
        """What errors are multiplied by (O, O) from the left to be independent and of unit scale."""
        eye = torch.eye(len(self.factor), dtype=self.factor.dtype, device=self.factor.device)
        found: Tensor = torch.linalg.solve_triangular(self.factor, eye, upper=False)
        return found

    def surprise(self, errors: Tensor) -> Tensor:
        """Squared, of all outputs (...) of errors (..., O), in units of the scale."""
        white: Tensor = errors @ self.turn.to(errors).T
        return white.square().sum(dim=-1)

    def about(self, means: Tensor) -> Mixture:
        """The same about each of the means (L, N, O) of a mixture."""
        one = torch.ones((1, 1, means.shape[2]), dtype=means.dtype, device=means.device)
        return Mixture(means, one, self.freedom, self.turn.to(means))

    def to(self, like: Tensor) -> Residuals:
        """The same as another tensor is."""
        return Residuals(self.factor.to(like), self.freedom)


def residuals(
    errors: Tensor, expected_std: Tensor | None = None, expected_rows: float = 1.0, spent: float = 0.0
) -> Residuals:
    """The Student distribution that errors are most likely of.

    Correlations and the outputs' scales against each other are those of ``outliers.output_correlation``; one scale for
    all and the degrees of freedom are those of the greatest likelihood, where lighter tails are believed if they beat
    by ``MARGIN`` what was believed before. Few rows tell a scale poorly: there are no more degrees of freedom than rows
    that are not spent, expected ones among them, but two and a half at least (of a normal distribution with unknown
    variance, the prediction is Student's; Gelman et al., "Bayesian Data Analysis", 3rd edition, section 3.2).

    Args:
        errors: (n, O).
        expected_std: standard deviation that is expected (O,), positive; nothing unless given.
        expected_rows: rows for which it counts.
        spent: rows that the fit of the mean has used up, such as its parameters divided by the outputs.

    Raises:
        DataError: there are no errors, or they are not finite.
    """
    count, outputs = errors.shape
    if not count or not torch.isfinite(errors).all():
        raise DataError("What a model leaves must be finite and of one row at least; check its inputs.")
    errors = errors.double()
    believed = 0.0 if expected_std is None else expected_rows
    unit = errors.square().mean(dim=0).sqrt() if expected_std is None else expected_std.double()
    unit = unit.clamp_min(LEAST_SCALE)
    correlation, width = output_correlation(errors / unit)
    # What is expected keeps the scales of a few rows from nothing.
    width = unit * ((count * width**2 + believed) / (count + believed)).sqrt().clamp_min(LEAST_SHARE)
    square = joint_surprise(errors / width, correlation)
    of_expected = 0.0 if expected_std is None else float((unit / width).square().sum())
    left = max(count - spent, 0.0)
    best, freedom, scale = -math.inf, math.inf, 1.0
    for candidate in FREEDOMS:
        own = _scale(square, outputs, candidate, believed, of_expected)
        likelihood = float(log_student(square / own**2, outputs, candidate).sum()) - count * outputs * math.log(own)
        if likelihood > best + MARGIN:
            best, freedom, scale = likelihood, candidate, own
    free = max(left + believed, LEAST_FREEDOM)
    # Each row that the mean has used up leaves the others nearer to it than new ones are.
    inflated = (count + believed) / max(left + believed, 1.0)
    factor = torch.linalg.cholesky(correlation) * width[:, None] * scale * math.sqrt(inflated)
    return Residuals(factor, min(freedom, free))


def _scale(square: Tensor, outputs: int, freedom: float, believed: float, of_expected: float) -> float:
    """Of all outputs, by expectation maximisation (Lange, Little and Taylor 1989, section 3)."""
    scale_square = 1.0
    rows = len(square) + believed
    for _ in range(ROUNDS):
        weight = 1.0 if math.isinf(freedom) else (freedom + outputs) / (freedom + square / scale_square)
        told = float((weight * square).sum()) + believed * of_expected
        scale_square = max(told / (rows * outputs), LEAST_SHARE**2)
    return math.sqrt(scale_square)


__all__ = ["Residuals", "residuals"]
