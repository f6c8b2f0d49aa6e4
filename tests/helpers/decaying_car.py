"""A learned car whose velocities decay, and drives of it that NumPy computes in double precision."""

import math

import numpy as np
import torch
from torch import Tensor

from learning.networks.normaliser import Normaliser
from learning.networks.particles import Network
from learning.posterior.particle_posterior import ParticlePosterior
from learning.world.car_dynamics import CarDynamics
from learning.world.disturbance import DisturbanceProcess
from learning.world.drive_windows import DriveWindows

PERIOD_S, DECAY, STEPS = 1.0 / 30.0, 0.05, 30
INPUTS = 3 + 2


def decaying_car(offsets: Tensor, noise: float = 1e-4) -> CarDynamics:
    """Return a car whose velocities decay by ``DECAY`` in a step; particles differ in the change of vx by offsets (L,).

    The pose follows from the velocities at the start of a step.
    """
    network = Network(INPUTS, 6, (2,))
    parameters = torch.zeros(len(offsets), network.parameters)
    parameters[:, -3] = offsets
    trend = torch.zeros(1 + INPUTS, 6)
    for channel in range(3):
        trend[1 + channel, channel] = PERIOD_S
        trend[1 + channel, 3 + channel] = -DECAY
    units = Normaliser(torch.zeros(INPUTS), torch.ones(INPUTS), torch.zeros(6), torch.ones(6))
    clip = torch.full((INPUTS,), 100.0)
    noise_std = torch.full((6,), noise)
    return CarDynamics(ParticlePosterior(network, parameters, noise_std, units, math.inf, trend, None, clip), 0)


def driven_windows(process: DisturbanceProcess, count: int, seed: int = 1, offset: float = 0.0) -> DriveWindows:
    """Return windows of the decaying car with a disturbance, computed by NumPy in double precision."""
    rng = np.random.default_rng(seed)
    rho = np.exp(-PERIOD_S / np.array(process.correlation_s))
    scale = np.array(process.scale)
    if not math.isinf(process.dof):
        scale = scale * np.sqrt(process.dof / rng.chisquare(process.dof, (count, 1)))
    velocity = rng.normal(size=(count, 3)) * [1.0, 0.2, 0.5]
    start, unit = velocity.copy(), rng.normal(size=(count, 3))
    pose, motion = np.zeros((count, 3)), []
    for _ in range(STEPS):
        moved = velocity * PERIOD_S + 0.5 * PERIOD_S**2 * scale * unit
        sin, cos = np.sin(pose[:, 2]), np.cos(pose[:, 2])
        pose = pose + np.column_stack([cos * moved[:, 0] - sin * moved[:, 1],
                                       sin * moved[:, 0] + cos * moved[:, 1], moved[:, 2]])  # fmt: skip
        velocity = (1.0 - DECAY) * velocity + PERIOD_S * scale * unit + [offset, 0.0, 0.0]
        unit = rho * unit + np.sqrt(1.0 - rho**2) * rng.normal(size=(count, 3))
        motion.append(np.hstack([pose, velocity]))
    none = torch.zeros((count, 0, 2))
    motions = torch.from_numpy(np.stack(motion, axis=1)).float()
    return DriveWindows(torch.from_numpy(start).float(), none, torch.zeros((count, STEPS, 2)), motions, PERIOD_S)
