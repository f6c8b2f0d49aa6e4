"""Samples of a particle posterior, one for each row of inputs: the step of a learned car."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from learning.posterior.particle_posterior import ParticlePosterior


@dataclass(frozen=True, slots=True)
class Assignment:
    """Assignment of N rows to L particles, which are evaluated in one batch.

    Attributes:
        slot: of each row (N,), from 0 to ``L * share - 1``; all different. Row k has particle ``slot[k] // share``.
        share: slots of each particle.
    """

    slot: Tensor
    share: int

    @classmethod
    def random(cls, count: int, particles: int, generator: torch.Generator, spare: int = 0) -> Assignment:
        """Random and even assignment of ``count`` rows, with at least ``spare`` free slots."""
        share = -(-(count + spare) // particles)
        return cls(torch.randperm(share * particles, generator=generator)[:count], share)

    @classmethod
    def of_particles(cls, particle: Tensor, particles: int) -> Assignment:
        """Assignment of each row to a given particle (N,)."""
        order = torch.argsort(particle, stable=True)
        counts = torch.bincount(particle, minlength=particles)
        rank = torch.empty_like(order)
        rank[order] = torch.arange(len(order)) - (counts.cumsum(0) - counts)[particle[order]]
        share = int(counts.max())
        return cls(particle * share + rank, share)

    def reassigned(self, rows: Tensor, particles: int, generator: torch.Generator) -> Assignment:
        """Copy with new random slots for the rows with indices (m,), drawn among their slots and the free ones."""
        taken = torch.zeros(self.share * particles, dtype=torch.bool)
        taken[self.slot] = True
        taken[self.slot[rows]] = False
        free = torch.nonzero(~taken)[:, 0]
        slot = self.slot.clone()
        slot[rows] = free[torch.randperm(len(free), generator=generator)[: len(rows)]]
        return Assignment(slot, self.share)


@dataclass(frozen=True, slots=True)
class PosteriorSampler:
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
    def of(cls, posterior: ParticlePosterior) -> PosteriorSampler:
        """Create the sampler of a posterior, on its device."""
        noise = posterior.noise_std.double().diag()
        if posterior.correlation is not None:
            noise = torch.linalg.cholesky_ex(posterior.correlation.double()).L.T @ noise
        parameters = posterior.parameters.clone()
        head = posterior.network.split(parameters)[-1]
        weights, biases, slopes = with_raw_outputs(posterior, *head)
        head[0].copy_(weights)
        head[1].copy_(biases)
        noise = (noise @ _to_raw(posterior)).to(parameters)
        return cls(posterior, parameters, slopes, noise, posterior.noise_scales)

    def __call__(self, inputs: Tensor, generator: torch.Generator) -> Tensor:
        """One sample (N, O) of the mixture at each of the raw inputs (N, D).

        Rows are assigned to particles at random and evenly; each particle is evaluated only at its rows.
        """
        assignment = Assignment.random(len(inputs), len(self.parameters), generator)
        with torch.no_grad():
            values = self._values(inputs, assignment)
            noise = torch.randn(values.shape, generator=generator).to(values)
            values += self.scales * (noise @ self.noise)
            return values.flatten(0, 1)[assignment.slot.to(inputs.device)]

    def without_noise(self, inputs: Tensor, assignment: Assignment) -> Tensor:
        """Raw outputs (N, O) of the assigned particles at raw inputs (N, D)."""
        with torch.no_grad():
            return self._values(inputs, assignment).flatten(0, 1)[assignment.slot.to(inputs.device)]

    def noise_samples(self, count: int, generator: torch.Generator) -> Tensor:
        """Samples (N, O) of the noise of the likelihood, raw."""
        which = torch.randint(len(self.scales), (count,), generator=generator).to(self.scales.device)
        noise = torch.randn((count, len(self.noise)), generator=generator).to(self.noise)
        samples: Tensor = self.scales[which, 0] * (noise @ self.noise)
        return samples

    def _values(self, inputs: Tensor, assignment: Assignment) -> Tensor:
        """Raw outputs (L, share, O) of each particle at its rows."""
        particles, share = len(self.parameters), assignment.share
        assigned = torch.zeros((share * particles, inputs.shape[1]), dtype=inputs.dtype, device=inputs.device)
        assigned[assignment.slot.to(inputs.device)] = self.posterior.clipped_inputs(inputs)
        by_particle = assigned.view(particles, share, inputs.shape[1])
        values = self.posterior.network(self.parameters, by_particle)
        values += by_particle @ self.slopes
        if self.posterior.simulator is not None:
            values += self.posterior.simulated(by_particle)
        return values


def with_raw_outputs(posterior: ParticlePosterior, weights: Tensor, biases: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Change the heads of networks from normalised to raw outputs; differentiable.

    Args:
        posterior: with the units and the trend.
        weights: of the heads (L, hidden, O).
        biases: of the heads (L, 1, O).

    Returns:
        Weights and biases for raw outputs, the constant of the trend included, and the slopes (D, O) of the trend in
        raw outputs for each normalised input. The outputs of a simulator are to be added.
    """
    units, to_raw = posterior.normaliser, _to_raw(posterior)
    shape = (1 + len(units.input_mean), len(to_raw))
    trend = torch.zeros(shape).to(to_raw) if posterior.trend is None else posterior.trend.double()
    raw_biases = (biases.double() + trend[0]) @ to_raw
    if posterior.simulator is None:
        raw_biases = raw_biases + units.output_mean  # The simulator's raw outputs contain the mean.
    return (weights.double() @ to_raw).to(weights), raw_biases.to(biases), (trend[1:] @ to_raw).to(weights)


def _to_raw(posterior: ParticlePosterior) -> Tensor:
    """Matrix (O, O) that multiplies normalised outputs from the right and gives raw outputs, without their mean."""
    units = posterior.normaliser
    to_raw = units.output_std.double().diag()
    if units.decorrelation is not None:
        to_raw = torch.linalg.inv_ex(units.decorrelation.double()).inverse.T @ to_raw
    return to_raw
