"""Inputs and outputs in units in which a network finds them of size one."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, slots=True)
class Normaliser:
    """Affine maps of inputs and outputs; means and standard deviations of shapes (D,) and (O,)."""

    input_mean: Tensor
    input_std: Tensor
    output_mean: Tensor
    output_std: Tensor

    def inputs(self, raw: Tensor) -> Tensor:
        """Normalised inputs."""
        return (raw - self.input_mean) / self.input_std

    def outputs(self, raw: Tensor) -> Tensor:
        """Normalised outputs."""
        return (raw - self.output_mean) / self.output_std

    def raw_inputs(self, normalised: Tensor) -> Tensor:
        """Inputs in their own units."""
        return normalised * self.input_std + self.input_mean

    def raw_outputs(self, normalised: Tensor) -> Tensor:
        """Outputs in their own units."""
        return normalised * self.output_std + self.output_mean

    def to(self, device: torch.device | str) -> Normaliser:
        """The same on a device."""
        parts = (self.input_mean, self.input_std, self.output_mean, self.output_std)
        return Normaliser(*(part.to(device) for part in parts))


__all__ = ["Normaliser"]
