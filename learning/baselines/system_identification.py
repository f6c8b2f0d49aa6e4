"""Maximum likelihood of a simulator's parameters (SysID), also with networks for its residual (GreyBox)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from carlab.core.errors import DataError
from learning.evaluation import Mixture
from learning.outliers import log_student
from learning.posterior.residuals import PRIOR_ROWS, ResidualDistribution, fit_residuals
from learning.priors.domain_models import DomainModel, draw_parameters

N_SCREENED = 1024
"""Draws of the parameters from which restarts are selected."""
N_RESTARTS = 16
STEPS = 600
LEARNING_RATE = 0.05
N_REFINEMENTS, REFINEMENT_STEPS, REFINEMENT_RATE = 3, 150, 0.01
"""Alternations between the distribution of the errors and the parameters given it."""
PRIOR_WIDTH_FACTOR = 4.0
"""Factor on the prior's standard deviation of each parameter in the penalty."""

Losses = Callable[[Tensor], Tensor]
"""Losses (S,) at offsets (S, K)."""


@dataclass(frozen=True, slots=True)
class IdentifiedSimulator:
    """A simulator with fitted parameters.

    Attributes:
        model: the simulator.
        parameters: (K,).
        residuals: distribution of its errors.
    """

    model: DomainModel
    parameters: Tensor
    residuals: ResidualDistribution

    def mean(self, inputs: Tensor) -> Tensor:
        """Outputs (N, O) at inputs (N, D)."""
        return self.model(inputs, self.parameters[None])[0]

    def predict(self, inputs: Tensor) -> Mixture:
        """One component at each of the inputs (N, D)."""
        return self.residuals.centred_at(self.mean(inputs)[None])


@dataclass(frozen=True, slots=True)
class GreyBox:
    """An identified simulator, and a prediction of its error at inputs (N, D)."""

    simulator: IdentifiedSimulator
    error: Callable[[Tensor], Mixture]

    def predict(self, inputs: Tensor) -> Mixture:
        """Prediction at inputs (N, D)."""
        error = self.error(inputs)
        return replace(error, means=error.means + self.simulator.mean(inputs))


@dataclass(frozen=True, slots=True)
class _Problem:
    """Rows, and a simulator whose parameters are offsets from the prior mean in prior standard deviations.

    Attributes:
        prior_mean, prior_std: of the parameters (K,).
        noise_std: prior noise (O,).
    """

    model: DomainModel
    inputs: Tensor
    outputs: Tensor
    prior_mean: Tensor
    prior_std: Tensor
    noise_std: Tensor

    @property
    def free(self) -> Tensor:
        """Mask (K,) of the parameters that are not fixed."""
        return self.prior_std > 1e-9

    @property
    def fitted_rows(self) -> float:
        """Fitted parameters divided by the outputs: the rows (degrees of freedom) used by their fit."""
        return float(self.free.sum()) / self.outputs.shape[1]

    def parameters(self, offsets: Tensor) -> Tensor:
        """Parameters (..., K) at offsets (..., K)."""
        return self.prior_mean + self.prior_std * offsets

    def errors(self, offsets: Tensor) -> Tensor:
        """Errors (S, n, O) at offsets (S, K)."""
        return self.outputs - self.model(self.inputs, self.parameters(offsets))

    def penalty(self, offsets: Tensor) -> Tensor:
        """Negative log density (S,) of the widened prior, up to a constant."""
        return 0.5 * (offsets**2).sum(dim=1) / PRIOR_WIDTH_FACTOR**2

    def concentrated_loss(self, offsets: Tensor) -> Tensor:
        """Concentrated negative log-likelihood (S,) of independent Gaussian errors, and penalty."""
        rows = len(self.inputs) + PRIOR_ROWS
        variance = ((self.errors(offsets) ** 2).sum(dim=1) + PRIOR_ROWS * self.noise_std**2) / rows
        return 0.5 * rows * variance.log().sum(dim=1) + self.penalty(offsets)

    def student_loss(self, offsets: Tensor, residuals: ResidualDistribution) -> Tensor:
        """Negative log-likelihood (S,) of correlated Student-t errors up to a constant, and penalty."""
        square = residuals.mahalanobis_sq(self.errors(offsets))
        return self.penalty(offsets) - log_student(square, self.outputs.shape[1], residuals.dof).sum(dim=1)

    def residuals_at(self, offset: Tensor) -> ResidualDistribution:
        """Distribution of the errors at one offset (K,)."""
        with torch.no_grad():
            return fit_residuals(self.errors(offset[None])[0], self.noise_std, self.fitted_rows)


