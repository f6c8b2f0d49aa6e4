"""A simulator of one step as JSON text, for files of learned cars. Reading it runs no code."""

from __future__ import annotations

import json
import math

from carlab.core.errors import ConfigError
from learning.priors.simulator_model import CarModel
from sim_backends.car_parameters import SimulatorConfig

MAX_CHARACTERS = 1_000_000
"""Maximum length of a text; measured curves have some thousand characters."""
MAX_DELAY_S = 1.0
"""Maximum delay of measured velocities [s]."""


def text_of(model: CarModel) -> str:
    """The simulator as text: tables of the car file, ranges, time of evaluation and delay of the velocities."""
    ranges = {name: list(bounds) for name, bounds in model.ranges.items()}
    content = {
        "tables": model.config.to_tables(), "ranges": ranges, "at_s": model.at_s,
        "velocity_delay_s": model.velocity_delay_s,
    }  # fmt: skip
    return json.dumps(content)


def model_of(text: str, history: int) -> CarModel:
    """Read the output of ``text_of`` for steps with ``history`` past commands.

    Raises:
        KeyError, TypeError, ValueError: the text is not that of a simulator, or has impossible values.
    """
    if len(text) > MAX_CHARACTERS:
        raise ValueError("the simulator's text is too long")
    content = json.loads(text)
    ranges = {str(name): (float(low), float(high)) for name, (low, high) in content["ranges"].items()}
    at_s, delay_s = float(content["at_s"]), float(content["velocity_delay_s"])
    numbers = [at_s, *(bound for bounds in ranges.values() for bound in bounds)]
    if not all(map(math.isfinite, numbers)) or not 0.0 <= delay_s <= MAX_DELAY_S:
        raise ValueError("the simulator has numbers that are not finite, or a wrong delay")
    try:
        config = SimulatorConfig.from_tables(content["tables"], "the learned car's simulator")
        return CarModel(config, history, ranges, at_s, delay_s)
    except ConfigError as error:
        raise ValueError(str(error)) from error
