"""Fitting particles of a network to data and to a prior over functions: (Sim-)FSVGD.

Each step draws a measurement set (a minibatch of the data and points of the domain), adds the score of the likelihood
to that of the prior's Gaussian marginals there, and moves the particles along Stein's direction, pulled back to their
parameters (Rothfuss et al., arXiv 2403.16644, algorithm 1; Wang et al. 2019 for the update in function space).

What differs from the authors' code, on purpose: driving and repulsive term are both averaged over the particles; draws
of the simulator are taken once, for the data and for a pool of domain points, from which measurement sets are drawn.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import torch
from torch import Tensor

from carlab.core.errors import DataError, DivergedError
from learning.evaluation import Mixture, negative_log_likelihood
from learning.function_prior import JITTER, Marginal, RbfCovariance, gaussian_process, simulator_marginal
from learning.normaliser import Normaliser
from learning.outliers import tail_scales
from learning.particles import Network
from learning.stein import RbfKernel, median_bandwidth, natural_direction, stein_direction

CHECKED_EVERY = 500
EDGE = 6.0
"""How far out in their units inputs count at least; what lies farther than anything that was learned from is taken to
lie at that edge, for a network's straight lines grow without bound when it is driven by what it said before."""
LEAST_NOISE = 1e-4
"""Floor of the likelihood's standard deviation, in normalised units."""


class FunctionPrior(Protocol):
    """A prior over functions on a pool of inputs, in normalised units."""

    def marginal(self, chosen: Tensor) -> Marginal:
        """Gaussian at the pool's inputs with indices ``chosen`` (N,)."""
        ...


@dataclass(frozen=True, slots=True)
class GaussianProcessPrior:
    """A zero-mean Gaussian process on normalised inputs (M, D)."""

    inputs: Tensor
    covariance: RbfCovariance
    jitter: float = 1e-3

    def marginal(self, chosen: Tensor) -> Marginal:
        """Gaussian at some of the inputs."""
        return gaussian_process(self.inputs[chosen], self.covariance, self.jitter)


@dataclass(frozen=True, slots=True)
class SimulatorPrior:
    """Draws of a simulator and the covariance of what it leaves out.

    Attributes:
        draws: normalised outputs of P simulators at all inputs of the pool (P, M, O).
        gap_inputs: the pool as the gap's covariance sees it (M, G).
        gap: its covariance in normalised outputs; none where the simulator is trusted.
    """

    draws: Tensor
    gap_inputs: Tensor
    gap: RbfCovariance | None = None
    jitter: float = JITTER

    def marginal(self, chosen: Tensor) -> Marginal:
        """Gaussian with the moments of the draws at some of the inputs."""
        return simulator_marginal(self.draws[:, chosen], self.gap_inputs[chosen], self.gap, self.jitter)


@dataclass(frozen=True, slots=True)
class FsvgdSettings:
    """How particles are fitted.

    Attributes:
        particles: how many.
        hidden: widths of each particle's hidden layers.
        steps: of the optimiser.
        batch: rows of data in a measurement set; all of them where there are fewer.
        measurement_points: points of the domain in a measurement set.
        bandwidth: of the kernel; by the median heuristic at each step if None.
        together: whether particles feel each other; without it each finds a most probable function, an ensemble.
        natural: precondition by the posterior's covariance on the measurement set (a matrix-valued kernel). False is
            the update of the paper.
        learning_rate: of Adam at the start; it falls to a hundredth along a half cosine.
        weight_decay: of AdamW, on the networks alone.
        noise_std: standard deviation of the likelihood at the start, normalised, one or one for each output.
        learn_noise: whether it is fitted too.
        noise_rows: rows of data that ``noise_std`` counts for then (an inverse-gamma prior): a handful of rows that a
            network meets exactly says nothing of their noise.
        noise_rate: learning rate of the noise over that of the networks.
        likelihood_exponent: power of the likelihood.
        prior_exponent: power of the prior.
        falling_rate: whether the learning rate falls; it stays without.
        checked_every: steps between looks at rows that are held out, where there are any; the best networks are kept.
        patience: looks without a better one after which the fit ends; 0: never.
        seed: of everything that is drawn.
    """

    particles: int = 20
    hidden: tuple[int, ...] = (64, 64, 64)
    steps: int = 5000
    batch: int = 32
    measurement_points: int = 16
    bandwidth: float | None = None
    together: bool = True
    natural: bool = True
    learning_rate: float = 1e-3
    weight_decay: float = 1e-3
    noise_std: float | tuple[float, ...] = 0.1
    learn_noise: bool = True
    noise_rows: float = 0.0
    noise_rate: float = 5.0
    likelihood_exponent: float = 1.0
    prior_exponent: float = 1.0
    falling_rate: bool = True
    checked_every: int = 2000
    patience: int = 0
    seed: int = 0


