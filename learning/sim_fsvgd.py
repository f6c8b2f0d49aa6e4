"""Sim-FSVGD as carlab fits it: function-space SVGD to what simulator, gap and all of the data say together.

The score of a measurement set that holds all data is that of the posterior's marginals, which ``function_posterior``
has in closed form. Particles follow Stein's direction on many small sets at once (``stein.moment_direction``), pulled
back to their parameters (Rothfuss et al., arXiv 2403.16644, algorithm 1).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from carlab.core.errors import DataError, DivergedError
from learning.adam import Adam
from learning.domain_models import DomainModel
from learning.fsvgd import Posterior, reach_of
from learning.function_posterior import JITTER, FunctionPosterior
from learning.normaliser import Normaliser
from learning.particles import Activation, Network
from learning.stein import moment_direction

TOLD_EVERY = 200
LAST_RATE = 0.001
SQUARE_DECAY = 0.99
"""Decay of the mean square of a gradient: what is followed changes while the particles come near it."""
FEW_ROWS = 20
"""Rows below which the domain alone tells where particles are held to the posterior."""
ROWS_FOR_NOISE = 40
"""Rows from which on what particles miss is counted at the data: fewer tell nothing of the places between them."""
LEAST_NOISE_SHARE = 0.5
"""Of the measurements' variance, what is left as noise at least where particles spread more than they should."""
FARTHEST_MISS = 3.0
"""In units of the noise, what particles miss of the data counts as at most: of a row that nothing else is like, as in
collisions, they can miss a hundred, and that says nothing of the noise elsewhere."""
LEAST_SLOPES = 1e-6
"""Of a trend's least squares: the share of the weight that holds slopes at zero where inputs never change."""
NEARBY = 0.5
"""How far from the data its neighbourhood reaches at most, in units of the inputs."""


@dataclass(frozen=True, slots=True)
class ParticleSettings:
    """How particles are led to a posterior.

    Attributes:
        particles: how many.
        hidden: widths of each particle's hidden layers.
        steps: of Adam.
        sets: measurement sets of a step.
        points: of a set; fewer than particles, for their covariance is to be matched.
        learning_rate: at the start; it falls to a thousandth along a half cosine.
        activation: of the particles' hidden units.
        seed: of everything that is drawn.
    """

    particles: int = 20
    hidden: tuple[int, ...] = (64, 64, 64)
    steps: int = 3000
    sets: int = 16
    points: int = 4
    learning_rate: float = 1.5e-2
    activation: Activation = "silu"
    seed: int = 0


def fit_particles(
    target: FunctionPosterior,
    points: Tensor,
    settings: ParticleSettings,
    progress: Callable[[int], None] = lambda step: None,
    start: Tensor | None = None,
) -> Posterior:
    """Lead particles to a posterior over functions.

    Args:
        target: the posterior.
        points: raw inputs of the domain (M, D), from which measurement sets are made.
        settings: how.
        progress: told the number of steps done, from time to time.
        start: parameters of earlier particles (L, P) to start from.

    Returns:
        The particles. Their noise is that of the measurements and what they miss of the target's mean: at the data, or
        where the target is sure if there is little.

    Raises:
        DataError: the particles diverged, or there are too few points.
    """
    if len(points) < settings.points:
        raise DataError(f"{len(points)} points of the domain make no measurement set of {settings.points}; give more.")
    device, normaliser = points.device, target.normaliser
    generator = torch.Generator().manual_seed(settings.seed)
    outputs = len(target.noise_std)
    network = Network(points.shape[1], outputs, settings.hidden, settings.activation)
    if start is None:
        start = network.initial(settings.particles, generator, device)
    numbers = start.to(points).clone()
    layers, adam = network.split(numbers), Adam(numbers, second=SQUARE_DECAY)
    count = len(points) // settings.points
    chosen = torch.randperm(len(points), generator=generator)[: count * settings.points].to(device)
    sets = points[chosen].view(count, settings.points, -1)
    mean, covariance = target.marginals(sets)
    factor, weight = _factors(covariance, target.noise_std)
    inputs = normaliser.inputs(sets)
    reach = reach_of(torch.cat([inputs.flatten(0, 1), target.inputs[:, : inputs.shape[2]].to(inputs)]))
    trend = _trend(inputs, mean, weight)
    wanted = mean - _linear(trend, inputs)
    order = torch.randint(count, (settings.steps, settings.sets), generator=generator).to(device)
    with torch.no_grad():
        for step, own in enumerate(order):
            values, pullback = network.through(layers, inputs[own].flatten(0, 1))
            shaped = values.view(len(numbers), settings.sets, settings.points, outputs)
            # One set and output a row: (L, sets * outputs, points).
            rows = shaped.transpose(2, 3).flatten(1, 2)
            way = moment_direction(rows, wanted[own].flatten(0, 1), factor[own].flatten(0, 1))
            way = (way * weight[own].flatten(0, 1)).view(len(numbers), settings.sets, outputs, settings.points)
            gradient = -pullback(way.transpose(2, 3).flatten(1, 2))
            share = 0.5 * (1.0 + math.cos(math.pi * step / settings.steps))
            adam.step(gradient, settings.learning_rate * (LAST_RATE + (1.0 - LAST_RATE) * share))
            if (step + 1) % TOLD_EVERY == 0:
                progress(step + 1)
        if not bool(torch.isfinite(numbers).all()):
            raise DivergedError("The fit diverged; fit again with a smaller learning rate.")
        most = math.inf
        if len(target.inputs) >= ROWS_FOR_NOISE:
            sets = target.data[:, None]
            mean, covariance = target.marginals(sets)
            weight, most = torch.ones_like(mean), FARTHEST_MISS
            inputs = normaliser.inputs(sets)
        found = network(numbers, inputs.flatten(0, 1)).view(-1, *sets.shape[:2], outputs).transpose(2, 3)
        variance = covariance.diagonal(dim1=2, dim2=3).to(found)
        noise = _noise(found + _linear(trend, inputs), mean, variance, weight, target.noise_std, most)
    return Posterior(network, numbers, noise, normaliser, target.freedom, trend, target.correlation, reach)


