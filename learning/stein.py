"""Stein variational gradient descent on function values.

Liu and Wang 2016 ("Stein Variational Gradient Descent"), in function space as in Wang et al. 2019 ("Function Space
Particle Optimization for Bayesian Neural Networks"): a particle is the vector of a function's values at a measurement
set.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, slots=True)
class RbfKernel:
    """``k(a, b) = exp(-|a - b|^2 / (2 bandwidth^2))`` between flattened function values."""

    bandwidth: float

    def __call__(self, values: Tensor) -> Tensor:
        """Matrix (L, L) of values (L, F)."""
        values = values - values.mean(dim=0)  # Close particles with a large common value differ in few digits.
        square = (values * values).sum(dim=1)
        distance = (square[:, None] + square[None, :] - 2.0 * values @ values.T).clamp_min(0.0)
        distance = distance - torch.diag(distance.diagonal())  # exactly one on the diagonal
        return torch.exp(distance * (-0.5 / self.bandwidth**2))

    def repulsion(self, values: Tensor, matrix: Tensor) -> Tensor:
        """``sum_i`` of the gradient of ``k(h_i, h_l)`` with respect to ``h_i``, for each l: (L, F)."""
        # The term i = l is zero; it is omitted because its two parts would cancel only up to rounding.
        weight = (matrix - torch.diag(matrix.diagonal())) / self.bandwidth**2
        values = values - values.mean(dim=0)
        return weight.sum(dim=1, keepdim=True) * values - weight @ values


def median_bandwidth(values: Tensor) -> float:
    """Bandwidth by the median heuristic (Liu and Wang 2016, section 5) for values (L, F)."""
    distance = torch.pdist(values.double())
    count = max(len(values), 2)
    if not len(distance):
        return 1.0
    return max(float(distance.median()) / math.sqrt(2.0 * math.log(count + 1.0)), 1e-6)


def natural_direction(values: Tensor, score: Tensor, precision: Tensor, kernel: RbfKernel) -> Tensor:
    """Ascent direction by the matrix-valued kernel ``Q^-1 k(a, b)`` with a scalar kernel k and a precision Q.

    Wang, Tang, Bajaj and Liu 2019 ("Stein Variational Gradient Descent with Matrix-Valued Kernels", section 3.1). The
    preconditioner does not change the target; it equalises convergence in narrow and wide directions. For a Gaussian
    target with precision Q the driving term points to its mean.

    Args:
        values: function values (L, N, O).
        score: gradient of the log density with respect to each particle's values (L, N, O).
        precision: of each output over the points (O, N, N), symmetric and positive definite.
        kernel: between the flattened values.

    Returns:
        Directions (L, N, O). With one particle it is Newton's step.
    """
    direction = stein_direction(values, score, kernel).permute(2, 1, 0)
    solved: Tensor = torch.cholesky_solve(direction, torch.linalg.cholesky(precision))
    return solved.permute(2, 1, 0)


def stein_direction(values: Tensor, score: Tensor, kernel: RbfKernel, repulsion: float = 1.0) -> Tensor:
    """Ascent direction of each particle in function space.

    ``(1/L) sum_i [k(h_i, h_l) grad ln p(h_i) + grad_{h_i} k(h_i, h_l)]``: equation 2 of Rothfuss et al. (arXiv
    2403.16644) with both terms averaged over the particles, as in Liu and Wang 2016, equation 8.

    Args:
        values: function values (L, N, O).
        score: gradient of the log density with respect to each particle's values (L, N, O).
        kernel: between the flattened values.
        repulsion: weight of the repulsive term; 1 in Stein's direction.

    Returns:
        Directions (L, N, O). With one particle it is the score: gradient ascent to the mode.
    """
    flat = values.flatten(1)
    matrix = kernel(flat)
    direction = matrix @ score.flatten(1) + repulsion * kernel.repulsion(flat, matrix)
    return (direction / len(values)).view_as(values)


def moment_direction(values: Tensor, mean: Tensor, factor: Tensor) -> Tensor:
    """Stein's direction to a Gaussian with the linear kernel ``k(u, v) = 1 + u . v / c`` between whitened values.

    Its fixed points are exactly the particles that have the Gaussian's mean and covariance (Liu and Wang 2018, "Stein
    Variational Gradient Descent as Moment Matching", theorem 3). Whitening is the matrix-valued kernel of
    ``natural_direction``. A set must have fewer points than particles, because the covariance of L particles has rank
    L - 1.

    Args:
        values: values of L particles at G sets of N points, one output per set (L, G, N).
        mean: of the Gaussian (G, N).
        factor: Cholesky factor of its covariance (G, N, N).

    Returns:
        Directions (L, G, N), in units of the values; those of distant particles point almost to the mean.
    """
    deviation = (values - mean).permute(1, 2, 0)  # (G, N, L)
    white = torch.linalg.solve_triangular(factor, deviation, upper=False)
    gram = white.transpose(1, 2) @ white  # (G, L, L)
    count, points = values.shape[0], values.shape[2]
    # The kernel's width c is the particles' mean square (at least 1), in analogy to the median heuristic.
    width = (gram.diagonal(dim1=1, dim2=2).sum(dim=1) / (count * points)).clamp_min(1.0)[:, None, None]
    white_direction = (white - white @ gram / count) / width - white.mean(dim=2, keepdim=True)
    direction: Tensor = (factor @ white_direction).permute(2, 0, 1)
    return direction
