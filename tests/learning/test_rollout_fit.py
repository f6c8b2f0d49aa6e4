"""Fit to rollouts, on a linear car whose rollouts have a closed form; the drives are computed by NumPy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from decaying_car import DECAY, PERIOD_S, STEPS, decaying_car, driven_windows

from carlab.core.errors import DataError
from learning.transitions import Transitions
from learning.world.disturbance import DisturbanceProcess
from learning.world.drive_windows import DriveWindows, roll_out
from learning.world.rollout_fit import RolloutFitSettings, fit_rollouts

OFFSET, NOISE = 0.01, 0.05
"""Error of the learned change of vx in a step, and noise of one step: five times larger [m/s]."""
QUICK = RolloutFitSettings(updates=80, windows=8, rows=64)
ROLLOUTS_ONLY = replace(QUICK, one_step_weight=0.0)
SHORT = 15
"""Steps of a window in the fits."""


def driven(count: int = 200, disturbance: float = 0.1, offset: float = 0.0) -> DriveWindows:
    """Windows of the decaying car, with a small disturbance [m/s2, m/s2, rad/s2]."""
    return driven_windows(DisturbanceProcess((disturbance,) * 3, (0.1,) * 3, PERIOD_S), count, offset=offset)


def noisy_rows(count: int = 500) -> Transitions:
    """Steps of the decaying car with noise."""
    rng = np.random.default_rng(2)
    velocity = rng.normal(size=(count, 3)) * [1.0, 0.2, 0.5]
    targets = np.hstack([PERIOD_S * velocity, -DECAY * velocity]) + NOISE * rng.normal(size=(count, 6))
    inputs = np.hstack([velocity, np.zeros((count, 2))])
    return Transitions(inputs, targets, np.zeros(count, int), np.arange(count), 0)


def learned_change(offset: torch.Tensor, windows: DriveWindows, settings: RolloutFitSettings) -> torch.Tensor:
    """Change of vx (L,) in a step from rest by particles that were fitted to rollouts."""
    short = replace(windows, commands=windows.commands[:, :SHORT], motion=windows.motion[:, :SHORT])
    car = fit_rollouts(decaying_car(offset, NOISE), short, noisy_rows(), settings)
    rest = torch.zeros(1, 5)
    return car.posterior.normaliser.raw_outputs(car.posterior.values(rest))[:, 0, 3]


def test_rollout_of_the_linear_car_has_the_closed_form() -> None:
    """Of its value after every step, and of its derivative with respect to an offset."""
    windows = driven(5, disturbance=1e-6)
    offset = torch.zeros(1, requires_grad=True)

    def change(inputs: torch.Tensor, step: int) -> torch.Tensor:
        velocities = inputs[:, :3]
        constant = torch.cat([torch.zeros(3), offset, torch.zeros(2)])
        return torch.cat([PERIOD_S * velocities, -DECAY * velocities], dim=1) + constant

    paths = roll_out(windows, change)
    steps = torch.arange(1, STEPS + 1)
    expected = windows.velocities[:, None, 0] * (1.0 - DECAY) ** steps
    torch.testing.assert_close(paths[..., 3].detach(), expected, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(paths.detach(), windows.motion, rtol=1e-3, atol=1e-4)
    (slope,) = torch.autograd.grad(paths[:, -1, 3].sum(), offset)
    assert float(slope) == pytest.approx(len(windows) * (1.0 - (1.0 - DECAY) ** STEPS) / DECAY, rel=1e-4)


def test_error_that_is_small_in_a_step_is_removed() -> None:
    """The offset is a fifth of the noise of a step, and 0.11 m/s after half a second."""
    change = learned_change(torch.full((4,), OFFSET), driven(), ROLLOUTS_ONLY)
    assert float(change.abs().max()) < 0.15 * OFFSET


def test_collisions_have_little_influence() -> None:
    """In a twentieth of the windows the car is stopped; a mean over the windows would move by 0.05 times 0.5 m/s."""
    windows = driven()
    motion = windows.motion.clone()
    motion[::20, 10:, 3] -= 0.5
    change = learned_change(torch.full((4,), OFFSET), replace(windows, motion=motion), ROLLOUTS_ONLY)
    assert float(change.abs().max()) < 0.3 * OFFSET


def test_a_large_anchor_keeps_the_functions() -> None:
    change = learned_change(torch.full((2,), OFFSET), driven(), replace(QUICK, anchor_weight=1e6, updates=50))
    assert change.tolist() == pytest.approx([OFFSET] * 2, rel=0.05)


def test_particles_differ_where_windows_disagree() -> None:
    """Two kinds of windows ask for opposite offsets: random weights give each particle another compromise."""
    faster, slower = driven(20, offset=OFFSET), driven(20, offset=-OFFSET)
    both = DriveWindows(
        *(torch.cat([getattr(w, name) for w in (faster, slower)])
          for name in ("velocities", "past_commands", "commands", "motion")), PERIOD_S,
    )  # fmt: skip
    spread = float(learned_change(torch.zeros(12), both, ROLLOUTS_ONLY).std())
    same = float(learned_change(torch.full((12,), OFFSET), faster, ROLLOUTS_ONLY).std())
    assert spread > 3.0 * same


def test_invalid_data_is_refused_with_a_remedy() -> None:
    car, windows, rows = decaying_car(torch.zeros(2)), driven(3), noisy_rows(5)
    with pytest.raises(DataError, match="needs a window in which the car moves; record a longer drive"):
        fit_rollouts(car, windows.take(torch.zeros(0, dtype=torch.int64)), rows)
    with pytest.raises(DataError, match="1 past commands, the car 0; use the same number"):
        fit_rollouts(car, windows, replace(rows, history=1))
