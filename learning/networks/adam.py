"""Adam for one tensor of numbers, in place: torch's own fused kernel, without the bookkeeping of ``torch.optim``.

Kingma and Ba 2015 ("Adam: A Method for Stochastic Optimization"), with decoupled weight decay as in Loshchilov and
Hutter 2019 ("Decoupled Weight Decay Regularization"). For networks of a few thousand numbers the optimiser's own
overhead is a good part of a step.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

BETA_1, BETA_2, EPSILON = 0.9, 0.999, 1e-8


@dataclass
class Adam:
    """Moments of a gradient, and the step that they make."""

    numbers: Tensor
    weight_decay: float = 0.0
    second: float = BETA_2
    mean: Tensor = field(init=False)
    square: Tensor = field(init=False)
    _steps: Tensor = field(init=False)

    def __post_init__(self) -> None:
        self.mean, self.square = torch.zeros_like(self.numbers), torch.zeros_like(self.numbers)
        self._steps = torch.zeros((), device=self.numbers.device)

    @property
    def steps(self) -> int:
        """How many were made."""
        return int(self._steps)

    def step(self, gradient: Tensor, rate: float) -> None:
        """Move the numbers against their gradient."""
        self._steps += 1.0
        torch._fused_adamw_(
            [self.numbers], [gradient], [self.mean], [self.square], [], [self._steps],
            lr=rate, beta1=BETA_1, beta2=self.second, weight_decay=self.weight_decay, eps=EPSILON,
            amsgrad=False, maximize=False,
        )  # fmt: skip

    def state(self) -> dict[str, Tensor | int]:
        """A copy of the moments, on the CPU."""
        return {"steps": self.steps, "mean": self.mean.cpu().clone(), "square": self.square.cpu().clone()}

    def load(self, state: dict[str, Tensor | int]) -> None:
        """Load the moments of ``state``. Raises ValueError for another shape."""
        mean, square = torch.as_tensor(state["mean"]), torch.as_tensor(state["square"])
        if mean.shape != self.mean.shape or square.shape != mean.shape:
            raise ValueError(f"moments of shape {tuple(mean.shape)} for numbers of shape {tuple(self.mean.shape)}")
        self.mean.copy_(mean)
        self.square.copy_(square)
        self._steps.fill_(float(state["steps"]))


__all__ = ["Adam"]
