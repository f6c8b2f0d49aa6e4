"""Simulators with unknown parameters, as priors over functions: the studies of the Sim-FSVGD paper.

Each maps inputs (N, D) and P parameter draws to outputs (P, N, O). Ranges, domains and step sizes are those of
the authors' public code (lasgroup/simulation_transfer, commit 547fa14, MIT).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol

import torch
from torch import Tensor

from carlab.core.planar import to_body, to_world

Range = tuple[float, float]
MAX_PLAUSIBLE_OUTPUT = 1e6
"""Bound of plausible outputs, in normalised units or in SI units of a car; larger outputs are numerical failures."""
NO_FINITE_OUTPUT = (
    "The simulator gives no finite outputs for this data; narrow the ranges of its parameters or use another simulator."
)


class DomainModel(Protocol):
    """A simulator with a distribution of its parameters."""

    @property
    def size(self) -> int:
        """K, the number of parameters."""
        ...

    def inputs(self, count: int, generator: torch.Generator) -> Tensor:
        """Inputs (N, D), drawn from the domain."""
        ...

    def parameters(self, normal: Tensor) -> Tensor:
        """Map of standard normal draws (P, K) to draws of the prior parameters (P, K)."""
        ...

    def __call__(self, inputs: Tensor, parameters: Tensor) -> Tensor:
        """Outputs (P, N, O) at inputs (N, D) for parameters (P, K)."""
        ...


def draw_parameters(model: DomainModel, count: int, generator: torch.Generator) -> Tensor:
    """Parameters (count, K) from the distribution of a model."""
    return model.parameters(torch.randn((count, model.size), generator=generator))


def within(ranges: Sequence[Range], shares: Tensor) -> Tensor:
    """Values (..., K) at shares (..., K) of ranges: 0 is the lower end, 1 the upper end."""
    low = torch.tensor([r[0] for r in ranges]).to(shares)
    high = torch.tensor([r[1] for r in ranges]).to(shares)
    return low + (high - low) * shares


def uniform(ranges: Sequence[Range], count: int, generator: torch.Generator) -> Tensor:
    """Draws (count, K), uniform in each range."""
    return within(ranges, torch.rand((count, len(ranges)), generator=generator))


@dataclass(frozen=True, slots=True)
class Sinusoids:
    """``a sin(w x) + b x`` with a ~ N(2, 0.4^2), w ~ U(1.7, 2.3), b ~ N(2, 1), for x in [-5, 5]."""

    size: ClassVar[int] = 3

    def inputs(self, count: int, generator: torch.Generator) -> Tensor:
        """Values of x (N, 1)."""
        return uniform(((-5.0, 5.0),), count, generator)

    def parameters(self, normal: Tensor) -> Tensor:
        """a, w, b (P, 3) for standard normal draws (P, 3)."""
        a, w, b = normal.T
        return torch.stack([2.0 + 0.4 * a, 1.7 + 0.6 * torch.special.ndtr(w), 2.0 + b], dim=1)

    def __call__(self, inputs: Tensor, parameters: Tensor) -> Tensor:
        """Values (P, N, 1) at x (N, 1) for parameters (P, 3)."""
        a, w, b = (parameters[:, k, None] for k in range(3))
        x = inputs[None, :, 0]
        return (a * torch.sin(w * x) + b * x)[:, :, None]


HiddenAcceleration = Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]
"""Missing angular acceleration (P, N) [rad/s2] by angle [rad] and rate [rad/s] (P, N), commanded torque (1, N) [N m],
and inertia (P, 1) [kg m2]."""


def detent(angle: Tensor, rate: Tensor, torque: Tensor, inertia: Tensor) -> Tensor:
    """A detent with three positions a turn: ``4 sin(3 theta)`` rad/s2; shapes as in ``HiddenAcceleration``."""
    return 4.0 * torch.sin(3.0 * angle)


def saturated_torque(angle: Tensor, rate: Tensor, torque: Tensor, inertia: Tensor) -> Tensor:
    """A motor that saturates smoothly at 1 N m: its torque is ``tanh(command)``.

    Shapes as in ``HiddenAcceleration``.
    """
    return (torch.tanh(torque) - torque) / inertia


def position_friction(angle: Tensor, rate: Tensor, torque: Tensor, inertia: Tensor) -> Tensor:
    """Viscous friction that depends on the angle: ``(1 + cos theta)`` N m s, zero at the bottom.

    Shapes as in ``HiddenAcceleration``.
    """
    return -(1.0 + torch.cos(angle)) * rate / inertia


@dataclass(frozen=True, slots=True)
class Pendulum:
    """Change of (sin, cos, rate) of a pendulum over 50 ms: ``theta'' = (g/l) sin theta + u / (m l^2) - friction``.

    Explicit Euler in ten substeps, as in the authors' code. Friction is ``nu rate / (m l) + drag / m rate^2`` as in
    their code; its square does not change sign with the rate.

    Attributes:
        masses, lengths, gravities, frictions, drags: ranges of m [kg], l [m], g [m/s2], nu [N s] and drag [kg].
        rate_discrepancy: standard deviations of the coefficients of rate [1/s], rate |rate| and rate^2 [1] in a missing
            angular acceleration: a discrepancy process inside the dynamics, with a polynomial kernel.
        hidden_acceleration: further angular acceleration of a true system; None: zero.
        period_s: duration of a step [s].
        substeps: Euler steps in it.
    """

    size: ClassVar[int] = 8
    masses: Range = (0.5, 1.5)
    lengths: Range = (0.5, 1.5)
    gravities: Range = (5.0, 15.0)
    frictions: Range = (0.0, 0.0)
    drags: Range = (0.0, 0.0)
    rate_discrepancy: tuple[float, float, float] = (0.0, 0.0, 0.0)
    hidden_acceleration: HiddenAcceleration | None = None
    period_s: float = 0.05
    substeps: int = 10

    def inputs(self, count: int, generator: torch.Generator) -> Tensor:
        """Sine and cosine of angles in [-pi, pi], rates within 5 rad/s, torques within 2.5 N m: (N, 4)."""
        drawn = uniform(((-math.pi, math.pi), (-5.0, 5.0), (-2.5, 2.5)), count, generator)
        return torch.cat([torch.sin(drawn[:, :1]), torch.cos(drawn[:, :1]), drawn[:, 1:]], dim=1)

    def parameters(self, normal: Tensor) -> Tensor:
        """m, l, g, nu, drag and three coefficients of the discrepancy (P, 8), for standard normal draws (P, 8)."""
        ranges = (self.masses, self.lengths, self.gravities, self.frictions, self.drags)
        known = within(ranges, torch.special.ndtr(normal[:, :5]))
        return torch.cat([known, normal[:, 5:] * torch.tensor(self.rate_discrepancy).to(normal)], dim=1)

    def __call__(self, inputs: Tensor, parameters: Tensor) -> Tensor:
        """Changes (P, N, 3) of sine, cosine and rate [rad/s] at inputs (N, 4) for parameters (P, 8)."""
        mass, length, gravity, friction, drag, linear, odd, even = (parameters[:, k, None] for k in range(8))
        angle = torch.atan2(inputs[:, 0], inputs[:, 1])[None]
        rate, torque = inputs[None, :, 2], inputs[None, :, 3]
        step, inertia = self.period_s / self.substeps, mass * length**2
        theta, omega = angle.expand(len(parameters), -1), rate.expand(len(parameters), -1)
        for _ in range(self.substeps):
            resistance = friction * omega / (mass * length) + drag / mass * (omega * omega)
            missing = (linear + odd * omega.abs() + even * omega) * omega
            acceleration = gravity / length * torch.sin(theta) + torque / inertia - resistance + missing
            if self.hidden_acceleration is not None:
                acceleration = acceleration + self.hidden_acceleration(theta, omega, torque, inertia)
            theta, omega = theta + step * omega, omega + step * acceleration
        after = torch.stack([torch.sin(theta), torch.cos(theta), omega], dim=-1)
        return after - inputs[None, :, :3]


KINEMATIC_RANGES: tuple[Range, ...] = (
    *((1.6, 1.7), (0.11, 0.15), (0.15, 0.19), (-0.15, 0.15)),
    *((6.0, 10.0), (1.0, 1.8), (0.15, 0.4)),
)
"""Ranges of mass [kg], l_f and l_r (distances of the axles from the centre of mass) [m], angle between body and
measured heading [rad], force at full throttle [N], root of the damping [sqrt(N s/m)], wheel angle at full lock [rad].
"""
KINEMATIC_PERIOD_S, KINEMATIC_SUBSTEPS = 1.0 / 30.0, 3


@dataclass(frozen=True, slots=True)
class KinematicCar:
    """Change over 1/30 s of (x, y, sin yaw, cos yaw, vx, vy in the world, yaw rate) of a car whose wheels do not slip.

    ``beta = atan(l_r tan(d) / L)`` at the centre of mass (Rajamani, "Vehicle Dynamics and Control", section 2.2);
    lateral velocity and yaw rate converge within a step. The body is rotated by an unknown angle relative to the
    measured heading.

    Attributes:
        place_m, speed_mps, rate_radps: half widths of the domain of positions, velocities and yaw rates.
    """

    size: ClassVar[int] = 7
    place_m: float = 2.0
    speed_mps: float = 2.0
    rate_radps: float = 3.0

    def inputs(self, count: int, generator: torch.Generator) -> Tensor:
        """x, y [m], sin, cos of yaw, vx, vy [m/s, world], yaw rate [rad/s], steering, throttle: (N, 9)."""
        spans = (self.place_m, self.place_m, math.pi, self.speed_mps, self.speed_mps, self.rate_radps, 1.0, 1.0)
        drawn = uniform(tuple((-v, v) for v in spans), count, generator)
        yaw = drawn[:, 2:3]
        return torch.cat([drawn[:, :2], torch.sin(yaw), torch.cos(yaw), drawn[:, 3:]], dim=1)

    def parameters(self, normal: Tensor) -> Tensor:
        """m, l_f, l_r, offset, drive gain, root of the damping, steering at full lock (P, 7); normal draws (P, 7)."""
        return within(KINEMATIC_RANGES, torch.special.ndtr(normal))

    def __call__(self, inputs: Tensor, parameters: Tensor) -> Tensor:
        """Changes (P, N, 7) at inputs (N, 9) for parameters (P, 7)."""
        mass, front, rear, offset, drive, damping, lock = (parameters[:, k, None] for k in range(7))
        yaw = torch.atan2(inputs[:, 2], inputs[:, 3])[None] + offset
        throttle = inputs[None, :, 8].clamp(-1.0, 1.0)
        tangent = torch.tan(lock * inputs[None, :, 7].clamp(-1.0, 1.0))
        ahead, left = to_body(inputs[None, :, 4], inputs[None, :, 5], yaw)
        rate = inputs[None, :, 6].expand_as(ahead)
        x, y = (inputs[None, :, k].expand_as(ahead) for k in (0, 1))
        step = KINEMATIC_PERIOD_S / KINEMATIC_SUBSTEPS
        decay = math.exp(-1.0)  # of a deviation from rolling without slip, in one substep
        for _ in range(KINEMATIC_SUBSTEPS):
            next_ahead = ahead + step * (drive * throttle - damping**2 * ahead) / mass
            mean_ahead = 0.5 * (ahead + next_ahead)
            rolling_rate = next_ahead * tangent / (front + rear)
            new_rate = rolling_rate + decay * (rate - rolling_rate)
            new_left = rear * rolling_rate + decay * (left - rear * rolling_rate)
            mid_yaw = yaw + 0.25 * step * (rate + new_rate)
            mean_left = 0.5 * (left + new_left)
            mean_vx, mean_vy = to_world(mean_ahead, mean_left, mid_yaw)
            x, y = x + step * mean_vx, y + step * mean_vy
            yaw = yaw + 0.5 * step * (rate + new_rate)
            ahead, left, rate = next_ahead, new_left, new_rate
        measured_yaw = yaw - offset
        velocity_x, velocity_y = to_world(ahead, left, yaw)
        heading = torch.sin(measured_yaw), torch.cos(measured_yaw)
        after = torch.stack([x, y, *heading, velocity_x, velocity_y, rate], dim=-1)
        return after - inputs[None, :, :7]