@dataclass(frozen=True, slots=True)
class Posterior:
    """Fitted particles: a model of dynamics with its uncertainty.

    Attributes:
        network: their shape.
        parameters: (L, P).
        noise_std: of the likelihood, normalised (O,).
        normaliser: between raw and normalised units.
        freedom: degrees of freedom of the noise's multivariate Student distribution; infinite for a Gaussian.
        trend: what all particles' normalised outputs have besides, linear in the normalised inputs: a constant and
            slopes (1 + D, O); nothing where it is None.
        correlation: of the noise of the normalised outputs (O, O); none unless given.
        reach: how far out each normalised input counts (D,); as far as ``EDGE`` unless given.
    """

    network: Network
    parameters: Tensor
    noise_std: Tensor
    normaliser: Normaliser
    freedom: float = math.inf
    trend: Tensor | None = None
    correlation: Tensor | None = None
    reach: Tensor | None = None

    @property
    def noise_scales(self) -> Tensor:
        """Of each particle's noise to draw from (L, 1, 1); some are wide, so that all have the tails."""
        return tail_scales(self.freedom, len(self.parameters)).to(self.noise_std)[:, None, None]

    def predict(self, inputs: Tensor) -> Mixture:
        """Prediction at raw inputs (N, D), in raw units."""
        with torch.no_grad():
            values = self.values(self.seen(inputs))
        turn = self.normaliser.error_turn
        noise = self.noise_std if turn is not None else self.noise_std * self.normaliser.output_std
        return Mixture(
            self.normaliser.raw_outputs(values), noise.expand(len(values), 1, -1), self.freedom, turn, self.correlation
        )

    def parameters_for(self, normaliser: Normaliser) -> Tensor:
        """Parameters (L, P) of the same functions, without the trend, in outputs turned as another normaliser's."""
        parameters = self.parameters.clone()
        eye = torch.eye(len(self.noise_std), dtype=torch.float64, device=parameters.device)
        own, other = (eye if n.output_turn is None else n.output_turn.double() for n in (self.normaliser, normaliser))
        across = (other @ torch.linalg.inv_ex(own).inverse).to(parameters).T
        for head in self.network.split(parameters)[-1]:
            head.copy_(head @ across)
        return parameters

    def values(self, seen: Tensor) -> Tensor:
        """Normalised outputs (L, N, O) where the networks see (N, D), or each its own (L, N, D)."""
        found = self.network(self.parameters, seen)
        return found if self.trend is None else found + self.trend[0] + seen @ self.trend[1:]

    def seen(self, inputs: Tensor) -> Tensor:
        """What the networks are given for raw inputs (N, D)."""
        there = self.normaliser.inputs(inputs)
        return there.clamp(-EDGE, EDGE) if self.reach is None else there.clamp(-self.reach, self.reach)

    def to(self, device: torch.device | str) -> Posterior:
        """The same on a device."""
        own = (self.parameters.to(device), self.noise_std.to(device), self.normaliser.to(device))
        rest = (None if v is None else v.to(device) for v in (self.trend, self.correlation, self.reach))
        return Posterior(self.network, *own, self.freedom, *rest)


