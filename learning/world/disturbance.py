"""A learned car with a disturbance that lasts: rollouts whose errors are correlated in time.

In each rollout one particle moves the car (epistemic uncertainty), and a disturbance acts on it (aleatoric
uncertainty). The disturbance consists of accelerations along the body axes and about the vertical axis. Each is an
Ornstein-Uhlenbeck process (Uhlenbeck and Ornstein 1930), in discrete time an AR(1) process. One random factor
multiplies the disturbance of a rollout, so that its distribution over rollouts is Student-t (a scale mixture of
Gaussians). The noise of the one-step likelihood is measurement noise: it is added to predicted measurements and does
not move the car.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from learning.outliers import tail_scales
from learning.posterior.sampler import Assignment
from learning.world.car_dynamics import CarDynamics, advance, inputs_of

CHANNELS = ("ahead_mps2", "left_mps2", "yaw_radps2")
"""Accelerations of the disturbance."""
TAIL_COMPONENTS = 8
"""Gaussians of the scale mixture that approximates a Student-t distribution; their scales are bounded."""


@dataclass(frozen=True, slots=True)
class DisturbanceProcess:
    """Stationary disturbance of a car, independent by channel.

    Attributes:
        scale: of each acceleration in ``CHANNELS``; the standard deviation for infinite ``dof`` [m/s2, m/s2, rad/s2].
        correlation_s: time after which the autocorrelation is 1 / e, by channel [s].
        period_s: period of the steps.
        dof: degrees of freedom of the Student-t distribution over rollouts; infinite for a Gaussian.
    """

    scale: tuple[float, float, float]
    correlation_s: tuple[float, float, float]
    period_s: float
    dof: float = math.inf

    @property
    def autoregression(self) -> Tensor:
        """Autocorrelation (3,) after one step."""
        return torch.exp(-self.period_s / torch.tensor(self.correlation_s, dtype=torch.float64)).float()

    def initial(self, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Gaussian disturbances (N, 3) of unit variance at the start, and a factor for each rollout (N, 1)."""
        unit = torch.randn((count, 3), generator=generator)
        which = torch.randint(TAIL_COMPONENTS, (count,), generator=generator)
        return unit, tail_scales(self.dof, TAIL_COMPONENTS)[which, None]

    def next(self, unit: Tensor, generator: torch.Generator) -> Tensor:
        """Gaussian disturbances (N, 3) of unit variance one step later."""
        rho = self.autoregression.to(unit)
        noise = torch.randn(unit.shape, generator=generator).to(unit)
        return rho * unit + (1.0 - rho**2).sqrt() * noise


def change_by(acceleration: Tensor, period_s: float) -> Tensor:
    """Changes (N, 6) over a step, in the order of ``transitions.OUTPUTS``, by accelerations (N, 3) in ``CHANNELS``."""
    return torch.cat([0.5 * period_s**2 * acceleration, period_s * acceleration], dim=1)


@dataclass(frozen=True, slots=True)
class DisturbedCar:
    """A learned car and the disturbance of its rollouts.

    Attributes:
        car: particles and noise of the one-step likelihood.
        process: the disturbance.
    """

    car: CarDynamics
    process: DisturbanceProcess

    @property
    def history(self) -> int:
        """H, number of commands before the last one in a row of inputs."""
        return self.car.history

    def rollouts(self, count: int, generator: torch.Generator) -> DisturbedRollouts:
        """Start N rollouts."""
        return DisturbedRollouts(self, count, generator)


class DisturbedRollouts:
    """Rollouts of a disturbed car: each has one particle and one path of the disturbance."""

    def __init__(self, model: DisturbedCar, count: int, generator: torch.Generator) -> None:
        self._model, self._sampler = model, model.car.sampler
        particles = len(self._sampler.parameters)
        self._assignment = Assignment.random(count, particles, generator, spare=1)
        self._unit, self._tail_factor = model.process.initial(count, generator)
        self._scale = torch.tensor(model.process.scale)

    def step(self, features: Tensor, action: Tensor, generator: torch.Generator) -> Tensor:
        """Features (N, 7 + 2 H) one step after ``action`` (N, 2)."""
        process = self._model.process
        change = self._sampler.without_noise(inputs_of(features, action), self._assignment)
        acceleration = self._scale * self._tail_factor * self._unit
        change = change + change_by(acceleration, process.period_s).to(change)
        self._unit = process.next(self._unit, generator)
        return advance(features, action, change)

    def restart(self, rows: Tensor, generator: torch.Generator) -> None:
        """Start other rollouts in place of those with indices ``rows`` (M,)."""
        self._assignment = self._assignment.reassigned(rows, len(self._sampler.parameters), generator)
        self._unit[rows], self._tail_factor[rows] = self._model.process.initial(len(rows), generator)

    def measurement_noise(self, generator: torch.Generator) -> Tensor | None:
        """Noise (N, 6) of the one-step likelihood, in the order of ``transitions.OUTPUTS``."""
        return self._sampler.noise_samples(len(self._unit), generator)