def measurement_points(
    model: DomainModel | None,
    inputs: Tensor,
    normaliser: Normaliser,
    generator: torch.Generator,
    count: int = 8192,
    others: Tensor | None = None,
) -> Tensor:
    """Inputs (count, D) at which particles are held to a posterior.

    Half are rows of data moved a little, as far as there is data; the rest is the simulator's domain, or ``others``
    (M, D) where there is no simulator.

    Args:
        model: the simulator.
        inputs: raw inputs of the data (n, D).
        normaliser: its units.
        generator: of the draws.
        count: how many.
        others: raw inputs of the domain.

    Raises:
        DataError: there is neither data nor a domain.
    """
    if model is None and others is None and not len(inputs):
        raise DataError("There is neither data nor a domain to learn in; name a car file as the prior.")
    alone = model is None and others is None
    near = count if alone else count // 2 if len(inputs) >= FEW_ROWS else 0
    found = []
    if near:
        rows = inputs[torch.randint(len(inputs), (near,), generator=generator).to(inputs.device)]
        away = NEARBY * torch.rand((near, 1), generator=generator) * torch.randn(rows.shape, generator=generator)
        found.append(rows + away.to(rows) * normaliser.input_std)
    if model is not None:
        found.append(model.inputs(count - near, generator).to(inputs))
    elif others is not None:
        found.append(others[torch.randint(len(others), (count - near,), generator=generator).to(others.device)])
    return torch.cat(found)


def _noise(values: Tensor, mean: Tensor, variance: Tensor, weight: Tensor, noise_std: Tensor, most: float) -> Tensor:
    """Noise (O,) of particles with values (L, B, O, N), of a target's noise and what they miss of its marginals.

    The mean square of a particle's error is that of their mean and their spread; the target's variance is allowed. What
    they miss in one place counts as ``most`` noises at most.
    """
    off = values - mean
    missed = 2.0 * off.mean(dim=0) ** 2 - (off**2).mean(dim=0) + variance
    missed = torch.minimum(missed, (most * noise_std)[:, None] ** 2)
    beyond = (weight * missed).sum(dim=(0, 2)) / weight.sum(dim=(0, 2))
    return (noise_std**2 + beyond).clamp_min(LEAST_NOISE_SHARE * noise_std**2).sqrt()


def _trend(inputs: Tensor, mean: Tensor, weight: Tensor) -> Tensor:
    """Constant and slopes (1 + D, O) of the weighted least squares line through means (B, O, N) at inputs (B, N, D).

    Networks are left with what is not linear: a step is the velocity's to a few thousandths of its size.
    """
    one = torch.ones_like(inputs[..., :1])
    given = torch.cat([one, inputs], dim=2).flatten(0, 1).double()
    wanted, weight = (v.transpose(1, 2).flatten(0, 1).double().T for v in (mean, weight))
    squares = torch.einsum("on,nd,ne->ode", weight, given, given)
    squares = squares + LEAST_SLOPES * weight.sum(dim=1)[:, None, None] * torch.eye(given.shape[1]).to(given)
    found: Tensor = torch.linalg.solve(squares, torch.einsum("on,nd,on->od", weight, given, wanted))
    return found.T.to(mean)


def _linear(trend: Tensor, inputs: Tensor) -> Tensor:
    """Values (B, O, N) of a trend (1 + D, O) at inputs (B, N, D)."""
    return (trend[0] + inputs @ trend[1:]).transpose(1, 2)


def _factors(covariance: Tensor, noise_std: Tensor) -> tuple[Tensor, Tensor]:
    """Cholesky factors (B, O, N, N) of measurement sets, and weights (B, O, N) of errors there.

    An error counts by what it adds to the surprise at a measurement: in units of the noise and the function's doubt.
    """
    eye = torch.eye(covariance.shape[-1], dtype=torch.float64, device=covariance.device)
    factor = torch.linalg.cholesky(covariance + JITTER * eye)
    variance = covariance.diagonal(dim1=2, dim2=3).clamp_min(0.0) + noise_std[:, None] ** 2
    weight = 1.0 / variance
    return factor.to(noise_std), (weight / weight.mean()).to(noise_std)


__all__ = ["ParticleSettings", "fit_particles", "measurement_points"]
