"""Steps of a simulator with parameters of each particle, which the particle's network corrects."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from learning.priors.simulator_model import CarModel


@dataclass(frozen=True, slots=True)
class ParticleSimulator:
    """A simulator with L draws of its parameters.

    Attributes:
        model: the simulator.
        parameters: one draw for each particle (L, K).
    """

    model: CarModel
    parameters: Tensor

    def __call__(self, inputs: Tensor) -> Tensor:
        """Raw outputs (L, N, O) at raw inputs (N, D) or at raw inputs of each particle (L, N, D); without a gradient.

        Outputs that are not finite are zero.
        """
        by_particle = inputs if inputs.ndim == 3 else inputs.expand(len(self.parameters), *inputs.shape)
        with torch.no_grad():
            return self.model.steps_of_draws(by_particle, self.parameters).nan_to_num(0.0, 0.0, 0.0)

    def to(self, device: torch.device | str) -> ParticleSimulator:
        """Copy on a device."""
        return ParticleSimulator(self.model, self.parameters.to(device))
