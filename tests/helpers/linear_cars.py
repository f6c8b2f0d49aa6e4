"""A quick fit for tests of studies: a learned car that is linear in its inputs."""

import math

import numpy as np
import torch

from learning.networks.normaliser import Normaliser
from learning.networks.particles import Network
from learning.posterior.particle_posterior import ParticlePosterior
from learning.transitions import Transitions
from learning.world.car_dynamics import CarDynamics


def linear_car(case: object, rows: Transitions, count: int, seed: int, *others: object) -> CarDynamics:
    """Fit two equal particles, linear in the inputs, by least squares; it cannot describe a car with tyres."""
    design = np.hstack([np.ones((len(rows), 1)), rows.inputs])
    weights = np.linalg.lstsq(design, rows.targets, rcond=None)[0]
    noise = (rows.targets - design @ weights).std(axis=0)
    width = rows.inputs.shape[1]
    network = Network(width, 6, (2,))
    units = Normaliser(torch.zeros(width), torch.ones(width), torch.zeros(6), torch.ones(6))
    trend, noise_std = (torch.from_numpy(v).float() for v in (weights, noise))
    zeros = torch.zeros(2, network.parameters)
    clip = torch.full((width,), 100.0)
    return CarDynamics(ParticlePosterior(network, zeros, noise_std, units, math.inf, trend, None, clip), rows.history)
