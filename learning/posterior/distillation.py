"""Distillation of a posterior over functions into particles of a network: ``gp-sim-posterior``.

This method is carlab's, not the algorithm of Rothfuss et al. (arXiv 2403.16644); theirs is
``learning.functional_svgd.fsvgd`` with a ``SimulatorPrior``. Here the posterior's moments are in closed form
(``function_posterior``: a Gaussian process around a simulator whose parameters are drawn by sequential Monte Carlo).
Particles are moved until they have these moments at many small measurement sets: Stein's direction with a linear kernel
(``learning.stein.moment_direction``; Liu and Wang 2018, "Stein Variational Gradient Descent as Moment Matching"),
pulled back to the networks' parameters as in algorithm 1 of the paper.

A particle is a network that replaces the simulator, or the simulator with a draw of its parameters and a network that
corrects its steps. Such a network has the moments of the model discrepancy given its draw.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from carlab.core.errors import DataError, DivergedError
from learning.devices import CapturedFunction, can_capture
from learning.networks.adam import Adam, half_cosine
from learning.networks.normaliser import Normaliser
from learning.networks.particles import Activation, Network
from learning.posterior.function_posterior import JITTER, FunctionPosterior
from learning.posterior.particle_posterior import ParticlePosterior, ParticleSimulator, input_clip_of
from learning.priors.domain_models import DomainModel
from learning.priors.simulator_model import CarModel
from learning.stein import moment_direction

PROGRESS_PERIOD_STEPS = 200
FINAL_RATE_SHARE = 0.001
"""Share of the learning rate at the end of its half cosine."""
SQUARE_DECAY = 0.99
"""Adam's decay of the mean square of a gradient."""
MAX_DOMAIN_POINTS = 8192
"""Number of measurement points of a fit; 48 000 change no likelihood (docs/decisions/0010-distilled-posterior.md)."""
MIN_DOMAIN_POINTS = 1024
"""Minimum number of measurement points, for the linear trend and the units of the inputs."""
MIN_ROWS_FOR_NEIGHBOURS = 20
"""Minimum number of rows for half of the measurement points to be neighbours of rows."""
MIN_ROWS_FOR_NOISE = 40
"""Minimum number of rows for the particles' misfit to be measured at the rows instead of the measurement points."""
MIN_NOISE_SHARE = 0.5
"""Lower bound of the variance of the particles' noise, relative to that of the measurement noise."""
MAX_MISFIT_STD = 3.0
"""Upper bound of the misfit at a single row, in standard deviations of the noise."""
SLOPE_PENALTY_SHARE = 1e-6
"""Ridge penalty of the linear trend, as a share of the total weight."""
MAX_NEIGHBOUR_DISTANCE = 0.5
"""Maximum standard deviation of a neighbour's distance from its row, in units of the inputs."""


@dataclass(frozen=True, slots=True)
class DistillationSettings:
    """How particles are fitted to a posterior.

    Attributes:
        particles: L, their number.
        hidden: widths of each particle's hidden layers.
        steps: of Adam.
        sets: measurement sets of a step.
        points: of a set; fewer than particles, because L particles have a covariance of rank L - 1.
        learning_rate: initial rate; it falls to ``FINAL_RATE_SHARE`` of it along a half cosine.
        activation: of the hidden units.
        seed: of all draws.
        correct_simulator: whether a particle is the simulator with a draw of its parameters, corrected by a network.
    """

    particles: int = 20
    hidden: tuple[int, ...] = (64, 64, 64)
    steps: int = 3000
    sets: int = 16
    points: int = 4
    learning_rate: float = 1.5e-2
    activation: Activation = "silu"
    seed: int = 0
    correct_simulator: bool = False

    @property
    def domain_points(self) -> int:
        """Number of measurement points to draw: as many as the steps use, within the limits."""
        return min(max(self.steps * self.sets * self.points, MIN_DOMAIN_POINTS), MAX_DOMAIN_POINTS)


@dataclass(frozen=True, slots=True)
class _Targets:
    """Moments at B measurement sets of N points.

    Attributes:
        inputs: normalised (B, N, D).
        mean: without the trend (B, O, N).
        cholesky: factors of the covariances (B, O, N, N).
        weight: of an error at each point (B, O, N).
        trend: constant and slopes (1 + D, O).
        deviation: of each particle's own mean from the mean (L, B, O, N); None: zero.
    """

    inputs: Tensor
    mean: Tensor
    cholesky: Tensor
    weight: Tensor
    trend: Tensor
    deviation: Tensor | None = None


