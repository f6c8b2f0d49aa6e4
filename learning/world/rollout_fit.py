"""Fit of a learned car to whole rollouts over all recorded windows.

The posterior over functions has a one-step likelihood and is conditioned on a subset of the rows. Small errors of a
step add up over a rollout, and one-step errors hardly show them. Here each particle is adjusted further, by gradient
descent on the sum of

* the errors of its rollouts over windows, in units of the errors before (simulation error minimisation: Forgione and
  Piga 2021, "Continuous-time system identification with neural networks"). Each particle has other random weights of
  the windows (weighted likelihood bootstrap: Newton and Raftery 1994), so that particles still differ where the
  recordings do not determine the car;
* its one-step errors at all rows, in units of the one-step noise, so that one-step predictions remain as accurate;
* the distance from its function before, at inputs around the windows: the posterior acts as the prior.

All errors have a Huber loss, so that collisions have a bounded influence.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional

from carlab.core.errors import DataError, DivergedError
from carlab.core.robust import STD_OVER_MAD
from learning.networks.adam import Adam, half_cosine
from learning.networks.particles import Layers
from learning.posterior.particle_posterior import ParticlePosterior
from learning.posterior.sampler import with_raw_outputs
from learning.transitions import Transitions
from learning.world.car_dynamics import CarDynamics
from learning.world.drive_windows import DriveWindows, roll_out
from learning.world.local_steps import LocalSteps

FINAL_RATE_SHARE = 0.01
"""Share of the learning rate at the end: one-step errors of a millimetre need a small one."""
ANCHOR_DISTANCE = 0.5
"""Standard deviation of the inputs of the anchor around those of the windows, in units of the inputs."""
ROLLOUT_HUBER = 1.0
"""Error of a rollout, in units of the errors before, from which its loss is linear."""
ONE_STEP_HUBER = 1.5
"""One-step error, in standard deviations of the noise, from which its loss is linear."""
MIN_UNIT_SHARE = 0.1
"""Minimum unit of an error in a rollout, as a share of the unit at the end."""
MAX_GRADIENT = 1.0
"""Maximum norm of a particle's gradient: a rollout that diverges has a very large one."""
PROGRESS_PERIOD = 50
"""Updates between two reports of progress."""


@dataclass(frozen=True, slots=True)
class RolloutFitSettings:
    """Settings of the fit to rollouts. Chosen by the error on a third of one real recording (ETH train_1)."""

    updates: int = 2000
    """Gradient steps; about two minutes on one core for 20 particles and windows of 30 steps."""
    windows: int = 16
    """Windows of each particle in a gradient step."""
    rows: int = 256
    """Rows of each particle in a gradient step, for the one-step errors."""
    learning_rate: float = 3e-3
    """Initial learning rate of Adam; it falls along a half cosine."""
    one_step_weight: float = 0.2
    """Weight of one-step errors. Without them the one-step likelihood falls by 2 nats; a weight of 1 takes two thirds
    of the gain over a second."""
    anchor_weight: float = 0.3
    """Weight of the squared distance from the function before, in units of the outputs."""