def identify(
    model: DomainModel, inputs: Tensor, outputs: Tensor, noise_std: Tensor, seed: int = 0
) -> IdentifiedSimulator:
    """Fit a simulator's parameters by penalised maximum likelihood, with restarts.

    The first fit assumes independent Gaussian errors and concentrates out their variance. The second one assumes
    correlated Student-t errors (``fit_residuals``) and alternates between their distribution and the parameters.

    Args:
        model: simulator with a distribution of its parameters.
        inputs: (n, D).
        outputs: (n, O).
        noise_std: prior noise (O,), with the weight of ``PRIOR_ROWS`` rows.
        seed: of the restarts.

    Raises:
        DataError: no data, or no restart with finite outputs.
    """
    if len(inputs) == 0:
        raise DataError("Parameters cannot be identified without data; record an episode first.")
    generator = torch.Generator().manual_seed(seed)
    drawn = draw_parameters(model, N_SCREENED, generator).to(inputs)
    problem = _Problem(model, inputs, outputs, drawn.mean(dim=0), drawn.std(dim=0), noise_std)
    best = _fit_gaussian(problem, drawn)
    residuals = problem.residuals_at(best)
    for _ in range(N_REFINEMENTS):

        def loss(offsets: Tensor, residuals: ResidualDistribution = residuals) -> Tensor:
            return problem.student_loss(offsets, residuals)

        best = _best(loss, best[None], _descend(loss, best[None], problem.free, REFINEMENT_STEPS, REFINEMENT_RATE))
        residuals = problem.residuals_at(best)
    return IdentifiedSimulator(model, problem.parameters(best).detach(), residuals.to(outputs))


def _fit_gaussian(problem: _Problem, drawn: Tensor) -> Tensor:
    """Offset (K,) of the lowest concentrated loss, with restarts from the best of the drawn parameters (S, K)."""
    offsets = torch.where(problem.free, (drawn - problem.prior_mean) / problem.prior_std.clamp_min(1e-9), 0.0)
    with torch.no_grad():
        losses = torch.nan_to_num(problem.concentrated_loss(offsets), nan=torch.inf)
    starts = offsets[losses.argsort()[:N_RESTARTS]]
    ends = _descend(problem.concentrated_loss, starts, problem.free, STEPS, LEARNING_RATE)
    return _best(problem.concentrated_loss, starts, ends)


def _descend(losses: Losses, starts: Tensor, free: Tensor, steps: int, learning_rate: float) -> Tensor:
    """Offsets (S, K) after Adam from initial offsets (S, K); only those in the mask ``free`` (K,) change."""
    offsets = starts.clone().requires_grad_()
    optimiser = torch.optim.Adam([offsets], lr=learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps, eta_min=1e-2 * learning_rate)
    for _ in range(steps):
        (gradient,) = torch.autograd.grad(losses(offsets).nan_to_num(nan=0.0, posinf=0.0).sum(), offsets)
        offsets.grad = torch.where(free & torch.isfinite(gradient), gradient, 0.0)
        optimiser.step()
        schedule.step()
    return offsets.detach()


def _best(losses: Losses, starts: Tensor, ends: Tensor) -> Tensor:
    """The offset (K,) with the lowest finite loss among starts and ends; the loss of an end may be infinite."""
    offsets = torch.cat([starts, ends])
    with torch.no_grad():
        values = torch.nan_to_num(losses(offsets), nan=torch.inf)
    if not torch.isfinite(values).any():
        raise DataError("The simulator gives no finite outputs for this data; check the car file and the rows.")
    return offsets[values.argmin()]
