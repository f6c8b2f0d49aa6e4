"""Samples of a particle posterior, one for each row of inputs: the step of a learned car."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from learning.posterior.particle_posterior import ParticlePosterior


@dataclass(frozen=True, slots=True)
class Draws:
    """Sampler of a posterior; units, decorrelation and correlation are precomputed in its matrices.

    Attributes:
        posterior: the mixture.
        parameters: of networks with raw outputs (L, P).
        slopes: of the trend in raw outputs, for each normalised input (D, O).
        noise: matrix (O, O) that multiplies independent unit noise from the right and gives raw noise.
        scales: of each particle's noise (L, 1, 1).
    """

    posterior: ParticlePosterior
    parameters: Tensor
    slopes: Tensor
    noise: Tensor
    scales: Tensor

    @classmethod
    def of(cls, posterior: ParticlePosterior) -> Draws:
        """Create the sampler of a posterior, on its device."""
        units, noise = posterior.normaliser, posterior.noise_std.double().diag()
        to_raw = units.output_std.double().diag()
        if units.decorrelation is not None:
            to_raw = torch.linalg.inv_ex(units.decorrelation.double()).inverse.T @ to_raw
        if posterior.correlation is not None:
            noise = torch.linalg.cholesky_ex(posterior.correlation.double()).L.T @ noise
        width = len(units.input_mean)
        trend = torch.zeros((1 + width, len(noise))).to(noise) if posterior.trend is None else posterior.trend.double()
        parameters = posterior.parameters.clone()
        weights, biases = posterior.network.split(parameters)[-1]
        weights.copy_(weights.double() @ to_raw)
        biases.copy_((biases.double() + trend[0]) @ to_raw + units.output_mean)
        slopes, noise = (v.to(parameters) for v in (trend[1:] @ to_raw, noise @ to_raw))
        return cls(posterior, parameters, slopes, noise, posterior.noise_scales)

    def __call__(self, inputs: Tensor, generator: torch.Generator) -> Tensor:
        """One sample (N, O) of the mixture at each of the raw inputs (N, D).

        Rows are assigned to particles at random and evenly; each particle is evaluated only at its rows.
        """
        count, particles = len(inputs), len(self.parameters)
        share = -(-count // particles)
        with torch.no_grad():
            slot = torch.randperm(share * particles, generator=generator)[:count].to(inputs.device)
            assigned = torch.zeros((share * particles, inputs.shape[1]), dtype=inputs.dtype, device=inputs.device)
            assigned[slot] = self.posterior.clipped_inputs(inputs)
            by_particle = assigned.view(particles, share, inputs.shape[1])
            values = self.posterior.network(self.parameters, by_particle)
            noise = torch.randn(values.shape, generator=generator).to(values)
            values += by_particle @ self.slopes + self.scales * (noise @ self.noise)
            return values.flatten(0, 1)[slot]


__all__ = ["Draws"]