def fit_rollouts(
    car: CarDynamics,
    windows: DriveWindows,
    rows: Transitions,
    settings: RolloutFitSettings | None = None,
    *,
    seed: int = 0,
    progress: Callable[[int], None] = lambda update: None,
) -> CarDynamics:
    """Adjust the networks of a car to rollouts. The noise of one step and the particles' simulators do not change.

    Args:
        car: fitted with a one-step likelihood, on any device.
        windows: of the recordings to fit, with the period of the car's steps.
        rows: transitions of the same recordings.
        settings: of the fit.
        seed: of weights, windows and rows, which are drawn on the CPU.
        progress: called with the number of updates done.

    Returns:
        The adjusted car, on the same device.

    Raises:
        DataError: no window, no row, or rows with another number of past commands.
        DivergedError: the particles diverged.
    """
    if not len(windows) or not len(rows):
        raise DataError("The fit to rollouts needs a window in which the car moves; record a longer drive.")
    if rows.history != car.history:
        raise DataError(f"The rows have {rows.history} past commands, the car {car.history}; use the same number.")
    settings = settings or RolloutFitSettings()
    device = car.posterior.parameters.device
    generator = torch.Generator().manual_seed(seed)
    inputs, outputs = (torch.from_numpy(v).float().to(device) for v in (rows.inputs, rows.targets))
    problem = _Problem.of(car, windows.to(device), inputs, outputs, settings)
    unit = problem.error_unit(generator)
    parameters = car.posterior.parameters.clone()
    adam = Adam(parameters)
    particles = len(parameters)
    weights = -torch.log(torch.rand((particles, len(windows)), generator=generator).clamp_min(1e-12))
    for update in range(settings.updates):
        chosen = torch.multinomial(weights, settings.windows, replacement=True, generator=generator).to(device)
        batch = torch.randint(len(inputs), (particles, settings.rows), generator=generator).to(device)
        rate = settings.learning_rate * half_cosine(update, settings.updates, FINAL_RATE_SHARE)
        adam.step(problem.gradient(parameters, chosen, batch, unit, generator), rate)
        if (update + 1) % PROGRESS_PERIOD == 0:
            progress(update + 1)
    if not torch.isfinite(parameters).all():
        raise DivergedError("the fit to rollouts gave values that are not finite")
    return CarDynamics(replace(car.posterior, parameters=parameters), car.history)


@dataclass(frozen=True, slots=True)
class _Problem:
    """Loss of L particles.

    Attributes:
        car: before the fit.
        windows: S windows.
        inputs: of all rows (n, D), normalised and clipped.
        outputs: of all rows for each particle (L, n, 6), normalised, less those of its simulator.
        settings: of the fit.
        simulated: steps of the particles' simulators at the windows; None: without a simulator.
    """

    car: CarDynamics
    windows: DriveWindows
    inputs: Tensor
    outputs: Tensor
    settings: RolloutFitSettings
    simulated: LocalSteps | None

    @classmethod
    def of(
        cls, car: CarDynamics, windows: DriveWindows, inputs: Tensor, outputs: Tensor, settings: RolloutFitSettings
    ) -> _Problem:
        """Simulate all rows and windows, for raw inputs (n, D) and outputs (n, 6)."""
        posterior, simulated = car.posterior, None
        clipped = posterior.clipped_inputs(inputs)
        normalised = posterior.normaliser.outputs(outputs).expand(len(posterior.parameters), -1, -1)
        if posterior.simulator is not None:
            simulated = LocalSteps.of(posterior.simulator, windows)
            normalised = normalised - posterior.normaliser.outputs(posterior.simulated(clipped))
        return cls(car, windows, clipped, normalised, settings, simulated)

    def error_unit(self, generator: torch.Generator) -> Tensor:
        """Robust standard deviation (K, 6) of the errors before the fit: scaled median absolute deviation."""
        posterior, count = self.car.posterior, 20 * self.settings.windows
        particles = len(posterior.parameters)
        chosen = torch.randint(len(self.windows), (count,), generator=generator).to(self.inputs.device)
        with torch.no_grad():
            layers = posterior.network.split(posterior.parameters)
            paths = self._paths(_Functions.of(posterior, layers), chosen.expand(particles, -1))
        error = paths.mean(dim=0) - self.windows.motion[chosen].to(paths)
        unit = STD_OVER_MAD * error.abs().median(dim=0).values
        return torch.maximum(unit, MIN_UNIT_SHARE * unit[-1]).clamp_min(1e-6)

    def gradient(
        self, parameters: Tensor, chosen: Tensor, batch: Tensor, unit: Tensor, generator: torch.Generator
    ) -> Tensor:
        """Clipped gradient (L, P) of each particle's loss.

        Args:
            parameters: (L, P).
            chosen: indices of windows (L, n).
            batch: indices of rows (L, m).
            unit: of the errors of rollouts (K, 6).
            generator: of the inputs at which functions are compared.
        """
        # Leaves by layer: views of one tensor would each have a gradient of its full size in every step.
        network = self.car.posterior.network
        layers = [(w.detach().requires_grad_(), b.detach().requires_grad_()) for w, b in network.split(parameters)]
        functions = _Functions.of(self.car.posterior, layers)
        loss = self._rollout_loss(functions, chosen, unit)
        loss = loss + self.settings.one_step_weight * self._one_step_loss(functions, batch)
        loss = loss + self.settings.anchor_weight * self._anchor_loss(functions, chosen, generator)
        parts = torch.autograd.grad(loss, [leaf for layer in layers for leaf in layer])
        gradient = torch.cat([part.flatten(1) for part in parts], dim=1)
        norm: Tensor = torch.linalg.vector_norm(gradient, dim=1, keepdim=True)
        return gradient * (MAX_GRADIENT / norm.clamp_min(MAX_GRADIENT))

    def _rollout_loss(self, functions: _Functions, chosen: Tensor, unit: Tensor) -> Tensor:
        """Sum over particles of the loss of their rollouts over windows (L, n)."""
        error = self._paths(functions, chosen) - self.windows.motion[chosen].float()
        return _huber(error / unit, ROLLOUT_HUBER).mean(dim=(1, 2, 3)).sum()

    def _one_step_loss(self, functions: _Functions, batch: Tensor) -> Tensor:
        """Sum over particles of the loss of their steps at rows (L, m)."""
        posterior = self.car.posterior
        particle = torch.arange(len(batch), device=batch.device)[:, None]
        error = (functions.normalised(self.inputs[batch]) - self.outputs[particle, batch]) / posterior.noise_std
        return _huber(error, ONE_STEP_HUBER).mean(dim=(1, 2)).sum()

    def _anchor_loss(self, functions: _Functions, chosen: Tensor, generator: torch.Generator) -> Tensor:
        """Sum over particles of the squared distance from their functions before, around the starts of windows."""
        posterior, inputs = self.car.posterior, self.windows.inputs[chosen]
        offset = ANCHOR_DISTANCE * torch.randn(inputs.shape, generator=generator)
        clipped = posterior.clipped_inputs(inputs + offset.to(inputs) * posterior.normaliser.input_std)
        with torch.no_grad():
            before = posterior.without_simulator(clipped)
        return ((functions.normalised(clipped) - before) ** 2).mean(dim=(1, 2)).sum()

    def _paths(self, functions: _Functions, chosen: Tensor) -> Tensor:
        """Paths (L, n, K, 6) of each particle over its windows (L, n)."""
        particles, count = chosen.shape

        def change(inputs: Tensor, step: int) -> Tensor:
            by_particle = inputs.view(particles, count, -1)
            changes = functions.raw(self.car.posterior.clipped_inputs(by_particle))
            if self.simulated is not None:
                changes = changes + self.simulated(chosen, step, by_particle[..., :3])
            return changes.flatten(0, 1)

        paths = roll_out(self.windows.take(chosen.flatten()), change)
        return paths.view(particles, count, *paths.shape[1:])