def check_rows(inputs: Tensor, outputs: Tensor, *others: Tensor) -> None:
    """Refuse rows of inputs (n, D) and outputs (n, O), and other inputs, that nothing can be fitted to.

    Raises:
        DataError: rows of inputs and outputs differ in number, or numbers are missing or infinite.
    """
    if len(outputs) != len(inputs):
        raise DataError(f"There are {len(inputs)} rows of inputs and {len(outputs)} of outputs; each row needs both.")
    if not all(bool(torch.isfinite(given).all()) for given in (inputs, outputs, *others)):
        raise DataError("The data holds numbers that are missing or infinite; leave those rows out and fit again.")


def reach_of(seen: Tensor) -> Tensor:
    """How far out each input counts (D,) where normalised inputs (..., D) were learned from."""
    return seen.abs().flatten(0, -2).amax(dim=0).clamp_min(EDGE)


@dataclass
class _State:
    """What an optimiser moves: networks, and the logarithm of the noise."""

    networks: Tensor
    log_noise: Tensor
    expected_noise: Tensor = field(init=False)
    optimiser: torch.optim.Optimizer = field(init=False)

    def prepare(self, settings: FsvgdSettings) -> None:
        self.expected_noise = self.log_noise.exp()
        groups = [{"params": [self.networks], "weight_decay": settings.weight_decay}]
        if settings.learn_noise:
            groups.append({"params": [self.log_noise], "weight_decay": 0.0, "faster": settings.noise_rate})
        self.optimiser = torch.optim.AdamW(groups, lr=settings.learning_rate, fused=True)

    def posterior(self, network: Network, normaliser: Normaliser, reach: Tensor) -> Posterior:
        noise = self.log_noise.exp().clamp_min(LEAST_NOISE)
        return Posterior(network, self.networks.detach().clone(), noise, normaliser, reach=reach)


def fit(
    inputs: Tensor,
    outputs: Tensor,
    pool: Tensor,
    prior: FunctionPrior | None,
    normaliser: Normaliser,
    settings: FsvgdSettings,
    progress: Callable[[int], None] = lambda step: None,
    held_out: tuple[Tensor, Tensor] | None = None,
    seen_by: Tensor | None = None,
) -> Posterior:
    """Fit particles to data and prior.

    Args:
        inputs: raw inputs of the data (n, D); may be empty, then the prior alone is fitted.
        outputs: raw outputs (n, O).
        pool: raw inputs of the domain (M, D).
        prior: over functions, its pool being the data's inputs and then ``pool``; none is allowed where there is data.
        normaliser: of inputs and outputs.
        settings: how.
        progress: told the number of steps done, from time to time.
        held_out: raw inputs and outputs of rows that choose the step whose particles are kept.
        seen_by: whether each particle sees each row (L, n), of particles that do not feel each other; all see all
            unless given.

    Raises:
        DataError: there is nothing to fit, or numbers are missing or infinite; says what to do.
    """
    count = len(inputs)
    if count == 0 and prior is None:
        raise DataError("There is neither data nor a prior to fit; record an episode, or name a car file as the prior.")
    check_rows(inputs, outputs, pool)
    device = pool.device
    generator = torch.Generator().manual_seed(settings.seed)
    width = len(normaliser.output_mean)
    network = Network(pool.shape[1], width, settings.hidden)
    everything = normaliser.inputs(torch.cat([inputs, pool]))
    reach = reach_of(everything)
    targets = normaliser.outputs(outputs)
    noise = torch.as_tensor(settings.noise_std, dtype=everything.dtype).expand(width).to(device)
    state = _State(
        network.initial(settings.particles, generator, device).to(everything.dtype), noise.clamp_min(LEAST_NOISE).log()
    )
    state.prepare(settings)
    points = settings.measurement_points if prior is not None or count == 0 else 0
    kept = _Best(settings.patience)
    for step in range(settings.steps):
        falling = 0.01 + 0.495 * (1.0 + math.cos(math.pi * step / settings.steps))
        rate = settings.learning_rate * (falling if settings.falling_rate else 1.0)
        for group in state.optimiser.param_groups:
            group["lr"] = rate * group.get("faster", 1.0)
        rows = _rows(count, settings.batch, generator)
        others = count + torch.randint(len(pool), (points,), generator=generator)
        _step(network, state, everything, targets, rows.to(device), others.to(device), prior, settings, seen_by)
        if (step + 1) % CHECKED_EVERY == 0:
            progress(step + 1)
        if held_out is not None and (step + 1) % settings.checked_every == 0:
            kept.look(state.posterior(network, normaliser, reach), *held_out)
            if kept.settled:
                break
    found = state.posterior(network, normaliser, reach) if kept.posterior is None else kept.posterior
    if not torch.isfinite(found.parameters).all():
        raise DivergedError("The fit diverged; fit again with a smaller learning rate.")
    return found


