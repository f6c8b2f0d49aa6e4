"""FSVGD and Sim-FSVGD of the online-learning experiment with the settings of the authors' public code.

Settings and state are those of lasgroup/simulation_transfer at 547fa14 (``bnn_fsvgd.py`` and ``online_rl_loop.py``).
Inputs of a network are pose and velocities in the world frame; it predicts their changes, with sine and cosine
of the yaw as independent outputs. Without a simulator the weight of the Gaussian-process prior is ``1 / (L (batch +
points))``, because the authors average its score over particles and points and sum the likelihood; the repulsive term
is weaker by ``1 / L``; and at their bandwidth the kernel matrix is the identity, so that particles do not interact.
``corrected`` fits have none of these errors; their bandwidth follows the median heuristic. Draws of the simulator are
taken once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from carlab.core.episode_data import EpisodeData
from carlab.core.errors import DataError
from carlab.core.observation import STATE_FEATURES, decode_history, encode, push_action
from carlab.core.planar import to_body, to_world
from learning.evaluation import calibration_error, negative_log_likelihood
from learning.functional_svgd.fsvgd import (
    FsvgdSettings,
    FunctionPrior,
    GaussianProcessPrior,
    SimulatorPrior,
    fit_fsvgd,
)
from learning.networks.normaliser import Normaliser
from learning.networks.particles import Network
from learning.posterior.particle_posterior import ParticlePosterior
from learning.posterior.sampler import PosteriorSampler
from learning.priors.domain_models import draw_parameters
from learning.priors.function_prior import RbfCovariance
from learning.priors.simulator_model import CarModel
from learning.rollouts import StatelessModel
from learning.transitions import transitions_of

STATE_STD = (3.0, 3.0, 1.0, 1.0, 4.0, 4.0, 5.0)
CHANGE_STD = (0.127, 0.123, 0.060, 0.056, 2.86, 2.86, 5.65)
"""Units of x, y [m], sin, cos, vx, vy [m/s, world frame], yaw rate [rad/s] and of their changes."""
NOISE_STD = (0.0222, 0.0222, 0.0366, 0.0366, 0.1642, 0.1642, 0.7358)
PARTICLES, BATCH, POINTS, STEPS = 10, 32, 16, 40_000
MAX_POSITION_M, MAX_SPEED_MPS, MAX_YAW_RATE_RADPS = 4.0, 6.0, 8.0
POOL_POINTS = 4096
SIMULATOR_POOL_POINTS, SIMULATOR_DRAWS = 1024, 512
HELD_OUT_SHARE = 0.2
LENGTHSCALE = 0.2
DISCREPANCY_STD, DISCREPANCY_LENGTHSCALE = (0.008, 0.008, 0.01, 0.01, 0.08, 0.08, 0.5), 5.0
"""Of the simulator's discrepancy: standard deviations in the units of the changes, lengthscale on raw inputs."""
DRAWS_PER_BATCH = 32
PATIENCE = 3
"""Evaluations without improvement that end a fit. The authors' fit continues, and has the best networks of all
evaluations; these are the same unless a later one is better."""


def authors_settings(steps: int, seed: int, *, with_simulator: bool = False, corrected: bool = False) -> FsvgdSettings:
    """The authors' settings; ``corrected`` without the errors of their code."""
    noise = tuple(s / o for s, o in zip(NOISE_STD, CHANGE_STD, strict=True))
    settings = FsvgdSettings(
        particles=PARTICLES, steps=steps, batch=BATCH, measurement_points=POINTS, bandwidth=0.2, natural=False,
        noise_std=noise, noise_rate=1.0, likelihood_exponent=0.5, anneal_rate=False,
        validation_period=min(2000, steps), patience=PATIENCE, seed=seed,
    )  # fmt: skip
    if corrected:
        return replace(settings, bandwidth=None)
    return settings.with_published_errors(BATCH, with_simulator=with_simulator)


