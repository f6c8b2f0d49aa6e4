"""The interface of policies: from the input of a tick to an action."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from carlab.core.quantities import Action, FloatArray, Observation


@dataclass(frozen=True, slots=True)
class PolicyInput:
    """Input of a policy: encoded features (7 + 2 H,), the observation, ticks and seconds since the start."""

    features: FloatArray
    observation: Observation
    step: int
    elapsed_s: float


@runtime_checkable
class Policy(Protocol):
    """A policy: one action per tick. ``act`` returns None at the end of a script; ``name`` is written to recordings."""

    name: str

    def reset(self) -> None:
        """Begin a new episode."""

    def act(self, view: PolicyInput) -> Action | None:
        """The action of this tick."""
