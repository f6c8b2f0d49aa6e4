"""Fitted particles of a network as a predictive distribution."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from learning.evaluation import Mixture
from learning.networks.normaliser import Normaliser
from learning.networks.particles import Network
from learning.outliers import tail_scales
from learning.priors.simulator_model import CarModel

MIN_INPUT_CLIP = 6.0
"""Minimum clip of normalised inputs; a network's extrapolation is unbounded."""
MAX_SIMULATED = 30.0
"""Bound of a simulator's outputs, in units of the outputs: a draw may diverge far from the rows."""


@dataclass(frozen=True, slots=True)
class ParticleSimulator:
    """A simulator with L draws of its parameters, whose steps the networks of the particles correct.

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


@dataclass(frozen=True, slots=True)
class ParticlePosterior:
    """Particles with noise: an equally weighted mixture.

    Attributes:
        network: their shape.
        parameters: (L, P).
        noise_std: of the likelihood, normalised (O,).
        normaliser: between raw and normalised units.
        dof: degrees of freedom of the noise's multivariate Student-t distribution; infinite for a Gaussian.
        trend: linear function of the normalised inputs that is added to all particles: a constant and slopes
            (1 + D, O); None: zero.
        correlation: of the noise of the normalised outputs (O, O); None: uncorrelated.
        input_clip: bounds of the normalised inputs (D,); None: ``MIN_INPUT_CLIP``.
        simulator: its steps are added to those of the networks and the trend; None: zero.
    """

    network: Network
    parameters: Tensor
    noise_std: Tensor
    normaliser: Normaliser
    dof: float = math.inf
    trend: Tensor | None = None
    correlation: Tensor | None = None
    input_clip: Tensor | None = None
    simulator: ParticleSimulator | None = None

    @property
    def noise_scales(self) -> Tensor:
        """Scale of each particle's noise in draws (L, 1, 1); their mixture has the Student-t tails."""
        return tail_scales(self.dof, len(self.parameters)).to(self.noise_std)[:, None, None]

    def predict(self, inputs: Tensor) -> Mixture:
        """Prediction at raw inputs (N, D), in raw units."""
        with torch.no_grad():
            values = self.values(self.clipped_inputs(inputs))
        decorrelation = self.normaliser.error_decorrelation
        noise = self.noise_std if decorrelation is not None else self.noise_std * self.normaliser.output_std
        return Mixture(
            self.normaliser.raw_outputs(values), noise.expand(len(values), 1, -1), self.dof, decorrelation,
            self.correlation,
        )  # fmt: skip

    def parameters_for(self, normaliser: Normaliser) -> Tensor:
        """Parameters (L, P) of the same networks for another normaliser's output decorrelation."""
        parameters = self.parameters.clone()
        eye = torch.eye(len(self.noise_std), dtype=torch.float64, device=parameters.device)
        own, other = (
            eye if n.decorrelation is None else n.decorrelation.double() for n in (self.normaliser, normaliser)
        )
        change = (other @ torch.linalg.inv_ex(own).inverse).to(parameters).T
        for head in self.network.split(parameters)[-1]:
            head.copy_(head @ change)
        return parameters

    def values(self, clipped: Tensor) -> Tensor:
        """Normalised outputs (L, N, O) at clipped inputs (N, D), or at inputs of each particle (L, N, D)."""
        values = self.without_simulator(clipped)
        return values if self.simulator is None else values + self.normaliser.outputs(self.simulated(clipped))

    def without_simulator(self, clipped: Tensor) -> Tensor:
        """The part of ``values`` of networks and trend."""
        values = self.network(self.parameters, clipped)
        return values if self.trend is None else values + self.trend[0] + clipped @ self.trend[1:]

    def simulated(self, clipped: Tensor) -> Tensor:
        """Raw outputs (L, N, O) of the simulator at clipped inputs (N, D), or at inputs of each particle (L, N, D)."""
        assert self.simulator is not None
        units, bound = self.normaliser, MAX_SIMULATED * self.normaliser.output_std
        raw = self.simulator(units.raw_inputs(clipped))
        return raw.clamp(units.output_mean - bound, units.output_mean + bound)

    def clipped_inputs(self, inputs: Tensor) -> Tensor:
        """Normalised and clipped inputs (N, D) of raw inputs (N, D)."""
        normalised = self.normaliser.inputs(inputs)
        if self.input_clip is None:
            return normalised.clamp(-MIN_INPUT_CLIP, MIN_INPUT_CLIP)
        return normalised.clamp(-self.input_clip, self.input_clip)

    def to(self, device: torch.device | str) -> ParticlePosterior:
        """Copy on a device."""
        required = (self.parameters.to(device), self.noise_std.to(device), self.normaliser.to(device))
        trend, correlation, clip = (
            None if v is None else v.to(device) for v in (self.trend, self.correlation, self.input_clip)
        )
        simulator = None if self.simulator is None else self.simulator.to(device)
        return ParticlePosterior(self.network, *required, self.dof, trend, correlation, clip, simulator)


def input_clip_of(inputs: Tensor) -> Tensor:
    """Bounds (D,) of normalised training inputs (..., D), at least ``MIN_INPUT_CLIP``."""
    return inputs.abs().flatten(0, -2).amax(dim=0).clamp_min(MIN_INPUT_CLIP)
