"""What drives: a policy sees a tick and answers with an action."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from carlab.core.quantities import Action, FloatArray, Observation


@dataclass(frozen=True, slots=True)
class PolicyInput:
    """What a policy may look at: encoded features (7 + 2 H,), the observation, ticks and seconds since the start."""

    features: FloatArray
    observation: Observation
    step: int
    elapsed_s: float


@runtime_checkable
class Policy(Protocol):
    """Decides one action a tick. ``act`` returns None when it has nothing more to do."""

    name: str

    def reset(self) -> None:
        """Begin a new episode."""

    def act(self, view: PolicyInput) -> Action | None:
        """The action of this tick."""
