"""Typical numbers of effects, and random initial states and commands of a few cars."""

import numpy as np
import torch

from sim_backends.effects import EFFECTS

NAMES = list(EFFECTS)


def typical(name):
    numbers = {p.name: p.typical for p in EFFECTS[name].parameters}
    stronger = {"battery_sag": {"rate": 0.2}, "friction_drift": {"rate": -0.2}}
    # These delays do not coincide with changes of the number of steps.
    stronger |= {"steering_delay": {"delay": 0.0273}, "throttle_delay": {"delay": 0.0214}}
    return {**numbers, **stronger.get(name, {})}


ALL_EFFECTS = {name: typical(name) for name in NAMES if name != "tyre_saturation"}
"""All effects except tyre saturation, which turns a kinematic or linear-tyre car into a dynamic one."""


def some(cars=4, ticks=6, seed=0):
    rng = np.random.default_rng(seed)
    start = rng.uniform(-1, 1, (cars, 6)) * [1, 1, 3, 1, 0.3, 1] + [0.5, 0, 0, 1.6, 0, 0]
    return torch.tensor(start), torch.tensor(rng.uniform(-1, 1, (cars, ticks, 2)))


def past(cars=4, ticks=5):
    return torch.tensor(np.random.default_rng(5).uniform(-1, 1, (cars, ticks, 2)))
