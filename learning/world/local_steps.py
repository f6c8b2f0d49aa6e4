"""Polynomials of a simulator's step in the velocities, around the recorded velocities of windows.

A window has recorded commands, so only the velocities of a rollout deviate from the recorded ones. For each recorded
row a polynomial of third degree is fitted to steps of the simulator by least squares; at the recorded velocities it is
exact. It is differentiable, and a fit to rollouts evaluates it many times for each row.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import torch
from torch import Tensor

from learning.posterior.particle_posterior import ParticleSimulator
from learning.world.drive_windows import DriveWindows

DEVIATION_UNITS = (0.3, 0.25, 1.0)
"""Units of the deviations of vx, vy [m/s] and yaw rate [rad/s]: typical errors after one second."""
MAX_DEVIATION = 2.0
"""Bound of each deviation in these units."""
DESIGN_RADIUS = 1.7
"""Radius of the ball of the simulated deviations, in these units."""
DESIGN_POINTS = 40
"""Simulated deviations of each row; a polynomial has 20 coefficients."""
ROWS_AT_ONCE = 2000
"""Recorded rows whose deviations are simulated in one batch, which bounds the memory."""


@dataclass(frozen=True, slots=True)
class LocalSteps:
    """Steps of L particles at S windows of K steps.

    Attributes:
        velocities: recorded velocities of U rows (U, 3).
        row: index of the row of each step of each window (S, K).
        coefficients: of the steps of the P different draws of the parameters (P, U, 20, 6).
        draw: index of the draw of each particle (L,).
    """

    velocities: Tensor
    row: Tensor
    coefficients: Tensor
    draw: Tensor

    @classmethod
    def of(cls, simulator: ParticleSimulator, windows: DriveWindows) -> LocalSteps:
        """Simulate deviations from each recorded row of the windows, and fit the polynomials."""
        device = windows.velocities.device
        rows, row = torch.unique(_rows(windows), dim=0, return_inverse=True)
        parameters, draw = simulator.parameters, torch.zeros(len(simulator.parameters), dtype=torch.long, device=device)
        if parameters.shape[1]:
            parameters, draw = torch.unique(parameters, dim=0, return_inverse=True)
        one_of_each = ParticleSimulator(simulator.model, parameters[: int(draw.max()) + 1])
        deviations = _design().to(device)
        to_slopes = torch.linalg.pinv(monomials(deviations)[1:, 1:].double())
        offsets = torch.zeros((len(deviations), 1, rows.shape[1]), device=device)
        offsets[:, 0, :3] = deviations * torch.tensor(DEVIATION_UNITS, device=device)
        parts = []
        for part in rows.split(ROWS_AT_ONCE):
            steps = one_of_each((part + offsets).flatten(0, 1))
            steps = steps.view(len(steps), len(deviations), len(part), -1)
            slopes = torch.einsum("cm,pmuo->puco", to_slopes, (steps[:, 1:] - steps[:, :1]).double()).float()
            parts.append(torch.cat([steps[:, 0, :, None], slopes], dim=2))
        return cls(rows[:, :3], row.view(len(windows), -1), torch.cat(parts, dim=1), draw)

    def __call__(self, windows: Tensor, step: int, velocities: Tensor) -> Tensor:
        """Raw outputs (L, n, 6) of each particle's simulator, differentiable in the velocities.

        Args:
            windows: indices of each particle's windows (L, n).
            step: number of the step.
            velocities: vx, vy [m/s] and yaw rate [rad/s] at its start (L, n, 3).
        """
        row = self.row[windows, step]
        deviation = (velocities - self.velocities[row]) / torch.tensor(DEVIATION_UNITS).to(velocities)
        terms = monomials(deviation.clamp(-MAX_DEVIATION, MAX_DEVIATION))
        return (terms[..., None, :] @ self.coefficients[self.draw[:, None], row]).squeeze(-2)


def monomials(deviation: Tensor) -> Tensor:
    """Monomials (..., 20) up to the third degree of deviations (..., 3)."""
    squares, cubes = ([list(c) for c in zip(*_combinations(degree), strict=True)] for degree in (2, 3))
    parts = [torch.ones_like(deviation[..., :1]), deviation]
    parts.append(deviation[..., squares[0]] * deviation[..., squares[1]])
    parts.append(deviation[..., cubes[0]] * deviation[..., cubes[1]] * deviation[..., cubes[2]])
    return torch.cat(parts, dim=-1)


def _combinations(degree: int) -> list[tuple[int, ...]]:
    """Channels of the monomials of a degree."""
    return list(itertools.combinations_with_replacement(range(3), degree))


def _design() -> Tensor:
    """Deviations (``DESIGN_POINTS``, 3) in a ball, the first one zero."""
    generator = torch.Generator().manual_seed(0)
    direction = torch.nn.functional.normalize(torch.randn((DESIGN_POINTS, 3), generator=generator), dim=1)
    deviations = DESIGN_RADIUS * torch.rand((DESIGN_POINTS, 1), generator=generator).sqrt() * direction
    deviations[0] = 0.0
    return deviations


def _rows(windows: DriveWindows) -> Tensor:
    """Inputs (S K, 3 + 2 (H + 1)) of all steps of windows at their recorded velocities."""
    velocities = torch.cat([windows.velocities[:, None], windows.motion[:, :-1, 3:]], dim=1).float()
    commands = torch.cat([windows.past_commands, windows.commands], dim=1).float()
    length = windows.past_commands.shape[1] + 1
    past = commands.unfold(1, length, 1).transpose(2, 3).flatten(2)
    return torch.cat([velocities, past], dim=2).flatten(0, 1)