@dataclass
class _Best:
    """The particles that rows which are held out like best."""

    patience: int
    posterior: Posterior | None = None
    surprise: float = math.inf
    since: int = 0

    def look(self, posterior: Posterior, inputs: Tensor, outputs: Tensor) -> None:
        surprise = negative_log_likelihood(posterior.predict(inputs), outputs)
        self.since += 1
        if surprise < self.surprise:
            self.posterior, self.surprise, self.since = posterior, surprise, 0

    @property
    def settled(self) -> bool:
        return 0 < self.patience <= self.since


def _rows(count: int, batch: int, generator: torch.Generator) -> Tensor:
    if count <= batch:
        return torch.arange(count)
    return torch.randint(count, (batch,), generator=generator)


def _step(
    network: Network,
    state: _State,
    everything: Tensor,
    targets: Tensor,
    rows: Tensor,
    others: Tensor,
    prior: FunctionPrior | None,
    settings: FsvgdSettings,
    seen_by: Tensor | None,
) -> None:
    """One step of the optimiser at the measurement set of data ``rows`` and of ``others`` in ``everything``."""
    chosen = torch.cat([rows, others])
    values, pullback = network.values_and_pullback(state.networks, everything[chosen])
    marginal = None if prior is None else prior.marginal(chosen)
    score = torch.zeros_like(values) if marginal is None else settings.prior_exponent * marginal.score(values)
    known = torch.zeros(values.shape[2], values.shape[1], dtype=values.dtype, device=values.device)
    if len(rows):
        noise = state.log_noise.exp().clamp_min(LEAST_NOISE)
        off, told = targets[rows] - values[:, : len(rows)], float(len(rows))
        if seen_by is not None:
            seen = seen_by[:, rows].to(off)
            off, told = off * seen[..., None], float(seen.sum()) / len(off)
        weight = settings.likelihood_exponent * len(targets) / len(rows)
        score[:, : len(rows)] += weight * off / noise**2
        known[:, : len(rows)] = weight / noise[:, None] ** 2
        if settings.learn_noise:
            # Gradient by the logarithm of the noise: the particles' mean negative log-likelihood, and the prior's.
            square = (off * off).mean(dim=0).sum(dim=0) / noise**2
            expected = settings.noise_rows * (1.0 - (state.expected_noise / noise) ** 2)
            state.log_noise.grad = weight * (told - square) + expected
    if not settings.together:
        state.networks.grad = -pullback(score)
        state.optimiser.step()
        return
    kernel = RbfKernel(settings.bandwidth or median_bandwidth(values.flatten(1)))
    if settings.natural:
        precision = torch.diag_embed(known) if marginal is None else torch.diag_embed(known) + marginal.precision()
        direction = natural_direction(values, score, precision, kernel)
    else:
        direction = stein_direction(values, score, kernel)
    state.networks.grad = -pullback(direction)
    state.optimiser.step()


__all__ = [
    "FsvgdSettings",
    "FunctionPrior",
    "GaussianProcessPrior",
    "Posterior",
    "SimulatorPrior",
    "check_rows",
    "fit",
    "reach_of",
]
