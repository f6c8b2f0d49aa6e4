"""Estimators of the score (gradient of the log density) of a distribution from its draws.

Sim-FSVGD (Rothfuss et al., arXiv 2403.16644) fits a Gaussian to draws of the simulator process and takes its score; the
other estimators make no such assumption. All have the same form: draws (B, n, d) and points (B, m, d) of B independent
distributions give scores (B, m, d) in the reciprocal units of the draws.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

ScoreEstimator = Callable[[Tensor, Tensor], Tensor]
"""Scores (B, m, d) from draws (B, n, d), at points (B, m, d)."""


def kernel_density(draws: Tensor, points: Tensor) -> Tensor:
    """Scores (B, m, d) of a kernel density estimate with a Gaussian kernel.

    The kernel's standard deviation in each coordinate is that of the draws times ``n^(-1 / (d + 4))`` (Scott 1992,
    "Multivariate Density Estimation", Scott's rule).
    """
    count, width = draws.shape[1:]
    bandwidth = draws.std(dim=1, keepdim=True) * count ** (-1.0 / (width + 4))
    scaled_draws, scaled_points = draws / bandwidth, points / bandwidth
    weights = torch.softmax(-0.5 * squared_distances(scaled_points, scaled_draws), dim=2)
    score: Tensor = (weights @ scaled_draws - scaled_points) / bandwidth
    return score


@dataclass(frozen=True, slots=True)
class SpectralStein:
    """Spectral Stein gradient estimator (SSGE).

    Shi, Sun and Zhu 2018 ("A Spectral Approach to Gradient Estimation for Implicit Distributions"). The score is a sum
    of eigenfunctions of an RBF kernel ``k(a, b) = exp(-|a - b|^2 / (2 s^2))`` with s the median distance of the draws.
    The eigenfunctions are those of the Nystroem method; their coefficients follow from Stein's identity. Computed in
    double precision, because reciprocal eigenvalues occur squared.

    Attributes:
        share: of the sum of all eigenvalues; the fewest eigenfunctions with this share are used.
        from_normal: whether the score is that of the standard normal plus the sum of eigenfunctions. Far from all draws
            it is then the score of the standard normal; otherwise it is zero there.
    """

    share: float = 0.95
    from_normal: bool = False

    def __call__(self, draws: Tensor, points: Tensor) -> Tensor:
        """Scores (B, m, d) from draws (B, n, d), at points (B, m, d)."""
        given, draws, points = points, draws.double(), points.double()
        variance = median_distance(draws) ** 2
        kernel = torch.exp(-0.5 * squared_distances(draws, draws) / variance)
        values, vectors = torch.linalg.eigh(kernel)
        weights = _leading(values, self.share)[:, None] / values[:, None] ** 2
        smoothed = kernel @ draws
        slopes = (smoothed - kernel.sum(dim=2, keepdim=True) * draws) / variance
        if self.from_normal:
            slopes = slopes + smoothed
        coefficients = (vectors * weights) @ (vectors.transpose(1, 2) @ slopes)
        score: Tensor = torch.exp(-0.5 * squared_distances(points, draws) / variance) @ coefficients
        if self.from_normal:
            score = score - points
        return score.to(given)


@dataclass(frozen=True, slots=True)
class NuMethod:
    """The nu-method with a curl-free inverse multiquadric kernel.

    Zhou, Shi and Zhu 2020 ("Nonparametric Score Estimators", example C.4): regularisation by a number of accelerated
    gradient steps. The kernel is ``-s^2 Hess (1 + |a - b|^2 / s^2)^(-1/2)`` with s in proportion to the median distance
    of the draws; the factor ``s^2`` makes it the identity at equal arguments, so that the steps are stable in all
    units. Its functions are gradients, as scores are.

    Attributes:
        steps: number t of gradient steps; about the regularisation ``1 / t^2``.
        width: s in median distances. A curl-free kernel has second derivatives, so it needs a larger width than the
            kernel of SSGE.
        nu: order of the method.
        from_normal: whether the steps start from the score of the standard normal, in place of zero.
    """

    steps: int = 7
    width: float = 2.0
    nu: float = 1.0
    from_normal: bool = False

    def __call__(self, draws: Tensor, points: Tensor) -> Tensor:
        """Scores (B, m, d) from draws (B, n, d), at points (B, m, d)."""
        scale = self.width * median_distance(draws)
        draws, points = draws / scale, points / scale
        at_draws, at_points = CurlFreeImq(draws, draws), CurlFreeImq(points, draws)
        normal = -(scale**2) * draws if self.from_normal else torch.zeros_like(draws)
        # The estimate is ``start + share * source + kernel applied to coefficients``; the source is the mean divergence
        # of the kernel plus the mean of the kernel applied to the start.
        source = at_draws.mean_divergence() + at_draws @ normal / draws.shape[1]
        share, earlier_share = -(4.0 * self.nu + 2.0) / (4.0 * self.nu + 1.0), 0.0
        coefficients = earlier = torch.zeros_like(draws)
        for step in range(2, self.steps + 1):
            momentum, rate = _nu_weights(step, self.nu)
            gradient = (share * source + at_draws @ coefficients) / draws.shape[1]
            following = coefficients + momentum * (coefficients - earlier) - rate * gradient
            coefficients, earlier = following, coefficients
            share, earlier_share = share + momentum * (share - earlier_share) - rate, share
        start = -(scale**2) * points if self.from_normal else 0.0
        coefficients = coefficients + share * normal / draws.shape[1]
        score: Tensor = (start + share * at_points.mean_divergence() + at_points @ coefficients) / scale
        return score


def _nu_weights(step: int, nu: float) -> tuple[float, float]:
    """Weights of momentum and gradient in a step (from 2) of the nu-method (Engl, Hanke and Neubauer 1996)."""
    t = float(step)
    common = (2 * t + 2 * nu - 1) / ((t + 2 * nu - 1) * (2 * t + 4 * nu - 1))
    return common * (t - 1) * (2 * t - 3) / (2 * t + 2 * nu - 3), common * 4 * (t + nu - 1)


class CurlFreeImq:
    """Curl-free kernel ``-Hess g(|a - b|^2)``, ``g(q) = (1 + q)^(-1/2)``, between a (B, m, d) and b (B, n, d).

    Products need no matrix of size m d x n d.
    """

    def __init__(self, a: Tensor, b: Tensor) -> None:
        self._a, self._b = a, b
        inverse = 1.0 / (1.0 + squared_distances(a, b))
        self._identity = inverse**1.5  # -2 g'
        self._outer = -3.0 * inverse**2.5  # -4 g''
        # 4 ((d + 2) g'' + 2 q g'''), with q = 1 / inverse - 1.
        self._slope = inverse**2.5 * (3.0 * (a.shape[2] + 2) - 15.0 * (1.0 - inverse))

    def __matmul__(self, vectors: Tensor) -> Tensor:
        """Sums over b (B, m, d) of the kernel times vectors (B, n, d)."""
        along = self._a @ vectors.transpose(1, 2) - (self._b * vectors).sum(dim=2)[:, None]
        return self._identity @ vectors + self._differences(self._outer * along)

    def mean_divergence(self) -> Tensor:
        """Mean over b (B, m, d) of the kernel's divergence with respect to b."""
        return self._differences(self._slope) / self._b.shape[1]

    def _differences(self, weights: Tensor) -> Tensor:
        """Sums over b (B, m, d) of weights (B, m, n) times a - b."""
        difference: Tensor = weights.sum(dim=2, keepdim=True) * self._a - weights @ self._b
        return difference


def squared_distances(a: Tensor, b: Tensor) -> Tensor:
    """Squared distances (B, m, n) of a (B, m, d) and b (B, n, d)."""
    centre = b.mean(dim=1, keepdim=True)  # Close points with a large common value differ in few digits.
    a, b = a - centre, b - centre
    squares = (a * a).sum(dim=2)[:, :, None] + (b * b).sum(dim=2)[:, None]
    return (squares - 2.0 * a @ b.transpose(1, 2)).clamp_min(0.0)


def median_distance(draws: Tensor) -> Tensor:
    """Median (B, 1, 1) of the distances of all pairs of draws (B, n, d)."""
    first, second = torch.triu_indices(draws.shape[1], draws.shape[1], 1, device=draws.device)
    squares = squared_distances(draws, draws)[:, first, second]
    return squares.median(dim=1).values.sqrt()[:, None, None]


def _leading(values: Tensor, share: float) -> Tensor:
    """Ones (B, n) for the fewest largest eigenvalues (B, n, ascending) whose sum has this share; otherwise zeros."""
    descending = values.clamp_min(0.0).flip(1)
    before = descending.cumsum(dim=1) - descending
    return (before < share * descending.sum(dim=1, keepdim=True)).to(values).flip(1)
