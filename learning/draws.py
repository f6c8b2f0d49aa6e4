"""Draws of a fitted posterior, one for each row, as often as a learned world is stepped."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from learning.fsvgd import Posterior


@dataclass(frozen=True, slots=True)
class Draws:
    """A posterior's mixture to draw from; units, turn and correlation are folded into its matrices once.

    Attributes:
        posterior: the mixture.
        parameters: of networks whose outputs are raw (L, P).
        slopes: raw outputs that all particles have besides, for each input as the networks see it (D, O).
        noise: what independent noise of unit size is multiplied by from the right (O, O).
        scales: of each particle's noise (L, 1, 1).
    """

    posterior: Posterior
    parameters: Tensor
    slopes: Tensor
    noise: Tensor
    scales: Tensor

    @classmethod
    def of(cls, posterior: Posterior) -> Draws:
        """Draws of a posterior, where it is."""
        units, noise = posterior.normaliser, posterior.noise_std.double().diag()
        to_raw = units.output_std.double().diag()
        if units.output_turn is not None:
            to_raw = torch.linalg.inv_ex(units.output_turn.double()).inverse.T @ to_raw
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
        """One draw (N, O) of the mixture at raw inputs (N, D).

        Rows are dealt to particles at random and evenly, so that each runs on its share alone.
        """
        count, particles = len(inputs), len(self.parameters)
        share = -(-count // particles)
        with torch.no_grad():
            place = torch.randperm(share * particles, generator=generator)[:count].to(inputs.device)
            dealt = torch.zeros((share * particles, inputs.shape[1]), dtype=inputs.dtype, device=inputs.device)
            dealt[place] = self.posterior.seen(inputs)
            given = dealt.view(particles, share, inputs.shape[1])
            values = self.posterior.network(self.parameters, given)
            noise = torch.randn(values.shape, generator=generator).to(values)
            values += given @ self.slopes + self.scales * (noise @ self.noise)
            return values.flatten(0, 1)[place]


__all__ = ["Draws"]
