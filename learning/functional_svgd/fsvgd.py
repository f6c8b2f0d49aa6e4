"""Functional SVGD as published: FSVGD, and the paper's Sim-FSVGD where the prior is a ``SimulatorPrior``.

Algorithm 1 of Rothfuss et al. (arXiv 2403.16644); the update in function space is that of Wang et al. 2019 ("Function
Space Particle Optimization for Bayesian Neural Networks"). Each step draws a measurement set (a minibatch of the data
and points of the domain), adds the score of the likelihood to that of the prior's Gaussian marginal at the set, and
moves the particles along Stein's direction, pulled back to their parameters.

Departures from the authors' code: draws of the simulator are taken once, for the data and for a pool of domain points,
from which measurement sets are drawn; ``FsvgdSettings.natural`` preconditions the direction. The authors' code divides
only the repulsive term by the number of particles (``FsvgdSettings.repulsion``). carlab's own method
(``gp-sim-posterior``) is another one: ``learning.posterior.distillation``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Protocol

import torch
from torch import Tensor

from carlab.core.errors import DataError, DivergedError
from learning.evaluation import negative_log_likelihood
from learning.networks.adam import half_cosine
from learning.networks.normaliser import Normaliser
from learning.networks.particles import Network
from learning.posterior.particle_posterior import ParticlePosterior, input_clip_of
from learning.priors.function_prior import JITTER, Marginal, RbfCovariance, gaussian_process, simulator_marginal
from learning.stein import RbfKernel, median_bandwidth, natural_direction, stein_direction

PROGRESS_PERIOD_STEPS = 500
FINAL_RATE_SHARE = 0.01
MIN_NOISE = 1e-4
"""Lower bound of the likelihood's standard deviation, in normalised units."""


class FunctionMarginal(Protocol):
    """A distribution of function values at N points."""

    def score(self, values: Tensor) -> Tensor:
        """Gradient of the log density by values (L, N, O)."""
        ...

    def precision(self) -> Tensor:
        """Inverse of the covariance of each output (O, N, N)."""
        ...


class FunctionPrior(Protocol):
    """A prior over functions as marginals on a pool of inputs, in normalised units."""

    def marginal(self, chosen: Tensor) -> FunctionMarginal:
        """Distribution at the pool's inputs with indices ``chosen`` (N,)."""
        ...


@dataclass(frozen=True, slots=True)
class GaussianProcessPrior:
    """The prior of FSVGD: a zero-mean Gaussian process on normalised inputs (M, D)."""

    inputs: Tensor
    covariance: RbfCovariance
    jitter: float = 1e-3

    def marginal(self, chosen: Tensor) -> Marginal:
        """Gaussian at the inputs with indices ``chosen`` (N,)."""
        return gaussian_process(self.inputs[chosen], self.covariance, self.jitter)


@dataclass(frozen=True, slots=True)
class SimulatorPrior:
    """The paper's prior of Sim-FSVGD: a domain-model process and a Gaussian process for the model discrepancy.

    Rothfuss et al. (arXiv 2403.16644), sections 4.1 and 4.2.

    Attributes:
        draws: normalised outputs of P simulators at all inputs of the pool (P, M, O).
        discrepancy_inputs: inputs of the discrepancy's covariance at the pool (M, G).
        discrepancy: its covariance in normalised outputs; None for a simulator that is taken as exact.
        jitter: variance added to each value.
    """

    draws: Tensor
    discrepancy_inputs: Tensor
    discrepancy: RbfCovariance | None = None
    jitter: float = JITTER

    def marginal(self, chosen: Tensor) -> Marginal:
        """Gaussian with the moments of the draws at the inputs with indices ``chosen`` (N,)."""
        return simulator_marginal(self.draws[:, chosen], self.discrepancy_inputs[chosen], self.discrepancy, self.jitter)


