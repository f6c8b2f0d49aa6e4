"""Adam for one tensor of numbers, in place: the same steps as ``torch.optim.Adam``, without its bookkeeping.

Kingma and Ba 2015 ("Adam: A Method for Stochastic Optimization"), with decoupled weight decay as in Loshchilov and
Hutter 2019 ("Decoupled Weight Decay Regularization"). For networks of a few thousand numbers the optimiser's own
overhead is a good part of a step.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch
from torch import Tensor

FIRST, SECOND, LEAST = 0.9, 0.999, 1e-8
"""Decays of the mean and of the mean square of the gradient; what keeps a step finite where that is zero."""


@dataclass
class Adam:
    """Moments of a gradient, and the step that they make."""

    numbers: Tensor
    weight_decay: float = 0.0
    second: float = SECOND
    steps: int = 0
    mean: Tensor = field(init=False)
    square: Tensor = field(init=False)

    def __post_init__(self) -> None:
        self.mean, self.square = torch.zeros_like(self.numbers), torch.zeros_like(self.numbers)

    def step(self, gradient: Tensor, rate: float) -> None:
        """Move the numbers against their gradient."""
        self.steps += 1
        if self.weight_decay:
            self.numbers.mul_(1.0 - rate * self.weight_decay)
        self.mean.lerp_(gradient, 1.0 - FIRST)
        self.square.mul_(self.second).addcmul_(gradient, gradient, value=1.0 - self.second)
        scale = math.sqrt(1.0 - self.second**self.steps)
        # rate mean / (1 - FIRST^k) over sqrt(square / (1 - second^k)) + LEAST, both multiplied by ``scale``.
        below = self.square.sqrt().add_(LEAST * scale)
        self.numbers.addcdiv_(self.mean, below, value=-rate * scale / (1.0 - FIRST**self.steps))

    def state(self) -> dict[str, Tensor | int]:
        """A copy of the moments, on the CPU."""
        return {"steps": self.steps, "mean": self.mean.cpu().clone(), "square": self.square.cpu().clone()}

    def load(self, state: dict[str, Tensor | int]) -> None:
        """Take up the moments that ``state`` gave. Raises ValueError for those of other numbers."""
        mean, square = torch.as_tensor(state["mean"]), torch.as_tensor(state["square"])
        if mean.shape != self.mean.shape or square.shape != mean.shape:
            raise ValueError(f"moments of shape {tuple(mean.shape)} for numbers of shape {tuple(self.mean.shape)}")
        self.mean.copy_(mean)
        self.square.copy_(square)
        self.steps = int(state["steps"])


__all__ = ["Adam"]
