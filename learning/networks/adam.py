"""Adam for one tensor of parameters, in place: torch's fused kernel without the overhead of ``torch.optim``.

Kingma and Ba 2015 ("Adam: A Method for Stochastic Optimization"). For networks of a few thousand parameters this
overhead is a large part of a step.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch
from torch import Tensor

BETA_1, BETA_2, EPSILON = 0.9, 0.999, 1e-8


def half_cosine(step: int, steps: int, final_share: float) -> float:
    """Share of the initial learning rate at a step: it falls along a half cosine from 1 to ``final_share``."""
    return final_share + (1.0 - final_share) * 0.5 * (1.0 + math.cos(math.pi * step / steps))


@dataclass
class Adam:
    """Adam's state for one tensor.

    Attributes:
        parameters: of any shape; changed in place.
        second: beta_2.
        mean, square: moments of the gradient, in the shape of the parameters.
    """

    parameters: Tensor
    second: float = BETA_2
    mean: Tensor = field(init=False)
    square: Tensor = field(init=False)
    _steps: Tensor = field(init=False)

    def __post_init__(self) -> None:
        self.mean, self.square = torch.zeros_like(self.parameters), torch.zeros_like(self.parameters)
        self._steps = torch.zeros((), device=self.parameters.device)

    def step(self, gradient: Tensor, rate: float | Tensor) -> None:
        """Move the parameters against their gradient, a tensor of the same shape, by the learning rate ``rate``.

        A rate in a CUDA tensor () may change between replays of a captured step.
        """
        self._steps += 1.0
        torch._fused_adamw_(
            [self.parameters], [gradient], [self.mean], [self.square], [], [self._steps],
            lr=rate, beta1=BETA_1, beta2=self.second, weight_decay=0.0, eps=EPSILON,
            amsgrad=False, maximize=False,
        )  # fmt: skip

    def state(self) -> dict[str, Tensor | int]:
        """Number of steps, and a copy of both moments in the shape of the parameters, on the CPU."""
        return {"steps": int(self._steps), "mean": self.mean.cpu().clone(), "square": self.square.cpu().clone()}

    def load(self, state: dict[str, Tensor | int]) -> None:
        """Load the moments of ``state``. Raises ValueError for another shape."""
        mean, square = torch.as_tensor(state["mean"]), torch.as_tensor(state["square"])
        if mean.shape != self.mean.shape or square.shape != mean.shape:
            raise ValueError(f"moments of shape {tuple(mean.shape)} for parameters of shape {tuple(self.mean.shape)}")
        self.mean.copy_(mean)
        self.square.copy_(square)
        self._steps.fill_(float(state["steps"]))