@dataclass(frozen=True, slots=True)
class FsvgdSettings:
    """How particles are fitted.

    Attributes:
        particles: L, their number.
        hidden: widths of each particle's hidden layers.
        steps: of the optimiser.
        batch: rows of data in a measurement set, at most all of them.
        measurement_points: points of the domain in a measurement set.
        bandwidth: of the kernel; None: the median heuristic at each step.
        interacting: whether particles interact; if not, they are an ensemble of maximum a posteriori estimates.
        repulsion: weight of the repulsive term relative to Stein's direction; the authors' code has 1 / L.
        natural: precondition by the posterior's covariance on the measurement set (a matrix-valued kernel). False is
            the update of the paper.
        learning_rate: initial rate of Adam; it falls to a hundredth along a half cosine.
        weight_decay: of AdamW, on the networks alone.
        noise_std: initial standard deviation of the likelihood, normalised; a number, or one for each output.
        fit_noise: whether the noise is fitted.
        noise_rows: weight of ``noise_std`` in rows if the noise is fitted (inverse-gamma prior).
        noise_rate: learning rate of the noise relative to that of the networks.
        likelihood_exponent: power of the likelihood.
        prior_exponent: power of the prior.
        anneal_rate: whether the learning rate falls.
        validation_period: steps between evaluations on held-out rows, if given; the best networks are kept.
        patience: evaluations without improvement after which the fit ends; 0 disables early stopping.
        seed: of all draws.
    """

    particles: int = 20
    hidden: tuple[int, ...] = (64, 64, 64)
    steps: int = 5000
    batch: int = 32
    measurement_points: int = 16
    bandwidth: float | None = None
    interacting: bool = True
    repulsion: float = 1.0
    natural: bool = True
    learning_rate: float = 1e-3
    weight_decay: float = 1e-3
    noise_std: float | tuple[float, ...] = 0.1
    fit_noise: bool = True
    noise_rows: float = 0.0
    noise_rate: float = 5.0
    likelihood_exponent: float = 1.0
    prior_exponent: float = 1.0
    anneal_rate: bool = True
    validation_period: int = 2000
    patience: int = 0
    seed: int = 0

    def with_published_errors(self, rows: int, *, with_simulator: bool) -> FsvgdSettings:
        """Copy with the errors of the authors' code (lasgroup/simulation_transfer at 547fa14).

        Only the driving term is summed over the particles, so repulsion is weaker by 1 / L. Without a simulator, the
        prior's score is averaged over particles and measurement points, whereas the likelihood is summed.

        Args:
            rows: number of rows of the data.
            with_simulator: whether the prior has a simulator.
        """
        points = min(self.batch, rows) + self.measurement_points
        prior = self.prior_exponent if with_simulator else 1.0 / (self.particles * points)
        return replace(self, repulsion=1.0 / self.particles, prior_exponent=prior)


def check_rows(inputs: Tensor, outputs: Tensor, *others: Tensor) -> None:
    """Check rows of inputs (n, D) and outputs (n, O), and further inputs (M, D).

    Raises:
        DataError: rows of inputs and outputs differ in number, or numbers are missing or infinite.
    """
    if len(outputs) != len(inputs):
        raise DataError(f"There are {len(inputs)} rows of inputs and {len(outputs)} of outputs; each row needs both.")
    if not all(bool(torch.isfinite(given).all()) for given in (inputs, outputs, *others)):
        raise DataError("The data holds numbers that are missing or infinite; leave those rows out and fit again.")


