"""Noise of recorded steps: measurement noise enters two consecutive steps of a drive, with opposite signs.

A step is the difference of two measurements, ``y_k = f(x_k) + e_(k+1) - e_k + d_k`` with measurement noise e and a
disturbance d. So the noise of consecutive steps has a correlation of -s / 2, where s is the share of e in the variance
(a moving average of first order; Box and Jenkins 1970, "Time series analysis", section 3.3).

The correlation matters because the measured velocities are inputs of a step too: the noise e_k that lowers the step
raises its input. With independent noise a regression takes this for a slope of the function, up to -1 if the true
velocities hardly vary, and extrapolates it (errors in variables: Fuller 1987, "Measurement error models", section 1.1).
With the correlation, sums of consecutive steps, in which the noise of the measurements between them cancels, determine
the function.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from learning.outliers import leave_one_out

MAX_SHARE = 0.98
"""Upper bound of the share of measurement noise; at 1 the covariance of a long drive is ill-conditioned."""
LOG_STD_NOISE = 0.5
"""Prior standard deviation of the logarithm of the noise's standard deviation."""
LOGIT_MEDIAN, LOGIT_STD = 0.0, 3.0
"""Prior median and standard deviation of the logit of that share: wide, so that the evidence determines it."""
BLOCK_ROWS = 25
"""Consecutive rows in a subset on which a process is conditioned; in longer blocks more of the noise cancels."""
FIT_BLOCK_ROWS = 5
"""The same for a subset to which hyperparameters are fitted: small blocks are spread over the whole drive
(docs/decisions/0059)."""


