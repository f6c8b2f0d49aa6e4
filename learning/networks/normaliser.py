"""Affine normalisation of inputs and outputs, with an optional decorrelation of the outputs."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor


@dataclass(frozen=True, slots=True)
class Normaliser:
    """Affine maps of inputs and outputs; means and standard deviations of shapes (D,) and (O,).

    Attributes:
        input_mean, input_std, output_mean, output_std: centres and units.
        decorrelation: matrix (O, O) that multiplies scaled outputs from the left, so that prediction errors are
            uncorrelated; None is the identity.
    """

    input_mean: Tensor
    input_std: Tensor
    output_mean: Tensor
    output_std: Tensor
    decorrelation: Tensor | None = None

    def inputs(self, raw: Tensor) -> Tensor:
        """Normalised inputs (..., D) of raw inputs (..., D)."""
        return (raw - self.input_mean) / self.input_std

    def outputs(self, raw: Tensor) -> Tensor:
        """Normalised outputs (..., O) of raw outputs (..., O)."""
        scaled = (raw - self.output_mean) / self.output_std
        return scaled if self.decorrelation is None else scaled @ self.decorrelation.to(scaled).T

    def raw_inputs(self, normalised: Tensor) -> Tensor:
        """Inputs (..., D) in physical units, of normalised inputs (..., D)."""
        return normalised * self.input_std + self.input_mean

    def raw_outputs(self, normalised: Tensor) -> Tensor:
        """Outputs (..., O) in physical units, of normalised outputs (..., O)."""
        if self.decorrelation is not None:
            normalised = normalised @ torch.linalg.inv_ex(self.decorrelation.double()).inverse.to(normalised).T
        return normalised * self.output_std + self.output_mean

    @property
    def error_decorrelation(self) -> Tensor | None:
        """Matrix (O, O) from raw errors to errors of the normalised outputs; None without a decorrelation."""
        return None if self.decorrelation is None else self.decorrelation.to(self.output_std) / self.output_std

    @property
    def decorrelation_log_det(self) -> float:
        """Log determinant of the decorrelation: add it to a log density of decorrelated outputs."""
        return 0.0 if self.decorrelation is None else float(torch.linalg.slogdet(self.decorrelation.double()).logabsdet)

    def decorrelated(self, by: Tensor) -> Normaliser:
        """Copy with a further matrix (O, O) that multiplies the normalised outputs from the left."""
        return replace(self, decorrelation=by if self.decorrelation is None else by @ self.decorrelation)

    def without_decorrelation(self) -> Normaliser:
        """Copy without decorrelation."""
        return replace(self, decorrelation=None)

    def to(self, device: torch.device | str) -> Normaliser:
        """Copy on a device."""
        parts = (self.input_mean, self.input_std, self.output_mean, self.output_std)
        moved = Normaliser(*(part.to(device) for part in parts))
        return moved if self.decorrelation is None else moved.decorrelated(self.decorrelation.to(device))