@dataclass
class _Optimiser:
    """Networks and the logarithm of the noise as parameters of AdamW."""

    networks: Tensor
    log_noise: Tensor
    settings: FsvgdSettings
    prior_noise: Tensor = field(init=False)
    adam: torch.optim.Optimizer = field(init=False)

    def __post_init__(self) -> None:
        settings = self.settings
        self.prior_noise = self.log_noise.exp()
        groups = [{"params": [self.networks], "weight_decay": settings.weight_decay}]
        if settings.fit_noise:
            groups.append({"params": [self.log_noise], "weight_decay": 0.0, "rate_factor": settings.noise_rate})
        self.adam = torch.optim.AdamW(groups, lr=settings.learning_rate, fused=True)

    def set_rate(self, step: int) -> None:
        """Set the learning rate of a step."""
        rate = self.settings.learning_rate
        if self.settings.anneal_rate:
            rate *= half_cosine(step, self.settings.steps, FINAL_RATE_SHARE)
        for group in self.adam.param_groups:
            group["lr"] = rate * group.get("rate_factor", 1.0)

    def posterior(self, network: Network, normaliser: Normaliser, input_clip: Tensor) -> ParticlePosterior:
        """A copy of the current particles."""
        noise = self.log_noise.exp().clamp_min(MIN_NOISE)
        return ParticlePosterior(network, self.networks.detach().clone(), noise, normaliser, input_clip=input_clip)


@dataclass(frozen=True)
class _Problem:
    """Normalised inputs of data and pool (n + M, D), normalised outputs of the data (n, O), prior and settings.

    Attributes:
        row_mask: whether each particle is fitted to each row (L, n); None: to all.
    """

    network: Network
    inputs: Tensor
    targets: Tensor
    prior: FunctionPrior | None
    settings: FsvgdSettings
    row_mask: Tensor | None


def fit_fsvgd(
    inputs: Tensor,
    outputs: Tensor,
    pool: Tensor,
    prior: FunctionPrior | None,
    normaliser: Normaliser,
    settings: FsvgdSettings,
    progress: Callable[[int], None] = lambda step: None,
    held_out: tuple[Tensor, Tensor] | None = None,
    row_mask: Tensor | None = None,
) -> ParticlePosterior:
    """Fit particles to data and prior by functional SVGD.

    Args:
        inputs: raw inputs of the data (n, D); if empty, the prior alone is fitted.
        outputs: raw outputs (n, O).
        pool: raw inputs of the domain (M, D).
        prior: over functions; its pool is the data's inputs followed by ``pool``. May be None if there is data.
        normaliser: of inputs and outputs.
        settings: of the fit.
        progress: called with the number of steps done, every ``PROGRESS_PERIOD_STEPS``.
        held_out: raw inputs (v, D) and outputs (v, O); the particles with the lowest loss on these rows are kept.
        row_mask: whether each particle is fitted to each row (L, n), for particles that do not interact; None: to all.

    Raises:
        DataError: neither data nor prior, inputs and outputs of different length, or missing or infinite numbers.
        DivergedError: the particles diverged.
    """
    count = len(inputs)
    if count == 0 and prior is None:
        raise DataError("There is neither data nor a prior to fit; record an episode, or name a car file as the prior.")
    check_rows(inputs, outputs, pool)
    device = pool.device
    generator = torch.Generator().manual_seed(settings.seed)
    width = len(normaliser.output_mean)
    network = Network(pool.shape[1], width, settings.hidden)
    all_inputs = normaliser.inputs(torch.cat([inputs, pool]))
    input_clip = input_clip_of(all_inputs)
    problem = _Problem(network, all_inputs, normaliser.outputs(outputs), prior, settings, row_mask)
    noise = torch.as_tensor(settings.noise_std, dtype=all_inputs.dtype).expand(width).to(device)
    networks = network.initial(settings.particles, generator, device).to(all_inputs.dtype)
    optimiser = _Optimiser(networks, noise.clamp_min(MIN_NOISE).log(), settings)
    points = settings.measurement_points if prior is not None or count == 0 else 0
    best = _EarlyStopping(settings.patience)
    for step in range(settings.steps):
        optimiser.set_rate(step)
        rows = _minibatch(count, settings.batch, generator)
        domain = count + torch.randint(len(pool), (points,), generator=generator)
        _step(problem, optimiser, rows.to(device), domain.to(device))
        if (step + 1) % PROGRESS_PERIOD_STEPS == 0:
            progress(step + 1)
        if held_out is not None and (step + 1) % settings.validation_period == 0:
            best.evaluate(optimiser.posterior(network, normaliser, input_clip), *held_out)
            if best.exhausted:
                break
    posterior = optimiser.posterior(network, normaliser, input_clip) if best.posterior is None else best.posterior
    if not torch.isfinite(posterior.parameters).all():
        raise DivergedError("The fit diverged; fit again with a smaller learning rate.")
    return posterior