@dataclass(frozen=True, slots=True)
class RowNoise:
    """Noise of rows, independent by output.

    Attributes:
        std: of one row of weight 1 (O,).
        measurement_share: share of measurement noise in the variance (O,); None: the noise of rows is independent.
        step_numbers: of the rows' steps (n,); those of consecutive steps of a drive differ by 1. None as above.
    """

    std: Tensor
    measurement_share: Tensor | None = None
    step_numbers: Tensor | None = None

    @classmethod
    def of_logs(cls, logs: Sequence[Tensor], step_numbers: Tensor | None) -> RowNoise:
        """From logarithms of ``std`` (O,) and, with step numbers, logits of ``measurement_share / MAX_SHARE`` (O,)."""
        if step_numbers is None:
            return cls(logs[0].exp())
        return cls(logs[0].exp(), MAX_SHARE * torch.sigmoid(logs[1]), step_numbers)

    def take(self, rows: Tensor) -> RowNoise:
        """The noise of the rows with indices (m,)."""
        if self.step_numbers is None:
            return self
        return RowNoise(self.std, self.measurement_share, self.step_numbers[rows])

    def covariance(self, row_weights: Tensor) -> Tensor:
        """Covariances (O, n, n); the noise variance of a row is divided by its Student-t weight (n,)."""
        count = len(row_weights)
        return self.add_to(self.std.new_zeros((len(self.std), count, count)), row_weights)

    def add_to(self, covariance: Tensor, row_weights: Tensor) -> Tensor:
        """Add the covariances of the noise to others (O, n, n) in place; arguments as for ``covariance``."""
        covariance.diagonal(dim1=1, dim2=2).add_(self._variance(row_weights))
        if self.step_numbers is not None:
            first, second, between = self._pairs(row_weights)
            covariance[:, first, second] += between
            covariance[:, second, first] += between
        return covariance

    def log_gradients(self, gradient: Tensor, row_weights: Tensor) -> list[Tensor]:
        """Gradients with respect to the logs of ``of_logs``, from a symmetric one to the covariance (O, n, n)."""
        own = (gradient.diagonal(dim1=1, dim2=2) * self._variance(row_weights)).sum(dim=1)
        if self.measurement_share is None:
            return [2.0 * own]
        first, second, covariance = self._pairs(row_weights)
        between = 2.0 * (gradient[:, first, second] * covariance).sum(dim=1)
        return [2.0 * (own + between), (1.0 - self.measurement_share / MAX_SHARE) * between]

    def leave_one_out(self, residual: Tensor, covariance: Tensor, row_weights: Tensor) -> tuple[Tensor, Tensor]:
        """Errors of the prediction of each row of a Gaussian process from the other rows.

        The prediction is that of the function, as for a new drive: the noise of the neighbours is not used to predict
        the noise of the row. All is in closed form in ``P``, the inverse of the covariance, and ``N``, the covariance
        of the noise, by the inverse without row k, ``P - P_:k P_k: / P_kk`` (Rasmussen and Williams 2006, section
        5.4.2). For independent noise it is ``outliers.leave_one_out``.

        Args:
            residual: (n, O).
            covariance: of the rows with this noise and the weights (O, n, n).
            row_weights: weights (n,).

        Returns:
            Errors in units of their standard deviation at weight 1 (n, O), and their variance there (n, O).
        """
        if self.step_numbers is None:
            return leave_one_out(residual, covariance, self.std, row_weights)
        precision = torch.cholesky_inverse(torch.linalg.cholesky(covariance))
        product = self._times(precision, row_weights)
        own, share = (matrix.diagonal(dim1=1, dim2=2) for matrix in (precision, product))
        solved = precision @ residual.T[:, :, None]
        error = (self._times(solved, row_weights) + ((1.0 - share) / own)[:, :, None] * solved)[:, :, 0]
        # The diagonal of N - N P N.
        given_rows = self._variance(row_weights) - self._times(product.mT, row_weights).diagonal(dim1=1, dim2=2)
        function_variance = given_rows + (1.0 - share) ** 2 / own
        # The noise of the row is correlated with that of the neighbours, from which the function is predicted.
        prediction_and_noise = (given_rows - (1.0 - share) * share / own) * row_weights.sqrt()
        variance = function_variance + (self.std**2)[:, None] - 2.0 * prediction_and_noise
        variance = variance.clamp_min(1e-12).T
        return error.T / variance.sqrt(), variance

    def _variance(self, row_weights: Tensor) -> Tensor:
        """Variances (O, n)."""
        return (self.std**2)[:, None] / row_weights

    def _pairs(self, row_weights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Rows of consecutive steps: the first (m,) and the second (m,) of each pair, and their covariances (O, m)."""
        assert self.step_numbers is not None
        assert self.measurement_share is not None
        order = self.step_numbers.argsort()
        consecutive = self.step_numbers[order].diff() == 1
        first, second = order[:-1][consecutive], order[1:][consecutive]
        factor = -0.5 * self.measurement_share * self.std**2
        return first, second, factor[:, None] / (row_weights[first] * row_weights[second]).sqrt()

    def _times(self, matrix: Tensor, row_weights: Tensor) -> Tensor:
        """Product (O, n, m) of the covariances and matrices (O, n, m)."""
        product = self._variance(row_weights)[:, :, None] * matrix
        first, second, between = self._pairs(row_weights)
        product.index_add_(1, first, between[:, :, None] * matrix[:, second])
        return product.index_add_(1, second, between[:, :, None] * matrix[:, first])


def prior_logs(noise_std: Tensor, step_numbers: Tensor | None) -> tuple[list[Tensor], list[float]]:
    """Prior medians (O,) of the logarithms of ``RowNoise.of_logs``, and their prior standard deviations.

    Args:
        noise_std: prior median of the noise (O,).
        step_numbers: as for ``RowNoise``.
    """
    log_std = noise_std.double().log()
    if step_numbers is None:
        return [log_std], [LOG_STD_NOISE]
    return [log_std, torch.full_like(log_std, LOGIT_MEDIAN)], [LOG_STD_NOISE, LOGIT_STD]


def random_rows(
    count: int, size: int, step_numbers: Tensor | None, generator: torch.Generator, block_rows: int = BLOCK_ROWS
) -> Tensor:
    """Indices (m,) of at most ``size`` random rows, with step numbers in blocks of consecutive rows.

    Args:
        count: number of rows, n.
        size: maximum number of indices.
        step_numbers: of the rows' steps (n,), if known.
        generator: on the CPU.
        block_rows: rows of a block.
    """
    if step_numbers is None:
        return torch.randperm(count, generator=generator)[:size]
    blocks = torch.split(step_numbers.cpu().argsort(), block_rows)
    order = torch.randperm(len(blocks), generator=generator).tolist()
    return torch.cat([blocks[k] for k in order])[:size]
