"""Posterior of a simulator's parameters by sequential Monte Carlo, without gradients.

Draws of the prior are moved to the posterior through tempered likelihoods, with random-walk Metropolis steps in between
(Del Moral, Doucet and Jasra 2006, "Sequential Monte Carlo samplers"). The walk is in standard normal variables, which
``DomainModel.parameters`` maps to parameters, so that any prior distribution can be used.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from carlab.core.errors import DataError
from learning.networks.normaliser import Normaliser
from learning.priors.domain_models import NO_FINITE_OUTPUT, DomainModel

log = logging.getLogger(__name__)

RANDOM_WALK_STEPS = 4
"""Metropolis steps after each tempering step; three times as many at the end."""
MIN_EFFECTIVE_SHARE = 0.5
"""Effective sample size after a tempering step, as a share of the draws."""
MAX_TEMPERING_STEPS = 1000
"""Bound for a likelihood that does not converge; 25 parameters known to 0.0001 of their prior width take 110 steps."""
TARGET_ACCEPTANCE = 0.25
"""Acceptance rate of Metropolis steps (Roberts and Rosenthal 2001)."""


@dataclass(slots=True)
class _Walkers:
    """Standard normal variables of the draws (P, K) and log likelihoods (P,)."""

    normal: Tensor
    log_likelihood: Tensor


def posterior_parameters(
    model: DomainModel,
    inputs: Tensor,
    outputs: Tensor,
    cholesky: Tensor,
    normaliser: Normaliser,
    count: int,
    generator: torch.Generator,
) -> Tensor:
    """Draws of the parameters given rows.

    Args:
        model: the simulator with the distribution of its parameters.
        inputs: raw (n, D).
        outputs: raw (n, O).
        cholesky: factors (O, n, n) of the covariance of discrepancy and noise, in normalised outputs.
        normaliser: of the outputs.
        count: P, the number of draws.
        generator: of all randomness, on the CPU.

    Returns:
        Parameters (P, K); one draw of a simulator without parameters.

    Raises:
        DataError: the simulator gives no finite number for any draw.
    """
    targets = normaliser.outputs(outputs).double()
    device = targets.device

    def log_likelihood(normal: Tensor) -> Tensor:
        simulated = normaliser.outputs(model(inputs, model.parameters(normal).to(inputs))).double()
        residual = (targets - simulated).permute(2, 1, 0)  # (O, n, P)
        white = torch.linalg.solve_triangular(cholesky, residual, upper=False)
        return torch.nan_to_num(-0.5 * (white * white).sum(dim=(0, 1)), nan=-torch.inf)

    with torch.no_grad():
        normal = torch.randn((count if model.size else 1, model.size), generator=generator).double().to(device)
        if not len(inputs) or not model.size:
            return model.parameters(normal).to(inputs)
        walkers = _Walkers(normal, log_likelihood(normal))
        if not bool(torch.isfinite(walkers.log_likelihood).any()):
            raise DataError(NO_FINITE_OUTPUT)
        _temper(walkers, log_likelihood, generator)
        return model.parameters(walkers.normal).to(inputs)


def _temper(walkers: _Walkers, log_likelihood: Callable[[Tensor], Tensor], generator: torch.Generator) -> None:
    """Move the draws to the posterior, whose likelihood has the exponent 1; a smaller exponent is a wider posterior."""
    exponent = 0.0
    for _ in range(MAX_TEMPERING_STEPS):
        step = _tempering_step(walkers.log_likelihood, 1.0 - exponent)
        exponent += step
        proposal = _reweight(walkers, step, generator)
        moves = RANDOM_WALK_STEPS if exponent < 1.0 else 3 * RANDOM_WALK_STEPS
        _random_walk(walkers, log_likelihood, exponent, proposal, moves, generator)
        if exponent >= 1.0:
            return
    log.warning(
        "The posterior of the simulator's parameters is too wide: after %d tempering steps the exponent of the "
        "likelihood is %.2g instead of 1; narrow the ranges of the parameters in the car file.",
        MAX_TEMPERING_STEPS,
        exponent,
    )


def _reweight(walkers: _Walkers, step: float, generator: torch.Generator) -> Tensor:
    """Resample by the likelihood to the power ``step``; returns the Cholesky factor (K, K) of the draws' covariance."""
    normal, size = walkers.normal, walkers.normal.shape[1]
    weight = torch.softmax(step * walkers.log_likelihood, dim=0)
    chosen = _resample(weight, generator)
    covariance = torch.cov(normal.T, correction=0, aweights=weight).reshape(size, size)
    walkers.normal, walkers.log_likelihood = normal[chosen], walkers.log_likelihood[chosen]
    jitter = 1e-6 * torch.eye(size, dtype=torch.float64, device=normal.device)
    factor: Tensor = torch.linalg.cholesky(covariance + jitter)
    return factor


def _random_walk(
    walkers: _Walkers,
    log_likelihood: Callable[[Tensor], Tensor],
    exponent: float,
    proposal: Tensor,
    moves: int,
    generator: torch.Generator,
) -> None:
    """Metropolis steps in place; the step size is adapted to ``TARGET_ACCEPTANCE``.

    Args:
        walkers: the draws.
        log_likelihood: of draws (P, K): (P,).
        exponent: of the likelihood.
        proposal: Cholesky factor of the proposal's covariance (K, K).
        moves: number of steps.
        generator: of all randomness.
    """
    count, size = walkers.normal.shape
    device = walkers.normal.device
    scale = 2.38 / size**0.5
    for _ in range(moves):
        offset = torch.randn((count, size), generator=generator).double().to(device)
        proposed = walkers.normal + scale * offset @ proposal.T
        proposed_likelihood = log_likelihood(proposed)
        prior_gain = 0.5 * ((walkers.normal**2).sum(dim=1) - (proposed**2).sum(dim=1))
        gain = exponent * (proposed_likelihood - walkers.log_likelihood) + prior_gain
        accepted = torch.log(torch.rand(count, generator=generator)).to(device) < gain
        walkers.normal = torch.where(accepted[:, None], proposed, walkers.normal)
        walkers.log_likelihood = torch.where(accepted, proposed_likelihood, walkers.log_likelihood)
        scale *= float(torch.exp(2.0 * (accepted.float().mean() - TARGET_ACCEPTANCE)))


def _tempering_step(log_likelihood: Tensor, max_step: float) -> float:
    """Largest increase of the likelihood's exponent, at most ``max_step``, by ``MIN_EFFECTIVE_SHARE``."""
    relative = (log_likelihood - log_likelihood.max()).cpu()  # The bisection is scalar; it is fastest on the CPU.

    def effective_share(step: float) -> float:
        weight = torch.softmax(step * relative, dim=0)
        return float(1.0 / (weight**2).sum()) / len(relative)

    if effective_share(max_step) >= MIN_EFFECTIVE_SHARE:
        return max_step
    low, high = 0.0, max_step
    for _ in range(50):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if effective_share(middle) >= MIN_EFFECTIVE_SHARE else (low, middle)
    return max(low, 1e-12)


def _resample(weight: Tensor, generator: torch.Generator) -> Tensor:
    """Indices (P,) of draws in proportion to their weights, by systematic resampling."""
    count = len(weight)
    points = torch.arange(count, dtype=weight.dtype) + torch.rand(1, generator=generator).to(weight.dtype)
    return torch.searchsorted(weight.cumsum(dim=0), (points / count).to(weight.device)).clamp_max(count - 1)
