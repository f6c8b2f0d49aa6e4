"""Pendulum with drag, dry friction and motor lag, as described in the Sim-FSVGD paper.

Rothfuss et al. (arXiv 2403.16644, section 6.1) exclude drag, friction and motor dynamics from the prior. Their public
code has neither dry friction nor a motor, and its drag accelerates a pendulum with a negative rate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from learning.priors.domain_models import Range, uniform, within

SLIDING_RADPS = 0.1
"""Rate scale of dry friction, in which ``tanh(rate / 0.1)`` replaces the sign."""


@dataclass(frozen=True, slots=True)
class MotorPendulum:
    """Change of (sin, cos, rate) over 50 ms, the angle being zero upright.

    ``theta'' = (g/l) sin theta + (torque - dry sign(rate)) / (m l^2) - nu rate / (m l) - drag / m rate |rate|`` with
    ``torque' = (command - torque) / lag``; without lag the torque is the command. Drag, friction and their units are
    those of ``Pendulum``, except that drag always brakes. Integration by Runge-Kutta steps of 5 ms, with the torque in
    closed form.

    The torque is a hidden state. A row holds the past command instead, which equals the torque at the start of the
    step; the true system is then a function of the row.

    Attributes:
        masses, lengths, gravities: ranges of m [kg], l [m], g [m/s2].
        frictions, drags, dry: ranges of nu, drag and the dry friction's torque [N m].
        lags: range of the motor's time constant [s].
        rate_discrepancy: standard deviations of the coefficients of rate [1/s], rate |rate| and rate^2 [1] and
            sign(rate) [rad/s2] in a missing angular acceleration.
        command_discrepancy: standard deviation of the shares of command and past command [1] in a missing torque. Both
            are discrepancy processes inside the dynamics.
    """

    size: ClassVar[int] = 13
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
        """Sine, cosine of angles in [-pi, pi], rates within 5 rad/s, past and new command within 2.5 N m: (N, 5)."""
        spans = (math.pi, 5.0, 2.5, 2.5)
        drawn = uniform(tuple((-v, v) for v in spans), count, generator)
        return torch.cat([torch.sin(drawn[:, :1]), torch.cos(drawn[:, :1]), drawn[:, 1:]], dim=1)

    def parameters(self, normal: Tensor) -> Tensor:
        """m, l, g, nu, drag, dry, lag; coefficients of rate, rate |rate|, rate^2, sign, command, past command.

        Parameters (P, 13) for standard normal draws (P, 13).
        """
        ranges = (self.masses, self.lengths, self.gravities, self.frictions, self.drags, self.dry, self.lags)
        known = within(ranges, torch.special.ndtr(normal[:, :7]))
        sizes = torch.tensor([*self.rate_discrepancy, self.command_discrepancy, self.command_discrepancy]).to(normal)
        return torch.cat([known, normal[:, 7:] * sizes], dim=1)

    def __call__(self, inputs: Tensor, parameters: Tensor) -> Tensor:
        """Changes (P, N, 3) of sine, cosine and rate [rad/s] at inputs (N, 5) for parameters (P, 13)."""
        mass, length, gravity, friction, drag, dry, lag, *discrepancy = (
            parameters[:, k, None] for k in range(self.size)
        )
        linear, odd, even, sliding, of_command, of_past = discrepancy
        past, command = inputs[None, :, 3], inputs[None, :, 4]
        inertia = mass * length**2
        constant = (command + of_command * command + of_past * past) / inertia
        initial_lag = (past - command) / inertia
        viscous, quadratic = linear - friction / (mass * length), odd - drag / mass
        gravity_rate, dry_friction = gravity / length, sliding - dry / inertia

        def rates(time_s: float, theta: Tensor, omega: Tensor) -> tuple[Tensor, Tensor]:
            decay = torch.where(lag > 0.0, torch.exp(-time_s / lag.clamp_min(1e-9)), 0.0)
            of_rate = (viscous + quadratic * omega.abs() + even * omega) * omega
            of_rate = of_rate + dry_friction * torch.tanh(omega / SLIDING_RADPS)
            return omega, gravity_rate * torch.sin(theta) + constant + initial_lag * decay + of_rate

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
