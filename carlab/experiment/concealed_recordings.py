"""Recordings of a simulated race car with two concealed effects, by the generator of ``carlab prove``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from carlab.concealment.case import make_case
from carlab.concealment.catalogue import FormName
from carlab.concealment.measurement import write_csv
from carlab.core.errors import ConfigError

STRENGTH = 4.0
"""Excess of the held-out error that each effect is sized for, in noise floors: the strongest of the proof."""
TRAINING_NAME, HELD_OUT_NAME, CAR_NAME = "1_training.csv", "2_held_out.csv", "car.toml"


@dataclass(frozen=True, slots=True)
class ConcealedPair:
    """Two effects, the form of their equations, and the seed of car, drive and noise."""

    effects: tuple[str, str]
    form: FormName
    seed: int


PAIRS = (
    ConcealedPair(("motor_lag", "mocap_yaw_misalignment"), "catalogue", 2_000_248),
    ConcealedPair(("throttle_deadband", "velocity_filter_lag"), "other", 2_000_251),
    ConcealedPair(("steering_rate_limit", "longitudinal_slip"), "catalogue", 2_000_254),
)
"""The first pairs of the proof (seed 0) of excess 1 or more without an effect of time or place, which one step of a
car cannot show; chosen before any of them was learned from."""


def record_pair(number: int, folder: Path, training_s: float, held_out_s: float) -> ConcealedPair:
    """Write a pair's two recordings and the nominal car's file into a folder, and tell what was concealed.

    Args:
        number: of the pair, from 1.
        folder: for the files.
        training_s: length of the recording to learn from [s].
        held_out_s: length of the other [s].

    Raises:
        ConfigError: there is no such pair.
    """
    if not 1 <= number <= len(PAIRS):
        raise ConfigError(f"There is no pair {number}; choose 1 to {len(PAIRS)}.")
    pair = PAIRS[number - 1]
    case = make_case(
        "pair", pair.seed, effects=pair.effects, form=pair.form, excess=STRENGTH, fit_s=training_s, hold_s=held_out_s
    )
    folder.mkdir(parents=True, exist_ok=True)
    case.nominal.write(folder / CAR_NAME)
    write_csv(folder / TRAINING_NAME, dict(case.fit))
    write_csv(folder / HELD_OUT_NAME, dict(case.hold))
    return pair


__all__ = ["CAR_NAME", "HELD_OUT_NAME", "PAIRS", "TRAINING_NAME", "ConcealedPair", "record_pair"]