@dataclass(frozen=True, slots=True)
class WorldDynamics(StatelessModel):
    """Particles that predict changes in the world frame.

    Attributes:
        posterior: particles and noise.
        history: H, commands before the last one that the networks see.
    """

    posterior: ParticlePosterior
    history: int
    _sampler: PosteriorSampler = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_sampler", PosteriorSampler.of(self.posterior))

    def step(self, features: Tensor, action: Tensor, generator: torch.Generator) -> Tensor:
        """Features (N, 7 + 2 H) one step after ``action`` (N, 2); sine and cosine are projected on the unit circle."""
        now = in_world(features)
        after = now + self._sampler(_inputs(now, features, action), generator)
        yaw = torch.atan2(after[:, 2:3], after[:, 3:4])
        ahead, left = to_body(after[:, 4], after[:, 5], yaw[:, 0])
        state = torch.cat([after[:, :2], yaw, ahead[:, None], left[:, None], after[:, 6:7]], dim=1)
        next_features: Tensor = encode(state, push_action(decode_history(features), action))
        return next_features

    def score_episode(self, episode: EpisodeData) -> tuple[float, float]:
        """Negative log-likelihood of an episode's steps, seven outputs [nat per step], and calibration error.

        Raises:
            DataError: the episode has no complete step.
        """
        inputs, changes = (v.to(self.posterior.parameters) for v in world_rows([episode], self.history))
        predicted = self.posterior.predict(inputs)
        return negative_log_likelihood(predicted, changes), calibration_error(predicted, changes)


def in_world(features: Tensor) -> Tensor:
    """x, y, sin, cos, vx, vy in the world, yaw rate (N, 7) of features with body-frame velocities (N, 7 + 2 H)."""
    sin, cos, ahead, left = features[:, 2], features[:, 3], features[:, 4], features[:, 5]
    velocity = torch.stack([cos * ahead - sin * left, sin * ahead + cos * left], dim=1)
    return torch.cat([features[:, :4], velocity, features[:, 6:STATE_FEATURES]], dim=1)


def world_rows(episodes: Sequence[EpisodeData], history: int) -> tuple[Tensor, Tensor]:
    """Inputs (n, 7 + 2 (H + 1)) and changes (n, 7) of every complete step. Raises DataError without a step."""
    rows = transitions_of(episodes, history)
    inputs, changes = [], []
    for number, episode in enumerate(episodes):
        ticks = rows.tick[rows.episode == number]
        past = episode.sent[ticks[:, None] - np.arange(history, 0, -1)]
        before, after = (torch.from_numpy(encode(episode.states[t], past)).float() for t in (ticks, ticks + 1))
        inputs.append(_inputs(in_world(before), before, torch.from_numpy(episode.sent[ticks]).float()))
        changes.append(in_world(after) - in_world(before))
    return torch.cat(inputs), torch.cat(changes)


def fit_authors_fsvgd(
    episodes: Sequence[EpisodeData],
    history: int,
    steps: int = STEPS,
    seed: int = 0,
    progress: Callable[[int], None] = lambda step: None,
    device: torch.device | str = "cpu",
    simulator: CarModel | None = None,
    corrected: bool = False,
) -> WorldDynamics:
    """Fit from scratch to all episodes; without episodes, return networks with initial weights as the authors do.

    Args:
        episodes: recordings.
        history: H, commands before the last one that the networks see.
        steps: of the optimiser.
        seed: of all draws.
        progress: called with the number of steps done.
        device: of the fit; random numbers are drawn on the CPU.
        simulator: prior of Sim-FSVGD; None: FSVGD.
        corrected: without the errors of the authors' code.

    Raises:
        DataError: the episodes hold no complete step, or too few rows.
        DivergedError: the particles diverged.
    """
    settings = authors_settings(steps, seed, with_simulator=simulator is not None, corrected=corrected)
    width = STATE_FEATURES + 2 * (history + 1)
    input_std = torch.tensor([*STATE_STD, *(1.0,) * (2 * history + 2)])
    units = Normaliser(torch.zeros(width), input_std, torch.zeros(STATE_FEATURES), torch.tensor(CHANGE_STD))
    generator = torch.Generator().manual_seed(seed)
    if not episodes:
        network = Network(width, STATE_FEATURES, settings.hidden)
        noise = torch.as_tensor(settings.noise_std)
        unfitted = ParticlePosterior(network, network.initial(PARTICLES, generator), noise, units)
        return WorldDynamics(unfitted.to(device), history)
    inputs, changes = world_rows(episodes, history)
    held_out_count = int(HELD_OUT_SHARE * len(inputs))
    if held_out_count == 0:
        raise DataError(f"{len(inputs)} rows are too few for a validation split; record a longer episode.")
    order = torch.randperm(len(inputs), generator=generator).to(device)
    rows, held_out = order[held_out_count:], order[:held_out_count]
    pool = _domain_points(history, generator)[: POOL_POINTS if simulator is None else SIMULATOR_POOL_POINTS].to(device)
    units = units.to(device)
    inputs, changes = inputs.to(device), changes.to(device)
    prior = _prior(torch.cat([inputs[rows], pool]), units, simulator, generator)
    posterior = fit_fsvgd(
        inputs[rows], changes[rows], pool, prior, units, settings, progress, (inputs[held_out], changes[held_out])
    )
    return WorldDynamics(posterior, history)


