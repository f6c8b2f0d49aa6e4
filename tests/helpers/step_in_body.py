"""Learned cars of tests that are given by the changes of a step in the body frame."""

from __future__ import annotations

from abc import abstractmethod

import torch
from torch import Tensor

from learning.rollouts import StatelessModel
from learning.world.car_dynamics import advance, inputs_of


class StepInBody(StatelessModel):
    """A step by exact kinematics, from changes in the body frame at its start."""

    @abstractmethod
    def sample(self, inputs: Tensor, generator: torch.Generator) -> Tensor:
        """Changes (N, 6) over one step at inputs (N, 3 + 2 (H + 1)), in the order of ``transitions.OUTPUTS``."""

    def step(self, features: Tensor, action: Tensor, generator: torch.Generator) -> Tensor:
        return advance(features, action, self.sample(inputs_of(features, action), generator))
