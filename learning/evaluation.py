"""Predictive distributions and their scores: joint log-likelihood, root mean square error, calibration error."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import torch
from scipy.special import stdtr
from torch import Tensor

from learning.outliers import log_student, mahalanobis_sq, tail_scales

LEVELS = (0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.977, 0.99)
"""Nominal coverages of the calibration error."""


@dataclass(frozen=True, slots=True)
class Mixture:
    """Equally weighted multivariate components, Gaussian or Student-t.

    Attributes:
        means: (L, N, O).
        stds: scales that broadcast to (L, N, O): standard deviations if ``dof`` is infinite; of decorrelated errors if
            ``decorrelation`` is given.
        dof: degrees of freedom of the components' multivariate Student-t distributions, in which one random scale
            multiplies all outputs (Lange, Little and Taylor 1989, section 2); infinite for Gaussians.
        decorrelation: matrix (O, O) that multiplies a component's errors from the left; None is the identity.
        correlation: of these errors within each component (O, O); None is the identity.
    """

    means: Tensor
    stds: Tensor
    dof: float = math.inf
    decorrelation: Tensor | None = None
    correlation: Tensor | None = None

    @property
    def mean(self) -> Tensor:
        """Mean (N, O)."""
        return self.means.mean(dim=0)

    @property
    def epistemic_std(self) -> Tensor:
        """Standard deviation of the components' means (N, O)."""
        return self.means.std(dim=0, correction=0)

    @property
    def aleatoric_std(self) -> Tensor:
        """Root mean variance of the components (N, O); infinite for two degrees of freedom or fewer."""
        if math.isinf(self.dof):
            variance_factor = 1.0
        else:
            variance_factor = self.dof / (self.dof - 2.0) if self.dof > 2.0 else math.inf
        return (variance_factor * self.marginal_scales**2).expand_as(self.means).mean(dim=0).sqrt()

    @property
    def marginal_scales(self) -> Tensor:
        """Scale of each output's marginal distribution, in the shape of ``stds``; broadcasts to (L, N, O)."""
        if self.decorrelation is None:
            return self.stds
        inverse: Tensor = torch.linalg.inv_ex(self.decorrelation).inverse
        if self.correlation is None:
            return (self.stds**2 @ (inverse**2).T).sqrt()
        factor: Tensor = inverse * self.stds[..., None, :] @ torch.linalg.cholesky_ex(self.correlation).L
        return factor.square().sum(dim=-1).sqrt()

    def decorrelated(self, errors: Tensor) -> Tensor:
        """Errors (..., O) of raw outputs as those of the decorrelated outputs."""
        return errors if self.decorrelation is None else errors @ self.decorrelation.T

    @property
    def std(self) -> Tensor:
        """Standard deviation of the mixture (N, O), by the law of total variance."""
        return (self.epistemic_std**2 + self.aleatoric_std**2).sqrt()

    def smoothed(self, bandwidth: float = 0.9) -> Mixture:
        """Kernel-smooth the components, so that they overlap.

        The mean is unchanged, and so is the variance of Gaussians. With a decorrelation this is the variance of the
        decorrelated errors; the added variance has the correlation of the components, not that of their means.

        Deviations from the mean shrink by ``sqrt(1 - b^2)``; the components' variance grows by ``b^2`` times the
        variance of their means (West 1993, "Approximating posterior distributions by mixture", section 3.2). For
        Student-t components the added variance has the same tails.

        Args:
            bandwidth: b, from 0 to 1; all components are equal for 1.
        """
        shrink = math.sqrt(1.0 - bandwidth**2)
        deviation = self.means - self.mean
        spread = bandwidth * self.decorrelated(deviation).std(dim=0, correction=0)
        return replace(self, means=self.mean + shrink * deviation, stds=(self.stds**2 + spread**2).sqrt())

    def gaussians(self, each: int = 20) -> Mixture:
        """Approximation by ``each * L`` Gaussians, ``each`` for a Student-t component; it has lighter far tails."""
        if math.isinf(self.dof):
            return self
        scales = tail_scales(self.dof, each).to(self.stds)[:, None, None, None]
        means = self.means.expand(each, *self.means.shape)
        stds = (scales * self.stds.expand_as(self.means)).flatten(0, 1)
        return Mixture(means.flatten(0, 1), stds, decorrelation=self.decorrelation, correlation=self.correlation)

    def cdf(self, targets: Tensor) -> Tensor:
        """Marginal distribution function (N, O) at targets (N, O)."""
        white = (targets - self.means) / self.marginal_scales
        if math.isinf(self.dof):
            normal: Tensor = torch.special.ndtr(white)
            return normal.mean(dim=0)
        return torch.from_numpy(stdtr(self.dof, white.cpu().double().numpy())).mean(dim=0).to(white)

    def log_density(self, targets: Tensor) -> Tensor:
        """Joint log density (N,) of targets (N, O)."""
        white = self.decorrelated(targets - self.means) / self.stds
        log_volume = self.stds.log().expand_as(self.means).sum(dim=2)
        if self.correlation is None:
            square = (white**2).sum(dim=2)
        else:
            square = mahalanobis_sq(white, self.correlation)
            log_volume = log_volume + 0.5 * torch.linalg.slogdet(self.correlation).logabsdet
        if self.decorrelation is not None:
            log_volume = log_volume - torch.linalg.slogdet(self.decorrelation).logabsdet
        component = log_student(square, self.means.shape[2], self.dof) - log_volume
        return torch.logsumexp(component, dim=0) - math.log(len(self.means))