def distil(
    target: FunctionPosterior,
    points: Tensor,
    settings: DistillationSettings,
    progress: Callable[[int], None] = lambda step: None,
    start: Tensor | None = None,
) -> ParticlePosterior:
    """Fit particles to the moments of a posterior over functions.

    Args:
        target: the posterior.
        points: raw inputs of the domain (M, D), which are split into measurement sets.
        settings: of the fit.
        progress: called with the number of steps done, every ``PROGRESS_PERIOD_STEPS``.
        start: initial parameters (L, P), of earlier particles.

    Returns:
        The particles. Their noise includes the measurement noise and the particles' misfit to the target's mean.

    Raises:
        DataError: fewer points than a measurement set needs.
        DivergedError: the particles diverged.
    """
    if len(points) < settings.points:
        raise DataError(f"A measurement set needs {settings.points} points of the domain, not {len(points)}; add some.")
    normaliser = target.normaliser
    generator = torch.Generator().manual_seed(settings.seed)
    network = Network(points.shape[1], len(target.noise_std), settings.hidden, settings.activation)
    if start is None:
        start = network.initial(settings.particles, generator, points.device)
    parameters = start.to(points).clone()
    count = len(points) // settings.points
    chosen = torch.randperm(len(points), generator=generator)[: count * settings.points].to(points.device)
    sets = points[chosen].view(count, settings.points, -1)
    draws = _draws(target, len(parameters), generator) if settings.correct_simulator else None
    targets = _targets(target, sets, draws)
    row_inputs = target.inputs[:, : points.shape[1]].to(targets.inputs)
    input_clip = input_clip_of(torch.cat([targets.inputs.flatten(0, 1), row_inputs]))
    with torch.no_grad():
        _train(network, parameters, targets, settings, generator, progress)
    if not bool(torch.isfinite(parameters).all()):
        raise DivergedError("The fit diverged; fit again with a smaller learning rate.")
    particles = ParticlePosterior(
        network, parameters, target.noise_std, normaliser, target.dof, targets.trend, target.correlation, input_clip,
        None if draws is None else _simulator(target, draws),
    )  # fmt: skip
    return replace(particles, noise_std=_particle_noise(target, particles, sets, targets.weight))


def _draws(target: FunctionPosterior, particles: int, generator: torch.Generator) -> Tensor:
    """Indices (L,) of the particles' draws of the parameters; they repeat if the posterior has fewer.

    Raises:
        ValueError: the posterior has no simulator.
    """
    if target.model is None or target.parameters is None:
        raise ValueError("the posterior has no simulator to correct")
    order = torch.randperm(len(target.parameters), generator=generator)
    return order[torch.arange(particles) % len(order)].to(target.parameters.device)


def _simulator(target: FunctionPosterior, draws: Tensor) -> ParticleSimulator:
    """The posterior's simulator with draws (L,)."""
    assert isinstance(target.model, CarModel)
    assert target.parameters is not None
    return ParticleSimulator(target.model, target.parameters[draws])


def _targets(target: FunctionPosterior, sets: Tensor, draws: Tensor | None) -> _Targets:
    """Moments of the posterior at sets (B, N, D), or of the discrepancy given draws (L,) of the parameters."""
    inputs = target.normaliser.inputs(sets)
    means: Tensor | None = None
    if draws is None:
        mean, covariance = target.marginals(sets)
    else:
        means, covariance = target.discrepancy_marginals(sets, draws)
        mean = means.mean(dim=0)
    cholesky, weight = _factors(covariance, target.noise_std)
    trend = _trend(inputs, mean, weight)
    deviation = None if means is None else means - mean
    return _Targets(inputs, mean - _linear(trend, inputs), cholesky, weight, trend, deviation)


def _particle_noise(target: FunctionPosterior, particles: ParticlePosterior, sets: Tensor, weight: Tensor) -> Tensor:
    """Noise (O,) of particles, from their misfit at the rows, or with few rows at measurement sets (B, N, D)."""
    max_misfit = math.inf
    if len(target.inputs) >= MIN_ROWS_FOR_NOISE:
        sets, max_misfit = target.data[:, None], MAX_MISFIT_STD
    mean, covariance = target.marginals(sets)
    weight = torch.ones_like(mean) if len(target.inputs) >= MIN_ROWS_FOR_NOISE else weight
    with torch.no_grad():
        values = particles.values(particles.normaliser.inputs(sets).flatten(0, 1))
    values = values.view(-1, *sets.shape[:2], mean.shape[1]).transpose(2, 3)
    variance = covariance.diagonal(dim1=2, dim2=3).to(values)
    return _noise(values, mean, variance, weight, target.noise_std, max_misfit)


