"""FSVGD for online learning as the public code of Sim-FSVGD's authors sets it, to be compared with.

A network sees the car's pose and velocities in the world and predicts their changes, with sine and cosine of the yaw as
if they were free numbers. Its Gaussian-process prior weighs next to nothing, for its score is averaged over particles
and points where the likelihood is summed; neither is there a simulator (lasgroup/simulation_transfer at 547fa14,
``bnn_fsvgd.py`` and ``online_rl_loop.py``).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from carlab.core.episode_data import EpisodeData
from carlab.core.errors import DataError
from carlab.core.observation import STATE_FEATURES, decode_history, encode, push_action
from learning.draws import Draws
from learning.evaluation import calibration_error, negative_log_likelihood
from learning.fsvgd import FsvgdSettings, GaussianProcessPrior, Posterior, fit
from learning.function_prior import RbfCovariance
from learning.normaliser import Normaliser
from learning.particles import Network
from learning.transitions import transitions_of

STATE_STD = (3.0, 3.0, 1.0, 1.0, 4.0, 4.0, 5.0)
CHANGE_STD = (0.127, 0.123, 0.060, 0.056, 2.86, 2.86, 5.65)
"""Units of the world's x, y [m], sin, cos, vx, vy [m/s], yaw rate [rad/s] and of their changes."""
NOISE_STD = (0.0222, 0.0222, 0.0366, 0.0366, 0.1642, 0.1642, 0.7358)
PARTICLES, BATCH, POINTS, STEPS = 10, 32, 16, 40_000
PLACES_M, SPEEDS_MPS, RATES_RADPS = 4.0, 6.0, 8.0
POOL = 4096
HELD_OUT = 0.2
LENGTHSCALE = 0.2
PATIENCE = 3
"""Looks without a better one that end a fit: theirs goes on to the last step, and keeps the same networks."""


def authors_settings(steps: int, seed: int) -> FsvgdSettings:
    """Their settings."""
    noise = tuple(s / o for s, o in zip(NOISE_STD, CHANGE_STD, strict=True))
    return FsvgdSettings(
        particles=PARTICLES, steps=steps, batch=BATCH, measurement_points=POINTS, bandwidth=0.2, natural=False,
        noise_std=noise, noise_rate=1.0, likelihood_exponent=0.5, prior_exponent=1.0 / (PARTICLES * (BATCH + POINTS)),
        falling_rate=False, checked_every=min(2000, steps), patience=PATIENCE, seed=seed,
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class WorldDynamics:
    """Particles that predict changes in the world frame.

    Attributes:
        posterior: particles and noise.
        history: H, commands before the last one that they see.
    """

    posterior: Posterior
    history: int
    _draws: Draws = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_draws", Draws.of(self.posterior))

    def step(self, features: Tensor, action: Tensor, generator: torch.Generator) -> Tensor:
        """Features (N, 7 + 2 H) a step later; sine and cosine are brought back to the circle."""
        now = in_world(features)
        after = now + self._draws(_inputs(now, features, action), generator)
        yaw = torch.atan2(after[:, 2:3], after[:, 3:4])
        ahead, left = _turned(after[:, 4], after[:, 5], yaw[:, 0])
        state = torch.cat([after[:, :2], yaw, ahead[:, None], left[:, None], after[:, 6:7]], dim=1)
        found: Tensor = encode(state, push_action(decode_history(features), action))
        return found

    def surprise(self, episode: EpisodeData) -> tuple[float, float]:
        """Negative log-likelihood of an episode's steps, seven outputs [nat a step], and the calibration error."""
        inputs, changes = (v.to(self.posterior.parameters) for v in world_rows([episode], self.history))
        predicted = self.posterior.predict(inputs)
        return negative_log_likelihood(predicted, changes), calibration_error(predicted, changes)


def in_world(features: Tensor) -> Tensor:
    """x, y, sin, cos, vx, vy in the world, yaw rate (N, 7) of features with body-frame velocities (N, 7 + 2 H)."""
    sin, cos, ahead, left = features[:, 2], features[:, 3], features[:, 4], features[:, 5]
    velocity = torch.stack([cos * ahead - sin * left, sin * ahead + cos * left], dim=1)
    return torch.cat([features[:, :4], velocity, features[:, 6:STATE_FEATURES]], dim=1)


def world_rows(episodes: Sequence[EpisodeData], history: int) -> tuple[Tensor, Tensor]:
    """Inputs (n, 7 + 2 (H + 1)) and changes (n, 7) of every whole step. Raises DataError where there is none."""
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
) -> WorldDynamics:
    """Fit anew to all episodes; networks as they are drawn where there are none, as theirs before the first episode.

    Raises:
        DataError: the episodes hold too few rows.
    """
    settings = authors_settings(steps, seed)
    width = STATE_FEATURES + 2 * (history + 1)
    input_std = torch.tensor([*STATE_STD, *(1.0,) * (2 * history + 2)])
    units = Normaliser(torch.zeros(width), input_std, torch.zeros(STATE_FEATURES), torch.tensor(CHANGE_STD))
    generator = torch.Generator().manual_seed(seed)
    if not episodes:
        network = Network(width, STATE_FEATURES, settings.hidden)
        noise = torch.as_tensor(settings.noise_std)
        unfitted = Posterior(network, network.initial(PARTICLES, generator), noise, units)
        return WorldDynamics(unfitted.to(device), history)
    inputs, changes = world_rows(episodes, history)
    aside = int(HELD_OUT * len(inputs))
    if aside == 0:
        raise DataError(f"{len(inputs)} rows are too few to hold some out; record a longer episode.")
    order = torch.randperm(len(inputs), generator=generator).to(device)
    rows, held_out = order[aside:], order[:aside]
    domain = torch.tensor(
        [PLACES_M, PLACES_M, np.pi, 0.0, SPEEDS_MPS, SPEEDS_MPS, RATES_RADPS, *(1.0,) * (2 * history + 2)]
    )
    pool = domain * (2.0 * torch.rand((POOL, width), generator=generator) - 1.0)
    yaw = pool[:, 2].clone()
    pool[:, 2], pool[:, 3] = yaw.sin(), yaw.cos()
    units = units.to(device)
    inputs, changes, pool = (v.to(device) for v in (inputs, changes, pool))
    everything = units.inputs(torch.cat([inputs[rows], pool]))
    prior = GaussianProcessPrior(everything, RbfCovariance((1.0,) * STATE_FEATURES, (LENGTHSCALE,)))
    found = fit(
        inputs[rows], changes[rows], pool, prior, units, settings, progress, (inputs[held_out], changes[held_out])
    )
    return WorldDynamics(found, history)


def _inputs(now: Tensor, features: Tensor, action: Tensor) -> Tensor:
    return torch.cat([now, features[:, STATE_FEATURES:], action], dim=1)


def _turned(along_x: Tensor, along_y: Tensor, yaw: Tensor) -> tuple[Tensor, Tensor]:
    """A vector of the world along the axes of a body."""
    sin, cos = yaw.sin(), yaw.cos()
    return cos * along_x + sin * along_y, cos * along_y - sin * along_x


__all__ = ["WorldDynamics", "authors_settings", "fit_authors_fsvgd", "in_world", "world_rows"]
