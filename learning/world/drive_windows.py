"""Windows of a recorded drive for learned cars, and rollouts over them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from carlab.core.observation import decode_state, encode
from learning.world.car_dynamics import advance, inputs_of


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
    def features(self) -> Tensor:
        """Features (S, 7 + 2 H) at the start, at the origin."""
        encoded: Tensor = encode(
            torch.cat([torch.zeros_like(self.velocities), self.velocities], dim=1), self.past_commands
        )
        return encoded

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

    Args:
        windows: S windows.
        change: changes (S, 6) in the body frame, in the order of ``transitions.OUTPUTS``, from inputs
            (S, 3 + 2 (H + 1)) and the number of the step.

    Returns:
        States (S, K, 6) after each step, in the frame of the initial pose; yaw is continuous.
    """
    features = windows.features.float()
    yaw, states = torch.zeros(len(windows), device=features.device), []
    for k in range(windows.commands.shape[1]):
        action = windows.commands[:, k].float()
        step = change(inputs_of(features, action), k)
        features, yaw = advance(features, action, step), yaw + step[:, 2]
        state = decode_state(features)
        states.append(torch.cat([state[:, :2], yaw[:, None], state[:, 3:]], dim=1))
    return torch.stack(states, dim=1)


__all__ = ["DriveWindows", "roll_out"]
