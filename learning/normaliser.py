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

    @classmethod
    def of(cls, inputs: Tensor, outputs: Tensor, least: float = 1e-6) -> Normaliser:
        """From examples: inputs (..., D) and outputs (..., O); what never changes keeps its size."""

        def moments(rows: Tensor) -> tuple[Tensor, Tensor]:
            flat = rows.reshape(-1, rows.shape[-1])
            std = flat.std(dim=0, correction=0)
            return flat.mean(dim=0), torch.where(std > least, std, torch.ones_like(std))

        return cls(*moments(inputs), *moments(outputs))

    def inputs(self, raw: Tensor) -> Tensor:
        """Normalised inputs."""
        return (raw - self.input_mean) / self.input_std

    def outputs(self, raw: Tensor) -> Tensor:
        """Normalised outputs."""
        return (raw - self.output_mean) / self.output_std

    def raw_outputs(self, normalised: Tensor) -> Tensor:
        """Outputs in their own units."""
        return normalised * self.output_std + self.output_mean


__all__ = ["Normaliser"]
