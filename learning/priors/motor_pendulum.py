"""Pendulum with drag, dry friction and motor lag, as the Sim-FSVGD paper describes its own.

Rothfuss et al. (arXiv 2403.16644, section 6.1) hide drag, friction and motor dynamics from the prior. Their public code
has neither dry friction nor a motor, and its drag accelerates a pendulum that turns backwards.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from learning.priors.domain_models import Range, uniform, within

SLIDING_RADPS = 0.1
"""Rate at which dry friction has three quarters of its size: ``tanh(rate / 0.1)`` in place of the sign."""


@dataclass(frozen=True, slots=True)
class MotorPendulum:
    """Change of (sin, cos, rate) over 50 ms, the angle being zero upright.

    ``theta'' = (g/l) sin theta + (torque - dry sign(rate)) / (m l^2) - nu rate / (m l) - drag / m rate |rate|`` with
    ``torque' = (command - torque) / lag``; without lag the torque is the command. Drag, friction and their units are
    those of ``Pendulum``, except that drag always brakes. Runge-Kutta steps of 5 ms, the torque in closed form.

    The torque is a hidden state. A row holds the past command in its place, which the torque has reached when the step
    begins; with it the true system is a function of the row.

    Attributes:
        masses, lengths, gravities: ranges of m [kg], l [m], g [m/s2].
        frictions, drags, dry: ranges of nu, drag and the dry friction's torque [N m].
        lags: range of the motor's time constant [s].
        rate_gap: standard deviations of the coefficients of rate [1/s], rate |rate| and rate^2 [1] and sign(rate)
            [rad/s2] in a missing angular acceleration.
        command_gap: standard deviation of the shares of command and past command [1] in a missing torque. Both make a
            discrepancy process inside the dynamics.
    """

    masses: Range = (0.5, 1.5)
    lengths: Range = (0.5, 1.5)
    gravities: Range = (5.0, 15.0)
    frictions: Range = (0.0, 0.0)
    drags: Range = (0.0, 0.0)
    dry: Range = (0.0, 0.0)
    lags: Range = (0.0, 0.0)
    rate_discrepancy: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    command_discrepancy: float = 0.0
    period_s: float = 0.05
    substeps: int = 10

    def inputs(self, count: int, generator: torch.Generator) -> Tensor:
        """Sine, cosine of angles all around, rates within 5 rad/s, past and present command within 2.5 N m: (N, 5)."""
        spans = (math.pi, 5.0, 2.5, 2.5)
        drawn = uniform(tuple((-v, v) for v in spans), count, generator)
        return torch.cat([torch.sin(drawn[:, :1]), torch.cos(drawn[:, :1]), drawn[:, 1:]], dim=1)

    @property
    def size(self) -> int:
        """Seven, and six coefficients of the discrepancy."""
        return 13

    def parameters(self, normal: Tensor) -> Tensor:
        """(m, l, g, nu, drag, dry, lag; coefficients of rate, rate |rate|, rate^2, sign, command, past command)."""
        ranges = (self.masses, self.lengths, self.gravities, self.frictions, self.drags, self.dry, self.lags)
        known = within(ranges, torch.special.ndtr(normal[:, :7]))
        sizes = torch.tensor([*self.rate_discrepancy, self.command_discrepancy, self.command_discrepancy]).to(normal)
        return torch.cat([known, normal[:, 7:] * sizes], dim=1)

    def __call__(self, inputs: Tensor, parameters: Tensor) -> Tensor:
        """Changes (P, N, 3)."""
        mass, length, gravity, friction, drag, dry, lag, *discrepancy = (
            parameters[:, k, None] for k in range(self.size)
        )
        linear, odd, even, sliding, of_command, of_past = discrepancy
        past, command = inputs[None, :, 3], inputs[None, :, 4]
        inertia = mass * length**2
        constant = (command + of_command * command + of_past * past) / inertia
        late = (past - command) / inertia
        viscous, quadratic = linear - friction / (mass * length), odd - drag / mass
        pull, rubbing = gravity / length, sliding - dry / inertia

        def rates(time_s: float, theta: Tensor, omega: Tensor) -> tuple[Tensor, Tensor]:
            behind = torch.where(lag > 0.0, torch.exp(-time_s / lag.clamp_min(1e-9)), 0.0)
            of_rate = (viscous + quadratic * omega.abs() + even * omega) * omega
            of_rate = of_rate + rubbing * torch.tanh(omega / SLIDING_RADPS)
            return omega, pull * torch.sin(theta) + constant + late * behind + of_rate

        step = self.period_s / self.substeps
        theta = torch.atan2(inputs[:, 0], inputs[:, 1])[None].expand(len(parameters), -1)
        omega = inputs[None, :, 2].expand_as(theta)
        for k in range(self.substeps):
            t = k * step
            a = rates(t, theta, omega)
            b = rates(t + 0.5 * step, theta + 0.5 * step * a[0], omega + 0.5 * step * a[1])
            c = rates(t + 0.5 * step, theta + 0.5 * step * b[0], omega + 0.5 * step * b[1])
            d = rates(t + step, theta + step * c[0], omega + step * c[1])
            theta = theta + step / 6.0 * (a[0] + 2.0 * (b[0] + c[0]) + d[0])
            omega = omega + step / 6.0 * (a[1] + 2.0 * (b[1] + c[1]) + d[1])
        after = torch.stack([torch.sin(theta), torch.cos(theta), omega], dim=-1)
        return after - inputs[None, :, :3]


__all__ = ["SLIDING_RADPS", "MotorPendulum"]
