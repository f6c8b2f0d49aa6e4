"""The prior of Sim-FSVGD with another estimator of its score than the Gaussian fit of the paper.

The paper (Rothfuss et al., arXiv 2403.16644) leaves other estimators to future work. Function values at close
measurement points are almost equal, so the process is narrow in most directions, and kernels with one width for all
directions do not resolve its score there. Therefore the draws are whitened by the Gaussian that the paper fits.
Particles can start far from all draws, where an estimated score can vanish; an estimator with ``from_normal`` has the
score of the Gaussian there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch
from torch import Tensor

from learning.functional_svgd.fsvgd import SimulatorPrior
from learning.functional_svgd.score_estimators import ScoreEstimator
from learning.priors.function_prior import Marginal, gaussian_process

DRAWS = 128
"""Draws of the process at a measurement set. Each step has new draws, whose errors average out over the steps. The time
of SSGE grows with the cube of their number, that of the nu-method with its square."""


@dataclass(frozen=True, slots=True)
class EstimatedMarginal:
    """The simulator process at N points.

    Attributes:
        gaussian: its Gaussian fit.
        white_draws: its draws, whitened by this fit (O, P, N).
        estimator: of the score of the whitened process.
    """

    gaussian: Marginal
    white_draws: Tensor
    estimator: ScoreEstimator

    def precision(self) -> Tensor:
        """Inverse of the covariance of each output (O, N, N)."""
        return self.gaussian.precision()

    def score(self, values: Tensor) -> Tensor:
        """Estimated gradient of the log density by values (L, N, O), output by output."""
        white = self.estimator(self.white_draws, self.gaussian.whitened(values).transpose(1, 2))
        upper = self.gaussian.factor.transpose(1, 2)
        score: Tensor = torch.linalg.solve_triangular(upper, white.transpose(1, 2), upper=True)
        return score.permute(2, 1, 0)


@dataclass(frozen=True, slots=True)
class EstimatedPrior:
    """A ``SimulatorPrior`` whose score is estimated from draws of the simulator and of its discrepancy.

    Attributes:
        prior: simulator, discrepancy and jitter.
        estimator: of the score.
        seed: of the draws.
        count: P, draws at a measurement set; at most those of the simulator.
    """

    prior: SimulatorPrior
    estimator: ScoreEstimator
    seed: int = 0
    count: int = DRAWS
    _generator: torch.Generator = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_generator", torch.Generator().manual_seed(self.seed))

    def marginal(self, chosen: Tensor) -> EstimatedMarginal:
        """The process at the inputs with indices ``chosen`` (N,), with new draws in each call."""
        gaussian, simulated = self.prior.marginal(chosen), self.prior.draws
        picked = torch.randperm(len(simulated), generator=self._generator)[: self.count].to(simulated.device)
        draws = simulated[picked[:, None], chosen]
        white = gaussian.whitened(draws + self._discrepancy(chosen, draws))
        return EstimatedMarginal(gaussian, white.transpose(1, 2), self.estimator)

    def _discrepancy(self, chosen: Tensor, like: Tensor) -> Tensor:
        """Draws (P, N, O) of the discrepancy and of the jitter."""
        prior = self.prior
        normal = torch.randn(like.shape, generator=self._generator).to(like)
        if prior.discrepancy is None:
            return math.sqrt(prior.jitter) * normal
        factor = gaussian_process(prior.discrepancy_inputs[chosen], prior.discrepancy, prior.jitter).factor
        draws: Tensor = (factor @ normal.permute(2, 1, 0)).permute(2, 1, 0)
        return draws
