"""Inputs and outputs in units in which a network finds them of size one."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor


@dataclass(frozen=True, slots=True)
class Normaliser:
    """Affine maps of inputs and outputs; means and standard deviations of shapes (D,) and (O,).

    Attributes:
        input_mean, input_std, output_mean, output_std: middles and units.
        output_turn: what outputs in their units are multiplied by from the left (O, O), so that their errors are
            independent; nothing where it is None.
    """

    input_mean: Tensor
    input_std: Tensor
    output_mean: Tensor
    output_std: Tensor
    output_turn: Tensor | None = None

    def inputs(self, raw: Tensor) -> Tensor:
        """Normalised inputs."""
        return (raw - self.input_mean) / self.input_std

    def outputs(self, raw: Tensor) -> Tensor:
        """Normalised outputs."""
        alone = (raw - self.output_mean) / self.output_std
        return alone if self.output_turn is None else alone @ self.output_turn.to(alone).T

    def raw_inputs(self, normalised: Tensor) -> Tensor:
        """Inputs in their own units."""
        return normalised * self.input_std + self.input_mean

    def raw_outputs(self, normalised: Tensor) -> Tensor:
        """Outputs in their own units."""
        if self.output_turn is not None:
            normalised = normalised @ torch.linalg.inv_ex(self.output_turn.double()).inverse.to(normalised).T
        return normalised * self.output_std + self.output_mean

    @property
    def error_turn(self) -> Tensor | None:
        """What raw errors are multiplied by (O, O) where outputs are turned; those of normalised outputs follow."""
        return None if self.output_turn is None else self.output_turn.to(self.output_std) / self.output_std

    @property
    def log_volume(self) -> float:
        """By how much the turn makes volumes larger, as a logarithm: log densities in units are larger by it."""
        return 0.0 if self.output_turn is None else float(torch.linalg.slogdet(self.output_turn.double()).logabsdet)

    def turned(self, by: Tensor) -> Normaliser:
        """With normalised outputs multiplied by a matrix (O, O) from the left."""
        now = by if self.output_turn is None else by @ self.output_turn
        return replace(self, output_turn=now)

    def unturned(self) -> Normaliser:
        """With each output on its own."""
        return replace(self, output_turn=None)

    def to(self, device: torch.device | str) -> Normaliser:
        """The same on a device."""
        parts = (self.input_mean, self.input_std, self.output_mean, self.output_std)
        moved = Normaliser(*(part.to(device) for part in parts))
        return moved if self.output_turn is None else moved.turned(self.output_turn.to(device))


__all__ = ["Normaliser"]
