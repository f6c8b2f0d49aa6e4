"""How good a probabilistic prediction is: joint log-likelihood, error, and calibration."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from scipy.special import stdtr
from torch import Tensor

from learning.outliers import joint_surprise, log_student, tail_scales

LEVELS = (0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.977, 0.99)
"""Nominal coverages at which calibration is read."""


@dataclass(frozen=True, slots=True)
class Mixture:
    """Equally weighted components, each Gaussian or Student's.

    Attributes:
        means: (L, N, O).
        stds: scales that broadcast against them; of Gaussians the standard deviations; of turned errors if they are.
        freedom: degrees of freedom of the components' multivariate Student distributions: one scale of a row widens
            all of its outputs (Lange, Little and Taylor 1989, section 2); infinite for Gaussians.
        turn: what a component's errors are multiplied by (O, O) from the left before anything is said of them; nothing
            unless given.
        correlation: of these errors within each component (O, O); none unless given.
    """

    means: Tensor
    stds: Tensor
    freedom: float = math.inf
    turn: Tensor | None = None
    correlation: Tensor | None = None

    @property
    def mean(self) -> Tensor:
        """Mean (N, O)."""
        return self.means.mean(dim=0)

    @property
    def epistemic_std(self) -> Tensor:
        """Spread of the components' means (N, O)."""
        return self.means.std(dim=0, correction=0)

    @property
    def aleatoric_std(self) -> Tensor:
        """Root of the components' mean variance (N, O); infinite for two degrees of freedom or fewer."""
        if math.isinf(self.freedom):
            widened = 1.0
        else:
            widened = self.freedom / (self.freedom - 2.0) if self.freedom > 2.0 else math.inf
        return (widened * self.own_stds**2).expand_as(self.means).mean(dim=0).sqrt()

    @property
    def own_stds(self) -> Tensor:
        """Scale of each output on its own, whatever the others are; broadcasts against the means."""
        if self.turn is None:
            return self.stds
        back: Tensor = torch.linalg.inv_ex(self.turn).inverse
        if self.correlation is None:
            return (self.stds**2 @ (back**2).T).sqrt()
        factor: Tensor = back * self.stds[..., None, :] @ torch.linalg.cholesky_ex(self.correlation).L
        return factor.square().sum(dim=-1).sqrt()

    def _turned(self, errors: Tensor) -> Tensor:
        return errors if self.turn is None else errors @ self.turn.T

    @property
    def std(self) -> Tensor:
        """Standard deviation of the mixture (N, O), by the law of total variance."""
        return (self.epistemic_std**2 + self.aleatoric_std**2).sqrt()

    def smoothed(self, bandwidth: float = 0.9) -> Mixture:
        """The same mean and, of Gaussians, variance of the (turned) errors, with components that overlap.

        A few components far apart against their own width are a poor picture of the density that they are drawn from,
        the more outputs the worse. Each is drawn to the mean by ``sqrt(1 - b^2)`` and widened by the share ``b^2`` of
        the spread (West 1993, "Approximating posterior distributions by mixture", section 3.2); 1 makes them one.
        Where there are heavy tails, that share of the spread has them as well: they are those of rows left out, in
        units of noise and function's doubt together.

        Args:
            bandwidth: b, from 0 to 1.
        """
        shrink = math.sqrt(1.0 - bandwidth**2)
        away = self.means - self.mean
        spread = bandwidth * self._turned(away).std(dim=0, correction=0)
        return replace(self, means=self.mean + shrink * away, stds=(self.stds**2 + spread**2).sqrt())

    def gaussians(self, each: int = 20) -> Mixture:
        """Nearly the same of Gaussians alone, ``each`` of a Student component; the farthest of its tails is lost."""
        if math.isinf(self.freedom):
            return self
        scales = tail_scales(self.freedom, each).to(self.stds)[:, None, None, None]
        means = self.means.expand(each, *self.means.shape)
        stds = (scales * self.stds.expand_as(self.means)).flatten(0, 1)
        return Mixture(means.flatten(0, 1), stds, turn=self.turn, correlation=self.correlation)

    def log_density(self, targets: Tensor) -> Tensor:
        """Joint log density (N,) of targets (N, O)."""
        white = self._turned(targets - self.means) / self.stds
        widths = self.stds.log().expand_as(self.means).sum(dim=2)
        if self.correlation is None:
            square = (white**2).sum(dim=2)
        else:
            square = joint_surprise(white, self.correlation)
            widths = widths + 0.5 * torch.linalg.slogdet(self.correlation).logabsdet
        if self.turn is not None:
            widths = widths - torch.linalg.slogdet(self.turn).logabsdet
        each = log_student(square, self.means.shape[2], self.freedom) - widths
        return torch.logsumexp(each, dim=0) - math.log(len(self.means))


def negative_log_likelihood(prediction: Mixture, targets: Tensor) -> float:
    """Mean over points of the joint negative log density of all outputs [nat]."""
    return -float(prediction.log_density(targets).mean())


def root_mean_square_error(prediction: Mixture, targets: Tensor) -> float:
    """Root of the squared error of the mean, summed over outputs and averaged over points."""
    return float(((prediction.mean - targets) ** 2).sum(dim=1).mean().sqrt())


def calibration_error(prediction: Mixture, targets: Tensor) -> float:
    """Mean absolute difference of empirical and nominal coverage over ``LEVELS`` and outputs.

    Central intervals of the mixture's own distribution function, output by output. Of one Gaussian they are those by
    mean and standard deviation that the authors of Sim-FSVGD measure.
    """
    white = (targets - prediction.means) / prediction.own_stds
    if math.isinf(prediction.freedom):
        below = torch.special.ndtr(white).mean(dim=0)
    else:
        below = torch.from_numpy(stdtr(prediction.freedom, white.cpu().double().numpy())).mean(dim=0).to(white)
    reached = (2.0 * below - 1.0).abs()
    levels = torch.tensor(LEVELS, dtype=reached.dtype, device=reached.device)
    covered = (reached[None] <= levels[:, None, None]).to(reached.dtype).mean(dim=1)
    return float((covered - levels[:, None]).abs().mean())


__all__ = [
    "LEVELS",
    "Mixture",
    "calibration_error",
    "negative_log_likelihood",
    "root_mean_square_error",
]
