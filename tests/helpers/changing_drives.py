"""Recordings of a simulated car whose drive force and steering change along the drive."""

from collections.abc import Callable

import numpy as np
import torch

from carlab.core.episode_data import EpisodeData
from sim_backends import SimulatorConfig, rollout
from tests.helpers.recorded_drives import PERIOD_S, drive

CHUNK_TICKS = 15
HISTORY_TICKS = 12


def changing_drive(
    config: SimulatorConfig,
    seconds: float,
    seed: int,
    drive_factor: Callable[[float], float],
    trim_rad: Callable[[float], float],
    noise: float = 3e-4,
) -> EpisodeData:
    """Drive with the commands of ``drive``; the motor's gain and the steering offset change every half second.

    Args:
        config: the car before the change.
        seconds: duration.
        seed: seed of commands and noise.
        drive_factor: factor of the drive gain at a time [s].
        trim_rad: offset of the steering at a time [s].
        noise: standard deviation of the position [m].
    """
    sent = drive(config, seconds, seed).sent
    rows = [np.array([0.0, 0.0, 0.0, 0.5, 0.0, 0.0])]
    for first in range(0, len(sent), CHUNK_TICKS):
        t_s = (first + 0.5 * CHUNK_TICKS) * PERIOD_S
        car = config.with_values(
            {
                "motor.drive_gain": config.parameters.drive_gain_n * drive_factor(t_s),
                "effects.steering_offset.angle": trim_rad(t_s),
            }
        )
        earlier = np.vstack([np.zeros((HISTORY_TICKS, 2)), sent])[first : first + HISTORY_TICKS]
        states = rollout(
            car,
            torch.from_numpy(rows[-1])[None],
            torch.from_numpy(sent[first : first + CHUNK_TICKS])[None],
            history=torch.from_numpy(earlier)[None],
        ).states[0]
        rows.extend(states[1:].numpy())
    true = np.array(rows)
    rng = np.random.default_rng(seed)
    measured = true + noise * np.array([1.0, 1.0, 2.0, 20.0, 20.0, 40.0]) * rng.normal(size=true.shape)
    return EpisodeData(PERIOD_S * np.arange(len(true)), measured, sent, sent, np.zeros(len(sent)))
