"""Polynomials of simulator steps against the simulator, and the fit to rollouts of particles that correct it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from learning.networks.normaliser import Normaliser
from learning.networks.particles import Network
from learning.posterior.particle_posterior import ParticlePosterior, ParticleSimulator
from learning.priors.simulator_model import CarModel
from learning.transitions import Transitions
from learning.world.car_dynamics import CarDynamics
from learning.world.car_fit import NOISE_STD
from learning.world.drive_windows import DriveWindows, roll_out
from learning.world.local_steps import DEVIATION_UNITS, MAX_DEVIATION, LocalSteps, monomials
from learning.world.rollout_fit import RolloutFitSettings, fit_rollouts
from sim_backends.car_parameters import SimulatorConfig

HISTORY, STEPS, COUNT = 2, 6, 5
MODEL = CarModel(SimulatorConfig(), HISTORY, {"motor.drive_gain": (4.0, 12.0)})
GAINS = torch.tensor([[6.0], [9.0], [6.0]])
WIDTH = 3 + 2 * (HISTORY + 1)
OFFSET_MPS = 0.02
"""Wrong correction of vx in a step."""


def recorded_windows(gain: float = 6.0) -> DriveWindows:
    """Windows of a drive of the simulated car."""
    generator = torch.Generator().manual_seed(0)
    start = torch.tensor([1.5, 0.0, 0.0]) + 0.2 * torch.randn((COUNT, 3), generator=generator)
    commands = 0.5 * torch.randn((COUNT, 1, 2), generator=generator).clamp(-1.0, 1.0)
    past, given = commands.expand(-1, HISTORY, -1), commands.expand(-1, STEPS, -1)
    blank = DriveWindows(start, past, given, torch.zeros(COUNT, STEPS, 6), MODEL.config.control_period_s)
    motion = roll_out(blank, lambda inputs, step: MODEL(inputs, torch.tensor([[gain]]))[0])
    return replace(blank, motion=motion)


def inputs_at(windows: DriveWindows, step: int, velocities: Tensor) -> Tensor:
    """Inputs (S, D) of a step of all windows with other velocities (S, 3)."""
    commands = torch.cat([windows.past_commands, windows.commands], dim=1)
    return torch.cat([velocities, commands[:, step : step + HISTORY + 1].flatten(1)], dim=1)


@pytest.mark.parametrize("step", [0, 4])
def test_steps_are_those_of_each_particles_simulator(step: int) -> None:
    """Exactly at the recorded velocities; within half of the noise of a step at typical errors after a second."""
    windows = recorded_windows()
    local = LocalSteps.of(ParticleSimulator(MODEL, GAINS), windows)
    recorded = windows.velocities if step == 0 else windows.motion[:, step - 1, 3:]
    every = torch.arange(COUNT).expand(len(GAINS), -1)
    for deviation, tolerance in (((0.0, 0.0, 0.0), 1e-3), ((0.2, -0.15, 0.6), 0.5)):
        velocities = recorded + torch.tensor(deviation)
        expected = MODEL(inputs_at(windows, step, velocities), GAINS)
        found = local(every, step, velocities.expand(len(GAINS), -1, -1))
        assert float(((found - expected) / torch.tensor(NOISE_STD)).abs().max()) < tolerance


def test_derivative_is_that_of_the_simulator() -> None:
    """Central differences of the simulator."""
    windows = recorded_windows()
    local = LocalSteps.of(ParticleSimulator(MODEL, GAINS[:1]), windows)
    every, size = torch.arange(COUNT)[None], 0.05

    def slope(channel: int) -> Tensor:
        change = torch.zeros(3)
        change[channel] = size
        high, low = (inputs_at(windows, 0, windows.velocities + sign * change) for sign in (1.0, -1.0))
        return (MODEL(high, GAINS[:1]) - MODEL(low, GAINS[:1]))[0, :, 3 + channel] / (2.0 * size)

    velocities = windows.velocities[None].clone().requires_grad_()
    steps = local(every, 0, velocities)
    for channel in range(3):
        (gradient,) = torch.autograd.grad(steps[..., 3 + channel].sum(), velocities, retain_graph=True)
        torch.testing.assert_close(gradient[0, :, channel], slope(channel), rtol=0.1, atol=0.02)


def test_far_deviations_have_the_steps_of_the_bound() -> None:
    windows = recorded_windows()
    local = LocalSteps.of(ParticleSimulator(MODEL, GAINS[:1]), windows)
    every, bound = torch.arange(COUNT)[None], MAX_DEVIATION * torch.tensor(DEVIATION_UNITS)
    far, at_bound = (local(every, 0, (windows.velocities + factor * bound)[None]) for factor in (50.0, 1.0))
    torch.testing.assert_close(far, at_bound)


def test_simulator_without_uncertain_parameters_is_common_to_all_particles() -> None:
    fixed = replace(MODEL, ranges={})
    local = LocalSteps.of(ParticleSimulator(fixed, torch.zeros(3, 0)), recorded_windows())
    assert len(local.coefficients) == 1
    steps = local(torch.arange(COUNT).expand(3, -1), 1, recorded_windows().motion[:, 0, 3:].expand(3, -1, -1))
    assert torch.equal(steps[0], steps[2])


def test_monomials_are_all_products_up_to_the_third_degree() -> None:
    found = monomials(torch.tensor([2.0, 3.0, 5.0]))
    powers = [(i, j, k) for i in range(4) for j in range(4) for k in range(4) if i + j + k <= 3]
    assert sorted(found.tolist()) == sorted(2.0**i * 3.0**j * 5.0**k for i, j, k in powers)


def test_fit_to_rollouts_removes_a_wrong_correction() -> None:
    """The simulators are correct, the networks add to vx in each step; the simulators do not change."""
    network = Network(WIDTH, 6, (4,))
    parameters = torch.zeros(2, network.parameters)
    parameters[:, -3] = OFFSET_MPS
    units = Normaliser(torch.zeros(WIDTH), torch.ones(WIDTH), torch.zeros(6), torch.ones(6))
    simulator = ParticleSimulator(MODEL, torch.tensor([[6.0], [6.0]]))
    posterior = ParticlePosterior(network, parameters, torch.full((6,), 0.05), units, math.inf, simulator=simulator)
    windows = recorded_windows()
    inputs = windows.inputs.double().numpy()
    outputs = MODEL(windows.inputs, torch.tensor([[6.0]]))[0].double().numpy()
    rows = Transitions(inputs, outputs, np.zeros(COUNT, int), np.arange(COUNT), HISTORY)
    settings = RolloutFitSettings(updates=60, windows=4, rows=8)
    car = fit_rollouts(CarDynamics(posterior, HISTORY), windows, rows, settings)
    clipped = car.posterior.clipped_inputs(windows.inputs)
    wrong = car.posterior.normaliser.raw_outputs(car.posterior.without_simulator(clipped))
    assert float(wrong[..., 3].abs().mean()) < 0.3 * OFFSET_MPS
    assert car.posterior.simulator is simulator
