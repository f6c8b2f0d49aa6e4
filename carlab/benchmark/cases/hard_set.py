"""Hard cases of a proof: several effects at once, and conditions that hide one effect."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from carlab.benchmark.cases.conditions import SHORT_FIT_S
from carlab.benchmark.cases.proof_set import STRENGTHS, CaseSpec, Purpose, random_physics
from carlab.benchmark.effects.catalogue import EFFECT_IDS, FormName, are_confusable
from carlab.benchmark.effects.forms import all_forms

HARD_SEED_BASE = {"test": 4_000_000, "development": 5_000_000}
SHORT_HOLD_S = 20.0
STAMP_DELAY_PERIODS = 0.1
"""Mean delay of a stamp: 3.3 ms at 30 Hz, as a logger on a computer without a real-time kernel has."""
N_PER_EFFECT_COUNT, N_UNDER_ALL_CONDITIONS, N_NULLS_PER_CONDITION, N_RANDOM_PHYSICS = 12, 12, 10, 40
CONDITIONS = ("short", "base_model", "feedback", "stamps")


def hard_set(purpose: Purpose, seed: int = 0) -> list[CaseSpec]:
    """Cases of the hard set, 308 in all.

    * 180 with one effect: every effect once under each of the four CONDITIONS, with every strength once,
    * 36 with three, four or five effects,
    * 12 with three effects under all conditions except a wrong base model,
    * 40 without an effect: ten under each condition, half of them with wrong base parameters,
    * 40 with random physics outside the catalogue.
    """
    rng = np.random.default_rng((HARD_SEED_BASE[purpose], seed))
    specs = [*_singles(rng), *_multiples(rng), *_nulls()]
    first = HARD_SEED_BASE[purpose] + 100_000 * seed
    specs = [replace(spec, seed=first + k) for k, spec in enumerate(specs)]
    return specs + random_physics(rng, N_RANDOM_PHYSICS, first + len(specs))


def drawn_evenly(specs: list[CaseSpec], count: int, seed: int = 0) -> list[CaseSpec]:
    """Draw at most ``count`` cases without replacement, equally many of each kind (without an effect: one kind)."""
    order = np.random.default_rng((seed, 7)).permutation(len(specs)).tolist()
    seen: dict[str, int] = {}
    turns: list[tuple[int, int, int]] = []
    for k in order:
        kind = "null" if specs[k].kind == "parameters" else specs[k].kind
        turns.append((seen.setdefault(kind, 0), len(turns), k))
        seen[kind] += 1
    return [specs[k] for k in sorted(k for _, _, k in sorted(turns)[:count])]


def under(spec: CaseSpec, condition: str, k: int = 0) -> CaseSpec:
    """The case under one more of the CONDITIONS; ``k`` alternates the kind of wrong base model."""
    conditions = spec.conditions
    if condition == "short":
        return replace(spec, fit_s=SHORT_FIT_S, hold_s=SHORT_HOLD_S)
    if condition == "base_model":
        linear = k % 2 == 0 and "tyre_saturation" not in spec.effects
        return replace(spec, conditions=replace(conditions, base_model="linear_tyre" if linear else "kinematic"))
    if condition == "feedback":
        return replace(spec, conditions=replace(conditions, feedback_only=True))
    return replace(spec, conditions=replace(conditions, stamp_delay_periods=STAMP_DELAY_PERIODS))


def _singles(rng: np.random.Generator) -> list[CaseSpec]:
    known, specs = all_forms(), []
    for number, name in enumerate(EFFECT_IDS):
        strengths = rng.permutation(STRENGTHS)
        for k, condition in enumerate(CONDITIONS):
            form: FormName = "catalogue" if (number + k) % 2 == 0 else "other"
            if (name, form) not in known:
                form = "catalogue" if form == "other" else "other"
            specs.append(under(CaseSpec("single", 0, (name,), form, float(strengths[k])), condition, number))
    return specs


def _multiples(rng: np.random.Generator) -> list[CaseSpec]:
    specs = [_multiple(rng, count, k) for count in (3, 4, 5) for k in range(N_PER_EFFECT_COUNT)]
    for k in range(N_UNDER_ALL_CONDITIONS):
        spec = _multiple(rng, 3, k)
        for condition in ("short", "feedback", "stamps"):
            spec = under(spec, condition)
        specs.append(spec)
    return specs


def _multiple(rng: np.random.Generator, count: int, k: int) -> CaseSpec:
    names: list[str] = []
    while len(names) < count:
        name = str(rng.choice(EFFECT_IDS))
        # The error of a linear nominal car with saturating tyres dominates that of another effect.
        if name not in (*names, "tyre_saturation") and not any(are_confusable(name, other) for other in names):
            names.append(name)
    form: FormName = "catalogue" if k % 2 == 0 else "other"
    return CaseSpec("multiple", 0, tuple(names), form, float(rng.choice(STRENGTHS)))


def _nulls() -> list[CaseSpec]:
    return [
        under(CaseSpec("null" if k % 2 == 0 else "parameters", 0), condition, k // 2)
        for condition in CONDITIONS
        for k in range(N_NULLS_PER_CONDITION)
    ]
