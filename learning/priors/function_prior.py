"""Priors over functions as Gaussian marginals at a measurement set, and their score: the priors of the paper.

A domain-model process (a simulator with parameters from a prior; Rothfuss et al., arXiv 2403.16644, section 4.1) is
replaced by the Gaussian with the moments of its draws; a Gaussian process for the model discrepancy adds its covariance
(section 4.2). Outputs are independent of each other given the inputs, as in the paper.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

JITTER = 1e-4
"""Variance added to each normalised value, as in the authors' code."""


@dataclass(frozen=True, slots=True)
class Marginal:
    """A Gaussian over function values at N points: mean (N, O) and the Cholesky factor (O, N, N) of its covariance."""

    mean: Tensor
    factor: Tensor

    def precision(self) -> Tensor:
        """Inverse of the covariance of each output (O, N, N)."""
        inverse: Tensor = torch.cholesky_inverse(self.factor)
        return inverse

    def score(self, values: Tensor) -> Tensor:
        """Gradient of the log density by values (L, N, O): ``-K^-1 (h - m)``, output by output."""
        deviation = (values - self.mean).permute(2, 1, 0)  # (O, N, L)
        solved: Tensor = torch.cholesky_solve(deviation, self.factor)
        return -solved.permute(2, 1, 0)

    def whitened(self, values: Tensor) -> Tensor:
        """Values (L, N, O) minus the mean, with the inverse of the factor applied: (O, N, L)."""
        deviation = (values - self.mean).permute(2, 1, 0)
        white: Tensor = torch.linalg.solve_triangular(self.factor, deviation, upper=False)
        return white


@dataclass(frozen=True, slots=True)
class RbfCovariance:
    """Covariance of a zero-mean Gaussian process, one for each output: ``scale_o^2 exp(-|a - b|^2 / (2 l^2))``.

    Squared exponential covariance (Rasmussen and Williams 2006, equation 4.9).

    Attributes:
        scales: standard deviation of each output.
        lengthscales: one for each input, or one for all.
    """

    scales: Sequence[float]
    lengthscales: Sequence[float]

    def __call__(self, inputs: Tensor) -> Tensor:
        """Covariances (O, N, N) at inputs (N, D)."""
        scaled = inputs / torch.as_tensor(self.lengthscales, dtype=inputs.dtype, device=inputs.device)
        square = (scaled * scaled).sum(dim=1)
        distance = (square[:, None] + square[None, :] - 2.0 * scaled @ scaled.T).clamp_min(0.0)
        variance = torch.as_tensor(self.scales, dtype=inputs.dtype, device=inputs.device) ** 2
        return variance[:, None, None] * torch.exp(-0.5 * distance)


def gaussian_process(inputs: Tensor, covariance: RbfCovariance, jitter: float = JITTER) -> Marginal:
    """Marginal of a zero-mean Gaussian process at inputs (N, D)."""
    return _factored(torch.zeros(len(inputs), len(covariance.scales)).to(inputs), covariance(inputs), jitter)


def simulator_marginal(
    draws: Tensor, inputs: Tensor, discrepancy: RbfCovariance | None = None, jitter: float = JITTER
) -> Marginal:
    """Gaussian with the moments of a domain-model process and its discrepancy.

    Args:
        draws: simulator outputs for P parameter draws at the measurement set (P, N, O), normalised.
        inputs: of the discrepancy at the measurement set (N, D).
        discrepancy: its covariance; None: no discrepancy.
        jitter: variance added to each value.
    """
    mean, covariance = moments(draws)
    if discrepancy is not None:
        covariance = covariance + discrepancy(inputs)
    return _factored(mean, covariance, jitter)


def moments(draws: Tensor) -> tuple[Tensor, Tensor]:
    """Mean (N, O) and covariances (O, N, N) of draws (P, N, O)."""
    mean = draws.mean(dim=0)
    deviation = (draws - mean).permute(2, 0, 1)  # (O, P, N)
    return mean, deviation.transpose(1, 2) @ deviation / len(draws)


def _factored(mean: Tensor, covariance: Tensor, jitter: float) -> Marginal:
    eye = torch.eye(covariance.shape[-1], dtype=covariance.dtype, device=covariance.device)
    return Marginal(mean, torch.linalg.cholesky(covariance + jitter * eye))
