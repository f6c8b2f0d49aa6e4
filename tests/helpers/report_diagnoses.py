"""Diagnoses with chosen errors and effects, for tests of their texts."""

from __future__ import annotations

from carlab.diagnosis.findings import (
    Diagnosis,
    EffectFinding,
    ErrorLocation,
    Estimate,
    Evidence,
    FitErrors,
)
from sim_backends.effects import CATALOGUE


def around(value: float, unit: str) -> Estimate:
    return Estimate(value, 0.1 * abs(value), value - 0.2 * abs(value), value + 0.2 * abs(value), unit)


def finding(effect_id: str, others: tuple[str, ...] = ()) -> EffectFinding:
    parameters = {p.name: around(p.typical, p.unit) for p in CATALOGUE[effect_id].parameters}
    evidence = Evidence(0.3, 9.0, 0.6, {"vx": 0.2})
    return EffectFinding(effect_id, 0.9, parameters, ErrorLocation(("vx",), "speed > 1 m/s"), evidence, "", others)


def diagnosis(verdict: str, *effects: EffectFinding, refit: float = 4.0, with_effects: float = 2.5) -> Diagnosis:
    scores = {"nominal": 6.0, "refit": refit, "with_effects": with_effects, "noise_floor": 1.0}
    held = {name: FitErrors(0.1, 0.1, 0.1, 0.1, 0.1, score) for name, score in scores.items()}
    return Diagnosis(verdict, "", effects, {}, 1.0, held, None, (), (), 0, 1.0)  # type: ignore[arg-type]
