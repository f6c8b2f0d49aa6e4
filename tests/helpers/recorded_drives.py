"""Recordings of a simulated car, driven with random held commands within limits of speed."""

import numpy as np

from carlab.core.episode_data import EpisodeData
from carlab.core.quantities import Action, CarState, FloatArray
from sim_backends import SimulatorConfig
from sim_backends.array_ops import ARRAYS
from sim_backends.measurement import MeasurementModel
from sim_backends.plant import Plant

PERIOD_S = 1.0 / 30.0


def drive(config: SimulatorConfig, seconds: float, seed: int, noise: float = 3e-4) -> EpisodeData:
    """Record a drive with commands that change every 0.3 to 1 s, and noise on poses and velocities.

    Latency and filters of the measurement are not applied.
    """
    rng = np.random.default_rng(seed)
    ticks = int(seconds / PERIOD_S)
    commands = np.zeros((ticks, 2))
    row = 0
    while row < ticks:
        held = int(rng.uniform(9, 30))
        commands[row : row + held] = rng.uniform(-0.8, 0.8), rng.choice([-0.3, 0.0, 0.1, 0.3, 0.5, 0.8])
        row += held
    measurement = MeasurementModel(ARRAYS, config.values(), config.effects)
    states = np.stack(measurement.observe(tuple(driven(config, commands).T)), axis=1)
    scale = noise * np.array([1.0, 1.0, 2.0, 20.0, 20.0, 40.0])
    measured = states + scale * rng.normal(size=states.shape)
    times_s = PERIOD_S * np.arange(ticks + 1)
    return EpisodeData(times_s, measured, commands, commands, np.zeros(ticks))


def driven(config: SimulatorConfig, commands: FloatArray) -> FloatArray:
    """True states (T + 1, 6) of a car from 0.5 m/s on; for one car the plant takes half the time of a batch."""
    plant = Plant(config)
    plant.reset(CarState(vx_mps=0.5), 0.0)
    states = [plant.state.to_array()]
    for k, (steering, throttle) in enumerate(commands):
        plant.command(k * config.control_period_s, Action(steering, throttle))
        states.append(plant.advance((k + 1) * config.control_period_s).to_array())
    found = np.array(states)
    found[:, 2] = np.unwrap(found[:, 2])
    return found
