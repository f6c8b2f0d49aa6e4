"""Which parameters of a simulator the data allows, from nothing but its outputs: a sequential Monte Carlo sampler.

Draws of the prior are led to the posterior through ever colder likelihoods, with steps of a random walk in between (Del
Moral, Doucet and Jasra 2006, "Sequential Monte Carlo samplers"). The walk is in the standard normal numbers behind the
parameters, so that any distribution will do and no gradient of the simulator is asked for.
"""

from __future__ import annotations

import torch
from torch import Tensor

from carlab.core.errors import DataError
from learning.domain_models import BROKEN_DOWN, DomainModel
from learning.normaliser import Normaliser

MOVES = 4
KEPT = 0.5
"""Effective share of the draws that a colder likelihood leaves."""
HOTTEST = 60
"""Temperatures after which the sampler stops; twenty are many."""


def posterior_parameters(
    model: DomainModel,
    inputs: Tensor,
    outputs: Tensor,
    factor: Tensor,
    normaliser: Normaliser,
    count: int,
    generator: torch.Generator,
) -> Tensor:
    """Draws of the parameters given data.

    Args:
        model: the simulator with the distribution of its parameters.
        inputs: raw (n, D).
        outputs: raw (n, O).
        factor: Cholesky factor (O, n, n) of the covariance of gap and noise, in normalised outputs.
        normaliser: of the outputs.
        count: how many draws.
        generator: of all randomness, on the CPU.

    Returns:
        Parameters (count, K).

    Raises:
        DataError: the simulator gives no finite number for any draw.
    """
    wanted = normaliser.outputs(outputs).double()
    device = wanted.device

    def log_likelihood(normal: Tensor) -> Tensor:
        found = normaliser.outputs(model(inputs, model.parameters(normal).to(inputs))).double()
        off = (wanted - found).permute(2, 1, 0)  # (O, n, P)
        white = torch.linalg.solve_triangular(factor, off, upper=False)
        return torch.nan_to_num(-0.5 * (white * white).sum(dim=(0, 1)), nan=-torch.inf)

    with torch.no_grad():
        normal = torch.randn((count, model.size), generator=generator).double().to(device)
        if not len(inputs) or not model.size:
            return model.parameters(normal).to(inputs)
        likelihood = log_likelihood(normal)
        if not bool(torch.isfinite(likelihood).any()):
            raise DataError(BROKEN_DOWN)
        cold = 0.0
        for _ in range(HOTTEST):
            step = _colder(likelihood, 1.0 - cold)
            weight = torch.softmax(step * likelihood, dim=0)
            chosen = _resampled(weight, generator)
            spread = torch.cov(normal.T, aweights=weight).reshape(model.size, model.size)
            normal, likelihood = normal[chosen], likelihood[chosen]
            cold += step
            root = torch.linalg.cholesky(spread + 1e-6 * torch.eye(model.size, dtype=torch.float64, device=device))
            scale = 2.38 / model.size**0.5
            for _ in range(MOVES if cold < 1.0 else 3 * MOVES):
                away = torch.randn(normal.shape, generator=generator).double().to(device)
                fresh = normal + scale * away @ root.T
                there = log_likelihood(fresh)
                gain = cold * (there - likelihood) + 0.5 * ((normal**2).sum(dim=1) - (fresh**2).sum(dim=1))
                taken = torch.log(torch.rand(count, generator=generator)).to(device) < gain
                normal = torch.where(taken[:, None], fresh, normal)
                likelihood = torch.where(taken, there, likelihood)
                # Towards a quarter of the steps taken (Roberts and Rosenthal 2001).
                scale *= float(torch.exp(2.0 * (taken.float().mean() - 0.25)))
            if cold >= 1.0:
                break
        return model.parameters(normal).to(inputs)


def _colder(likelihood: Tensor, rest: float) -> float:
    """The largest step of the likelihood's exponent, at most ``rest``, that keeps enough of the draws effective."""
    best = (likelihood - likelihood.max()).cpu()  # Fifty small questions are answered where they are asked.

    def effective(step: float) -> float:
        weight = torch.softmax(step * best, dim=0)
        return float(1.0 / (weight**2).sum()) / len(best)

    if effective(rest) >= KEPT:
        return rest
    low, high = 0.0, rest
    for _ in range(50):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if effective(middle) >= KEPT else (low, middle)
    return max(low, 1e-12)


def _resampled(weight: Tensor, generator: torch.Generator) -> Tensor:
    """Indices of draws in proportion to their weights, by systematic resampling."""
    count = len(weight)
    points = torch.arange(count, dtype=weight.dtype) + torch.rand(1, generator=generator).to(weight.dtype)
    return torch.searchsorted(weight.cumsum(dim=0), (points / count).to(weight.device)).clamp_max(count - 1)


__all__ = ["posterior_parameters"]