class Prediction(Protocol):
    """A predictive distribution at N points."""

    @property
    def mean(self) -> Tensor:
        """Mean (N, O)."""
        ...

    def cdf(self, targets: Tensor) -> Tensor:
        """Marginal distribution function (N, O) at targets (N, O)."""
        ...

    def log_density(self, targets: Tensor) -> Tensor:
        """Joint log density (N,) of targets (N, O)."""
        ...


class Predictor(Protocol):
    """A fitted model."""

    def predict(self, inputs: Tensor) -> Prediction:
        """Prediction at raw inputs (N, D), in raw units."""
        ...


@dataclass(frozen=True, slots=True)
class WeightedMixture:
    """Weighted average of the predictions of several models; weights (K,) sum to 1."""

    predictions: Sequence[Prediction]
    weights: Tensor

    @property
    def mean(self) -> Tensor:
        """Mean (N, O)."""
        return self._average([p.mean for p in self.predictions])

    def cdf(self, targets: Tensor) -> Tensor:
        """Marginal distribution function (N, O) at targets (N, O)."""
        return self._average([p.cdf(targets) for p in self.predictions])

    def log_density(self, targets: Tensor) -> Tensor:
        """Joint log density (N,) of targets (N, O)."""
        by_model = torch.stack([p.log_density(targets) for p in self.predictions])
        weighted: Tensor = by_model + self.weights.to(by_model).log()[:, None]
        return weighted.logsumexp(dim=0)

    def _average(self, values: Sequence[Tensor]) -> Tensor:
        stacked = torch.stack(list(values))
        average: Tensor = torch.tensordot(self.weights.to(stacked), stacked, dims=1)
        return average


def negative_log_likelihood(prediction: Prediction, targets: Tensor) -> float:
    """Mean over points of the joint negative log density of all outputs [nat].

    Args:
        prediction: at N points.
        targets: (N, O).
    """
    return -float(prediction.log_density(targets).mean())


def root_mean_square_error(prediction: Prediction, targets: Tensor) -> float:
    """Root of the squared error of the mean, summed over outputs and averaged over points; targets (N, O)."""
    return float(((prediction.mean - targets) ** 2).sum(dim=1).mean().sqrt())


def calibration_error(prediction: Prediction, targets: Tensor) -> float:
    """Mean absolute difference of empirical and nominal coverage over ``LEVELS`` and outputs.

    Coverage of central intervals of the mixture's distribution function, output by output. For one Gaussian this is the
    calibration error of Rothfuss et al. (arXiv 2403.16644, section 6).

    Args:
        prediction: at N points.
        targets: (N, O).
    """
    central = (2.0 * prediction.cdf(targets) - 1.0).abs()
    levels = torch.tensor(LEVELS, dtype=central.dtype, device=central.device)
    covered = (central[None] <= levels[:, None, None]).to(central.dtype).mean(dim=1)
    return float((covered - levels[:, None]).abs().mean())