def _train(
    network: Network,
    parameters: Tensor,
    targets: _Targets,
    settings: DistillationSettings,
    generator: torch.Generator,
    progress: Callable[[int], None],
) -> None:
    """Move parameters (L, P) in place along the pulled-back moment direction."""
    particles, outputs = len(parameters), targets.mean.shape[1]
    layers, adam = network.split(parameters), Adam(parameters, second=SQUARE_DECAY)
    order = torch.randint(len(targets.inputs), (settings.steps, settings.sets), generator=generator)

    def train_step(sets: Tensor, rate: float | Tensor) -> dict[str, Tensor]:
        values, pullback = network.through(layers, targets.inputs[sets].flatten(0, 1))
        by_set = values.view(particles, settings.sets, settings.points, outputs)
        # Rows are pairs of set and output: (L, sets * outputs, points).
        rows = by_set.transpose(2, 3)
        if targets.deviation is not None:
            rows = rows - targets.deviation[:, sets]
        rows = rows.flatten(1, 2)
        direction = moment_direction(rows, targets.mean[sets].flatten(0, 1), targets.cholesky[sets].flatten(0, 1))
        direction = direction * targets.weight[sets].flatten(0, 1)
        direction = direction.view(particles, settings.sets, outputs, settings.points)
        adam.step(-pullback(direction.transpose(2, 3).flatten(1, 2)), rate)
        return {}

    rates = [settings.learning_rate * half_cosine(k, settings.steps, FINAL_RATE_SHARE) for k in range(settings.steps)]
    replayed = CapturedFunction(train_step) if can_capture(parameters.device) else None
    device_rates = torch.tensor(rates).to(parameters.device)
    for step, sets in enumerate(order.to(parameters.device)):
        if replayed is None:
            train_step(sets, rates[step])
        else:
            replayed(sets, device_rates[step])
        if (step + 1) % PROGRESS_PERIOD_STEPS == 0:
            progress(step + 1)


def measurement_points(
    model: DomainModel, inputs: Tensor, normaliser: Normaliser, generator: torch.Generator, count: int
) -> Tensor:
    """Raw inputs (count, D) at which particles are fitted to a posterior.

    From ``MIN_ROWS_FOR_NEIGHBOURS`` rows on, half are neighbours of rows; the others are drawn from the simulator's
    domain.

    Args:
        model: the simulator; a posterior without a simulator has only its domain.
        inputs: raw inputs of the rows (n, D).
        normaliser: its units.
        generator: of the draws.
        count: number of inputs.
    """
    if len(inputs) < MIN_ROWS_FOR_NEIGHBOURS:
        return model.inputs(count, generator).to(inputs)
    rows = inputs[torch.randint(len(inputs), (count // 2,), generator=generator).to(inputs.device)]
    distance = MAX_NEIGHBOUR_DISTANCE * torch.rand((len(rows), 1), generator=generator)
    offset = distance * torch.randn(rows.shape, generator=generator)
    neighbours = rows + offset.to(rows) * normaliser.input_std
    return torch.cat([neighbours, model.inputs(count - len(rows), generator).to(inputs)])


def _noise(
    values: Tensor, mean: Tensor, variance: Tensor, weight: Tensor, noise_std: Tensor, max_misfit: float
) -> Tensor:
    """Noise (O,) of particles: that of the target, and the squared misfit in excess of its variance.

    The expected squared error of a particle is that of the particles' mean plus their variance.

    Args:
        values: of the particles (L, B, O, N).
        mean: of the target (B, O, N).
        variance: of the target (B, O, N).
        weight: of each point (B, O, N).
        noise_std: of the target (O,).
        max_misfit: bound of the misfit at a point, in ``noise_std``.
    """
    error = values - mean
    misfit_sq = 2.0 * error.mean(dim=0) ** 2 - (error**2).mean(dim=0) + variance
    misfit_sq = torch.minimum(misfit_sq, (max_misfit * noise_std)[:, None] ** 2)
    excess = (weight * misfit_sq).sum(dim=(0, 2)) / weight.sum(dim=(0, 2))
    return (noise_std**2 + excess).clamp_min(MIN_NOISE_SHARE * noise_std**2).sqrt()


def _trend(inputs: Tensor, mean: Tensor, weight: Tensor) -> Tensor:
    """Constant and slopes (1 + D, O) of the weighted linear regression of means (B, O, N) on inputs (B, N, D)."""
    one = torch.ones_like(inputs[..., :1])
    design = torch.cat([one, inputs], dim=2).flatten(0, 1).double()
    means, weight = (v.transpose(1, 2).flatten(0, 1).double().T for v in (mean, weight))
    squares = torch.einsum("on,nd,ne->ode", weight, design, design)
    squares = squares + SLOPE_PENALTY_SHARE * weight.sum(dim=1)[:, None, None] * torch.eye(design.shape[1]).to(design)
    coefficients: Tensor = torch.linalg.solve(squares, torch.einsum("on,nd,on->od", weight, design, means))
    return coefficients.T.to(mean)


def _linear(trend: Tensor, inputs: Tensor) -> Tensor:
    """Values (B, O, N) of a trend (1 + D, O) at inputs (B, N, D)."""
    return (trend[0] + inputs @ trend[1:]).transpose(1, 2)


def _factors(covariance: Tensor, noise_std: Tensor) -> tuple[Tensor, Tensor]:
    """Cholesky factors (B, O, N, N) of covariances, and weights (B, O, N) of errors: inverse predictive variances."""
    eye = torch.eye(covariance.shape[-1], dtype=torch.float64, device=covariance.device)
    cholesky = torch.linalg.cholesky(covariance + JITTER * eye)
    variance = covariance.diagonal(dim1=2, dim2=3).clamp_min(0.0) + noise_std[:, None] ** 2
    weight = 1.0 / variance
    return cholesky.to(noise_std), (weight / weight.mean()).to(noise_std)
