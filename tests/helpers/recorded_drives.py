"""Recordings of a simulated car, driven with random held commands within limits of speed."""

import numpy as np
import torch

from carlab.core.episode_data import EpisodeData
from sim_backends import SimulatorConfig, rollout

PERIOD_S = 1.0 / 30.0


def drive(config: SimulatorConfig, seconds: float, seed: int, noise: float = 3e-4) -> EpisodeData:
    """Record a drive with commands that change every 0.3 to 1 s, and noise on poses and velocities."""
    rng = np.random.default_rng(seed)
    ticks = int(seconds / PERIOD_S)
    commands = np.zeros((ticks, 2))
    row = 0
    while row < ticks:
        held = int(rng.uniform(9, 30))
        commands[row : row + held] = rng.uniform(-0.8, 0.8), rng.choice([-0.3, 0.0, 0.1, 0.3, 0.5, 0.8])
        row += held
    start = torch.tensor([[0.0, 0.0, 0.0, 0.5, 0.0, 0.0]], dtype=torch.float64)
    states = rollout(config, start, torch.from_numpy(commands)[None]).states[0].numpy()
    scale = noise * np.array([1.0, 1.0, 2.0, 20.0, 20.0, 40.0])
    measured = states + scale * rng.normal(size=states.shape)
    times_s = PERIOD_S * np.arange(ticks + 1)
    return EpisodeData(times_s, measured, commands, commands, np.zeros(ticks))
