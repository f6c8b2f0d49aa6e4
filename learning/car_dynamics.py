"""A learned car: particles that predict one step in the body frame, and the exact kinematics that carry them on.

The world's pose enters through kinematics alone, so a step is ``pose + R(yaw) change`` and the networks see velocities
and the last commands. A particle is drawn for each car and step (Rothfuss et al., arXiv 2403.16644, section 5.3), and
noise of the likelihood is added, so that a policy meets both kinds of doubt.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Protocol

import torch
from torch import Tensor

from carlab.core.angles import wrap
from carlab.core.episode_data import EpisodeData
from carlab.core.observation import STATE_FEATURES, decode_history, decode_state, encode, push_action
from learning.draws import Draws
from learning.evaluation import Mixture, calibration_error, negative_log_likelihood
from learning.fsvgd import Posterior
from learning.transitions import transitions_of


class OneStep(Protocol):
    """What a learned world is made of."""

    @property
    def history(self) -> int:
        """H, commands before the last one that a row of inputs holds."""
        ...

    def step(self, features: Tensor, action: Tensor, generator: torch.Generator) -> Tensor:
        """Features (N, 7 + 2 H) one step after those that ``action`` (N, 2) is sent at, drawn with their doubt."""
        ...


class StepInBody(ABC):
    """A step by the changes that ``sample`` draws in the body frame of its start, and exact kinematics."""

    __slots__ = ()

    @abstractmethod
    def sample(self, inputs: Tensor, generator: torch.Generator) -> Tensor:
        """Changes (N, 6) over one step at inputs (N, 3 + 2 (H + 1)), in the order of ``transitions.OUTPUTS``."""

    def step(self, features: Tensor, action: Tensor, generator: torch.Generator) -> Tensor:
        """Features (N, 7 + 2 H) a step later."""
        return moved(features, action, self.sample(inputs_of(features, action), generator))


@dataclass(frozen=True, slots=True)
class CarDynamics(StepInBody):
    """A fitted model of one step of a car.

    Attributes:
        posterior: particles and noise.
        history: H, commands before the last one that a row of inputs holds.
    """

    posterior: Posterior
    history: int
    _draws: Draws = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_draws", Draws.of(self.posterior))

    def predict(self, inputs: Tensor) -> Mixture:
        """Changes at inputs (N, 3 + 2 (H + 1)) with their doubt."""
        return self.posterior.predict(inputs)

    def sample(self, inputs: Tensor, generator: torch.Generator) -> Tensor:
        """One draw (N, 6) of the mixture for each row."""
        return self._draws(inputs, generator)

    def surprise(self, episode: EpisodeData) -> tuple[float, float]:
        """Negative log-likelihood of an episode's steps [nat a step] and the calibration error there."""
        rows = transitions_of([episode], self.history)
        inputs, outputs = (torch.from_numpy(v).to(self.posterior.parameters) for v in (rows.inputs, rows.targets))
        predicted = self.predict(inputs).smoothed()
        return negative_log_likelihood(predicted, outputs), calibration_error(predicted, outputs)


def inputs_of(features: Tensor, action: Tensor) -> Tensor:
    """Rows of inputs (N, 3 + 2 (H + 1)) of features (N, 7 + 2 H) and the action (N, 2) that is sent now."""
    return torch.cat([features[:, STATE_FEATURES - 3 :], action], dim=1)


def moved(features: Tensor, action: Tensor, change: Tensor) -> Tensor:
    """Features (N, 7 + 2 H) after a step that sent ``action`` (N, 2) and changed the body by ``change`` (N, 6)."""
    sin, cos = features[:, 2], features[:, 3]
    ahead, left = change[:, 0], change[:, 1]
    state = decode_state(features)
    after = torch.stack([
        state[:, 0] + cos * ahead - sin * left,
        state[:, 1] + sin * ahead + cos * left,
        wrap(state[:, 2] + change[:, 2]),
        *(state[:, 3:] + change[:, 3:]).T,
    ], dim=1)  # fmt: skip
    found: Tensor = encode(after, push_action(decode_history(features), action))
    return found


__all__ = ["CarDynamics", "OneStep", "StepInBody", "inputs_of", "moved"]
