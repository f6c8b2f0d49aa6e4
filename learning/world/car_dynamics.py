"""A learned car: particles predict one step in the body frame, and exact kinematics integrate the pose.

A step is ``pose + R(yaw) change``; inputs of the networks are velocities and the last commands, without the pose. Each
step of each car samples a particle (epistemic uncertainty; Rothfuss et al., arXiv 2403.16644, section 5.3) and the
noise of the likelihood (aleatoric uncertainty).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from carlab.core.angles import wrap
from carlab.core.episode_data import EpisodeData
from carlab.core.observation import STATE_FEATURES, decode_history, decode_state, encode, push_action
from learning.evaluation import Mixture, calibration_error, negative_log_likelihood
from learning.posterior.particle_posterior import ParticlePosterior
from learning.posterior.sampler import PosteriorSampler
from learning.rollouts import StatelessModel
from learning.transitions import transitions_of


@dataclass(frozen=True, slots=True)
class CarDynamics(StatelessModel):
    """A fitted model of one step of a car.

    Attributes:
        posterior: particles and noise.
        history: H, number of commands before the last one in a row of inputs.
        sampler: of the particles.
    """

    posterior: ParticlePosterior
    history: int
    sampler: PosteriorSampler = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "sampler", PosteriorSampler.of(self.posterior))

    def predict(self, inputs: Tensor) -> Mixture:
        """Predictive distribution of changes at inputs (N, 3 + 2 (H + 1))."""
        return self.posterior.predict(inputs)

    def step(self, features: Tensor, action: Tensor, generator: torch.Generator) -> Tensor:
        """Features (N, 7 + 2 H) one step after ``action`` (N, 2)."""
        return advance(features, action, self.sampler(inputs_of(features, action), generator))

    def score_episode(self, episode: EpisodeData) -> tuple[float, float]:
        """Negative log-likelihood of an episode's steps [nat per step], and calibration error.

        Raises:
            DataError: the episode has no complete step.
        """
        rows = transitions_of([episode], self.history)
        inputs, outputs = (torch.from_numpy(v).to(self.posterior.parameters) for v in (rows.inputs, rows.targets))
        predicted = self.predict(inputs).smoothed()
        return negative_log_likelihood(predicted, outputs), calibration_error(predicted, outputs)


def inputs_of(features: Tensor, action: Tensor) -> Tensor:
    """Rows of inputs (N, 3 + 2 (H + 1)) from features (N, 7 + 2 H) and the next action (N, 2)."""
    return torch.cat([features[:, STATE_FEATURES - 3 :], action], dim=1)


def advance(features: Tensor, action: Tensor, change: Tensor) -> Tensor:
    """Features (N, 7 + 2 H) after a step with ``action`` (N, 2) and the body-frame ``change`` (N, 6)."""
    sin, cos = features[:, 2], features[:, 3]
    ahead, left = change[:, 0], change[:, 1]
    state = decode_state(features)
    after = torch.stack([
        state[:, 0] + cos * ahead - sin * left,
        state[:, 1] + sin * ahead + cos * left,
        wrap(state[:, 2] + change[:, 2]),
        *(state[:, 3:] + change[:, 3:]).T,
    ], dim=1)  # fmt: skip
    encoded: Tensor = encode(after, push_action(decode_history(features), action))
    return encoded