@dataclass
class _EarlyStopping:
    """The particles of the lowest negative log-likelihood on held-out rows."""

    patience: int
    posterior: ParticlePosterior | None = None
    nll: float = math.inf
    n_without_gain: int = 0

    def evaluate(self, posterior: ParticlePosterior, inputs: Tensor, outputs: Tensor) -> None:
        nll = negative_log_likelihood(posterior.predict(inputs), outputs)
        self.n_without_gain += 1
        if nll < self.nll:
            self.posterior, self.nll, self.n_without_gain = posterior, nll, 0

    @property
    def exhausted(self) -> bool:
        return 0 < self.patience <= self.n_without_gain


def _minibatch(count: int, batch: int, generator: torch.Generator) -> Tensor:
    if count <= batch:
        return torch.arange(count)
    return torch.randint(count, (batch,), generator=generator)


def _step(problem: _Problem, optimiser: _Optimiser, rows: Tensor, domain: Tensor) -> None:
    """One step of the optimiser at the measurement set of data ``rows`` and ``domain`` points (indices of inputs)."""
    settings = problem.settings
    chosen = torch.cat([rows, domain])
    values, pullback = problem.network.values_and_pullback(optimiser.networks, problem.inputs[chosen])
    marginal = None if problem.prior is None else problem.prior.marginal(chosen)
    score = torch.zeros_like(values) if marginal is None else settings.prior_exponent * marginal.score(values)
    precision = torch.zeros(values.shape[2], values.shape[1], dtype=values.dtype, device=values.device)
    if len(rows):
        _add_likelihood(problem, optimiser, rows, values, score, precision)
    if not settings.interacting:
        direction = score
    else:
        kernel = RbfKernel(settings.bandwidth or median_bandwidth(values.flatten(1)))
        if settings.natural:
            likelihood = torch.diag_embed(precision)
            total = likelihood if marginal is None else likelihood + marginal.precision()
            direction = natural_direction(values, score, total, kernel)
        else:
            direction = stein_direction(values, score, kernel, settings.repulsion)
    optimiser.networks.grad = -pullback(direction)
    optimiser.adam.step()


def _add_likelihood(
    problem: _Problem, optimiser: _Optimiser, rows: Tensor, values: Tensor, score: Tensor, precision: Tensor
) -> None:
    """Add the likelihood of rows (m,) to scores (L, N, O) and precisions (O, N) in place; set the noise gradient.

    The gradient with respect to the logarithm of the noise is that of the particles' mean negative log-likelihood and
    of the prior.
    """
    settings, count = problem.settings, len(rows)
    noise = optimiser.log_noise.exp().clamp_min(MIN_NOISE)
    residual, rows_used = problem.targets[rows] - values[:, :count], float(count)
    if problem.row_mask is not None:
        mask = problem.row_mask[:, rows].to(residual)
        residual, rows_used = residual * mask[..., None], float(mask.sum()) / len(residual)
    weight = settings.likelihood_exponent * len(problem.targets) / count
    score[:, :count] += weight * residual / noise**2
    precision[:, :count] = weight / noise[:, None] ** 2
    if settings.fit_noise:
        square = (residual * residual).mean(dim=0).sum(dim=0) / noise**2
        prior = settings.noise_rows * (1.0 - (optimiser.prior_noise / noise) ** 2)
        optimiser.log_noise.grad = weight * (rows_used - square) + prior