@dataclass(frozen=True, slots=True)
class _Functions:
    """The networks and the trend of L particles with other parameters.

    Attributes:
        posterior: units and trend.
        layers: weights and biases.
        raw_layers: the same with raw outputs.
        raw_slopes: of the trend in raw outputs (D, 6).
    """

    posterior: ParticlePosterior
    layers: Layers
    raw_layers: Layers
    raw_slopes: Tensor

    @classmethod
    def of(cls, posterior: ParticlePosterior, layers: Layers) -> _Functions:
        """Functions with the given layers."""
        *hidden, head = layers
        weights, biases, slopes = with_raw_outputs(posterior, *head)
        return cls(posterior, layers, [*hidden, (weights, biases)], slopes)

    def normalised(self, clipped: Tensor) -> Tensor:
        """Normalised outputs (L, n, 6) at clipped inputs of each particle (L, n, D)."""
        values, trend = self.posterior.network.through(self.layers, clipped)[0], self.posterior.trend
        return values if trend is None else values + trend[0] + clipped @ trend[1:]

    def raw(self, clipped: Tensor) -> Tensor:
        """Raw outputs (L, n, 6) at clipped inputs of each particle (L, n, D)."""
        return self.posterior.network.through(self.raw_layers, clipped)[0] + clipped @ self.raw_slopes


def _huber(error: Tensor, delta: float) -> Tensor:
    """Huber loss of each element (Huber 1964, "Robust estimation of a location parameter")."""
    return functional.huber_loss(error, torch.zeros_like(error), reduction="none", delta=delta)
