"""Windows of a recorded drive for learned cars, and rollouts over them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from carlab.core.planar import to_world


@dataclass(frozen=True, slots=True)
class DriveWindows:
    """S windows of a drive, each in the frame of its initial pose.

    Attributes:
        velocities: vx, vy [m/s] and yaw rate [rad/s] at the start (S, 3).
        past_commands: (S, H, 2) before the start.
        commands: (S, K, 2).
        motion: measured states (S, K, 6) after each step: x ahead and y left of the initial pose, yaw relative to it,
            and the body velocities.
        period_s: period of the steps.
    """

    velocities: Tensor
    past_commands: Tensor
    commands: Tensor
    motion: Tensor
    period_s: float

    def __len__(self) -> int:
        return len(self.velocities)

    @property
    def inputs(self) -> Tensor:
        """Inputs (S, 3 + 2 (H + 1)) of the first step."""
        commands = torch.cat([self.past_commands, self.commands[:, :1]], dim=1)
        return torch.cat([self.velocities, commands.flatten(1)], dim=1).float()

    def take(self, rows: Tensor) -> DriveWindows:
        """Windows by index (N,), with repetitions if indices repeat."""
        velocities, past, commands, motion = (
            v[rows] for v in (self.velocities, self.past_commands, self.commands, self.motion)
        )
        return DriveWindows(velocities, past, commands, motion, self.period_s)

    def to(self, device: torch.device | str) -> DriveWindows:
        """Copy on a device."""
        velocities, past, commands, motion = (
            v.to(device) for v in (self.velocities, self.past_commands, self.commands, self.motion)
        )
        return DriveWindows(velocities, past, commands, motion, self.period_s)


def roll_out(windows: DriveWindows, change: Callable[[Tensor, int], Tensor]) -> Tensor:
    """Roll a car out over windows. Gradients with respect to ``change`` are exact.

    Only velocities and commands are inputs of a step, so poses are integrated after all steps.

    Args:
        windows: S windows.
        change: changes (S, 6) in the body frame, in the order of ``transitions.OUTPUTS``, from inputs
            (S, 3 + 2 (H + 1)) and the number of the step.

    Returns:
        States (S, K, 6) after each step, in the frame of the initial pose; yaw is continuous.
    """
    start = windows.velocities.float()
    commands = torch.cat([windows.past_commands, windows.commands], dim=1).float()
    history = windows.past_commands.shape[1]
    velocities, changes = start, []
    for k in range(windows.commands.shape[1]):
        inputs = torch.cat([velocities, commands[:, k : k + history + 1].flatten(1)], dim=1)
        changes.append(change(inputs, k))
        velocities = velocities + changes[-1][:, 3:]
    ahead, left, turn, *_ = torch.stack(changes, dim=-1).unbind(dim=1)
    yaw = turn.cumsum(dim=1)
    x, y = (v.cumsum(dim=1) for v in to_world(ahead, left, yaw - turn))
    gained = torch.stack(changes, dim=1)[..., 3:].cumsum(dim=1)
    return torch.cat([torch.stack([x, y, yaw], dim=-1), start[:, None] + gained], dim=-1)
