"""Learning to park on cars that differ from the prior: by arm, how early a run parks, and coverage of its predictions.

Every reality is the default car with other parameters or effects. The prior of a run is that of the default car.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from carlab.core.errors import ConfigError
from carlab.recording.atomic_files import write_text
from carlab.studies.parking import Curve
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.effects.body import RoadSlope
from sim_backends.effects.lags import MotorLag, SteeringLag
from sim_backends.effects.loads import LoadTransfer
from sim_backends.effects.tyres import LowFrictionPatch

EARLY_EPISODE = 4
REALITIES: dict[str, dict[str, float]] = {
    "low_grip": {"tyre.front.mu": 0.26, "tyre.rear.mu": 0.25},
    "servo_lag": {f"effects.{SteeringLag.id}.time_constant": 0.12},
    "long_delay": {"timing.command_delay": 0.16},
    "weak_motor": {"motor.drive_gain": 5.0},
    "patch": {
        f"effects.{LowFrictionPatch.id}.x": 0.7, f"effects.{LowFrictionPatch.id}.y": -0.5,
        f"effects.{LowFrictionPatch.id}.radius": 0.5, f"effects.{LowFrictionPatch.id}.loss": 0.6,
    },
    "two_lags": {f"effects.{SteeringLag.id}.time_constant": 0.1, f"effects.{MotorLag.id}.time_constant": 0.1},
    "slope": {f"effects.{RoadSlope.id}.angle": 0.04, f"effects.{RoadSlope.id}.direction": 1.0},
    LoadTransfer.id: {f"effects.{LoadTransfer.id}.height": 0.08},
}  # fmt: skip
"""Numbers that differ from the default car, by name of the reality."""
ARMS: dict[str, dict[str, Any]] = {
    "nominal": {"prior": "nominal"},
    "auto": {"prior": "auto"},
    "no-simulator": {"method": "gp-posterior"},
}
"""Options of ``carlab learn`` by arm."""


@dataclass(frozen=True, slots=True)
class ArmFigures:
    """The runs of one arm.

    Attributes:
        arm: name.
        runs: number of runs.
        mean_first_parked: mean first episode that ended parked; for a run that never parked, the last episode of the
            longest run plus one.
        parked_early: share of runs that parked by episode ``EARLY_EPISODE``.
        parked_after: share of parked episodes after the first parked one; NaN without any.
        coverage: share of episodes whose return is in the predicted 90 % interval; NaN without a prediction.
        latest_against_nominal: largest first parked episode minus that of the nominal arm in the same reality and with
            the same seed; NaN without such a pair.
    """

    arm: str
    runs: int
    mean_first_parked: float
    parked_early: float
    parked_after: float
    coverage: float
    latest_against_nominal: float


def write_reality(name: str, folder: Path) -> Path:
    """Write the car file of a reality, and return its path. Raises DataError if it cannot be written."""
    plain = replace(SimulatorConfig.from_preset(), priors={})
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.toml"
    write_text(path, tomli_w.dumps(plain.with_values(REALITIES[name]).to_tables()))
    return path


def arm_of(name: str) -> dict[str, Any]:
    """Options of an arm by its name. Raises ConfigError for another name."""
    if name not in ARMS:
        raise ConfigError(f"There is no arm '{name}'; choose among {', '.join(ARMS)}.")
    return ARMS[name]


def compared(curves: Sequence[Curve]) -> list[ArmFigures]:
    """One row per arm, in the order of the curves."""
    never = 1 + max((e.episode for c in curves for e in c.episodes), default=0)
    firsts = [c.first_parked or never for c in curves]
    nominal = {(c.reality, c.seed): f for c, f in zip(curves, firsts, strict=True) if c.method == "nominal"}
    rows = []
    for arm in dict.fromkeys(c.method for c in curves):
        own = [c for c in curves if c.method == arm]
        first = [f for c, f in zip(curves, firsts, strict=True) if c.method == arm]
        later = [e.success for c, f in zip(own, first, strict=True) for e in c.episodes if e.episode > f]
        inside = [
            e.predicted_low <= e.total_reward <= e.predicted_high
            for c in own
            for e in c.episodes
            if np.isfinite(e.predicted_low)
        ]
        against = [f - nominal[key] for c, f in zip(own, first, strict=True) if (key := (c.reality, c.seed)) in nominal]
        early = [c.first_parked is not None and c.first_parked <= EARLY_EPISODE for c in own]
        rows.append(
            ArmFigures(
                arm, len(own), float(np.mean(first)), _mean(early), _mean(later), _mean(inside),
                float(max(against)) if against else float("nan"),
            )
        )  # fmt: skip
    return rows


def _mean(values: Sequence[bool]) -> float:
    return float(np.mean(values)) if values else float("nan")
