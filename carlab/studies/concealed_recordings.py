"""Recordings of a simulated race car with two concealed effects, by the generator of ``carlab prove``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from carlab.benchmark.cases.proof_set import PAIRS, CaseSpec
from carlab.benchmark.world.measurement import write_csv
from carlab.core.errors import ConfigError

TRAINING_NAME, HELD_OUT_NAME, CAR_NAME = "1_training.csv", "2_held_out.csv", "car.toml"


def record_pair(number: int, folder: Path, training_s: float, held_out_s: float) -> CaseSpec:
    """Write a pair's two recordings and the nominal car file to a folder; returns the pair.

    Args:
        number: of the pair, from 1.
        folder: for the files.
        training_s: duration of the training recording [s].
        held_out_s: duration of the held-out recording [s].

    Raises:
        ConfigError: the pair does not exist.
    """
    if not 1 <= number <= len(PAIRS):
        raise ConfigError(f"There is no pair {number}; choose 1 to {len(PAIRS)}.")
    pair = replace(PAIRS[number - 1], fit_s=training_s, hold_s=held_out_s)
    case = pair.make()
    folder.mkdir(parents=True, exist_ok=True)
    case.nominal.write(folder / CAR_NAME)
    write_csv(folder / TRAINING_NAME, case.fit)
    write_csv(folder / HELD_OUT_NAME, case.hold)
    return pair