def _prior(inputs: Tensor, units: Normaliser, simulator: CarModel | None, generator: torch.Generator) -> FunctionPrior:
    """Prior at raw inputs (M, 7 + 2 (H + 1)) of data and domain."""
    if simulator is None:
        return GaussianProcessPrior(units.inputs(inputs), RbfCovariance((1.0,) * STATE_FEATURES, (LENGTHSCALE,)))
    parameters = draw_parameters(simulator, SIMULATOR_DRAWS, generator).to(inputs)
    with torch.no_grad():
        draws = [
            units.outputs(simulated_changes(simulator, inputs, p)) for p in torch.split(parameters, DRAWS_PER_BATCH)
        ]
    scales = tuple(s / o for s, o in zip(DISCREPANCY_STD, CHANGE_STD, strict=True))
    return SimulatorPrior(torch.cat(draws), inputs, RbfCovariance(scales, (DISCREPANCY_LENGTHSCALE,)))


def simulated_changes(simulator: CarModel, inputs: Tensor, parameters: Tensor) -> Tensor:
    """Changes (P, N, 7) in the world frame of a simulator at inputs (N, 7 + 2 (H + 1)) for parameters (P, K)."""
    yaw = torch.atan2(inputs[:, 2], inputs[:, 3])
    ahead, left = to_body(inputs[:, 4], inputs[:, 5], yaw)
    body = torch.cat([ahead[:, None], left[:, None], inputs[:, 6:]], dim=1)
    dx, dy, turn, d_ahead, d_left, d_rate = simulator(body, parameters).unbind(dim=2)
    x, y = to_world(dx, dy, yaw)
    velocity_x, velocity_y = to_world(ahead + d_ahead, left + d_left, yaw + turn)
    heading = torch.sin(yaw + turn) - inputs[:, 2], torch.cos(yaw + turn) - inputs[:, 3]
    return torch.stack([x, y, *heading, velocity_x - inputs[:, 4], velocity_y - inputs[:, 5], d_rate], dim=2)


def _domain_points(history: int, generator: torch.Generator) -> Tensor:
    """Inputs (``POOL_POINTS``, 7 + 2 (H + 1)), uniform in the domain."""
    half_width = torch.tensor(
        [MAX_POSITION_M, MAX_POSITION_M, np.pi, 0.0, MAX_SPEED_MPS, MAX_SPEED_MPS, MAX_YAW_RATE_RADPS]
        + [1.0] * (2 * history + 2)
    )
    pool = half_width * (2.0 * torch.rand((POOL_POINTS, len(half_width)), generator=generator) - 1.0)
    yaw = pool[:, 2].clone()
    pool[:, 2], pool[:, 3] = yaw.sin(), yaw.cos()
    return pool


def _inputs(now: Tensor, features: Tensor, action: Tensor) -> Tensor:
    return torch.cat([now, features[:, STATE_FEATURES:], action], dim=1)
