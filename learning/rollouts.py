"""Rollouts of learned cars, which advance together: for predictions, and for the training of a policy."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Protocol

import torch
from torch import Tensor


class Rollouts(Protocol):
    """N rollouts of a learned car."""

    def step(self, features: Tensor, action: Tensor, generator: torch.Generator) -> Tensor:
        """Features (N, 7 + 2 H) one step after ``action`` (N, 2)."""
        ...

    def restart(self, rows: Tensor, generator: torch.Generator) -> None:
        """Start other rollouts in place of those with indices ``rows`` (M,)."""
        ...

    def measurement_noise(self, generator: torch.Generator) -> Tensor | None:
        """Noise (N, 6) of measured states, positions along the body axes; None if the steps contain it."""
        ...


class RolloutModel(Protocol):
    """A model that rollouts can be sampled from."""

    @property
    def history(self) -> int:
        """H, number of past commands in the features."""
        ...

    def rollouts(self, count: int, generator: torch.Generator) -> Rollouts:
        """Start N rollouts."""
        ...


class StatelessModel(ABC):
    """Base of models whose rollouts have no state besides the features: the model itself is any number of rollouts."""

    __slots__ = ()
    history: int

    @abstractmethod
    def step(self, features: Tensor, action: Tensor, generator: torch.Generator) -> Tensor:
        """Features (N, 7 + 2 H) one step after ``action`` (N, 2); a random model samples each step independently."""

    def rollouts(self, count: int, generator: torch.Generator) -> Rollouts:
        """Start N rollouts."""
        return self

    def restart(self, rows: Tensor, generator: torch.Generator) -> None:  # noqa: B027 - it is complete
        """Do nothing for ``rows`` (M,): no state lasts from step to step."""

    def measurement_noise(self, generator: torch.Generator) -> Tensor | None:
        """None: the steps contain the noise (N, 6)."""
        return None
