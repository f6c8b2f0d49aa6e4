"""Cases of a proof: full and short set, with separate seeds for development and test."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, TypeVar

import numpy as np

from carlab.benchmark.cases.case import PLAIN, Case, CaseKind, make_case
from carlab.benchmark.cases.conditions import Conditions
from carlab.benchmark.effects.catalogue import EFFECT_IDS, FormName, are_confusable
from carlab.benchmark.effects.data_faults import FAULTS
from carlab.benchmark.effects.forms import all_forms

STRENGTHS = (0.5, 1.0, 2.0, 4.0)
SEED_BASE = {"development": 1_000_000, "test": 2_000_000}
MAX_DEVELOPMENT_SEED = 9
"""Largest seed of a set for development, and of a hard set: cases of seed 10 share seeds with the other set."""
MAX_TEST_SEED = 29
"""Largest seed of the full and the short set: cases of seed 30 share seeds with the hard set for development."""
# Faults that leave the concealed effects identifiable.
FAULTS_OF_SINGLE_CASES = ("yaw_wrap_spikes", "outliers", "dropouts", "stale_samples")
Purpose = Literal["development", "test"]
Spec = TypeVar("Spec")


@dataclass(frozen=True)
class CaseSpec:
    """The arguments of one case."""

    kind: CaseKind
    seed: int
    effects: tuple[str, ...] = ()
    form: FormName = "catalogue"
    excess: float = 0.0
    fault: str | None = None
    period_s: float = 1.0 / 30.0
    fit_s: float = 100.0
    hold_s: float = 40.0
    conditions: Conditions = PLAIN

    def make(self) -> Case:
        """Draw, size and record the case."""
        return make_case(**vars(self))

    def as_dict(self) -> dict[str, Any]:
        """As JSON, without conditions that are those of the full set."""
        values = asdict(self)
        if self.conditions == PLAIN:
            del values["conditions"]
        return values

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> CaseSpec:
        """Read ``as_dict``."""
        conditions = Conditions(**values.get("conditions", {}))
        return cls(**{**values, "effects": tuple(values["effects"]), "conditions": conditions})


PAIRS = (
    CaseSpec("pair", 2_000_248, ("motor_lag", "mocap_yaw_misalignment"), "catalogue", max(STRENGTHS)),
    CaseSpec("pair", 2_000_251, ("throttle_deadband", "velocity_filter_lag"), "other", max(STRENGTHS)),
    CaseSpec("pair", 2_000_254, ("steering_rate_limit", "longitudinal_slip"), "catalogue", max(STRENGTHS)),
)
"""Pairs of concealed effects for studies of learning: the first pairs of the proof (seed 0) of excess 1 or more without
effects of time or place, which a one-step model cannot represent. They were chosen before any learning on them."""


def full_set(purpose: Purpose, seed: int = 0) -> list[CaseSpec]:
    """Cases of the protocol: 4 per effect, 100 null, 40 pairs, 40 outside, 2 per data fault, 40 of random physics.

    Half of an effect's cases have the catalogue's form, half another form. Each strength occurs once per effect, in a
    random order of the forms. One single case in ten also has a data fault.
    """
    specs = _specs(purpose, seed, per_effect=4, nulls=100, pairs=40, outside=40, per_fault=2)
    rng = np.random.default_rng((SEED_BASE[purpose], seed, 1))
    return specs + random_physics(rng, 40, SEED_BASE[purpose] + 100_000 * seed + len(specs))


def random_physics(rng: np.random.Generator, count: int, first_seed: int) -> list[CaseSpec]:
    """Cases with random smooth physics outside the catalogue: every kind and every strength equally often."""
    kinds = [name for name, form in all_forms() if form == "random"]
    strengths = rng.permutation(np.resize(STRENGTHS, count))
    return [
        CaseSpec("outside", first_seed + k, (kinds[k % len(kinds)],), "outside", float(strengths[k]))
        for k in range(count)
    ]


def short_set(purpose: Purpose, seed: int = 0) -> list[CaseSpec]:
    """A few short cases of each kind."""
    effects = ("steering_lag", "rolling_resistance")
    specs = _specs(purpose, seed, per_effect=1, nulls=2, pairs=0, outside=1, per_fault=0, effects=effects)
    return [replace(spec, fit_s=40.0, hold_s=20.0) for spec in specs]


def drawn(specs: list[Spec], count: int, seed: int = 0) -> list[Spec]:
    """Draw at most ``count`` cases without replacement, in their order."""
    order = np.random.default_rng((seed, 7)).permutation(len(specs))[:count]
    return [specs[k] for k in sorted(order.tolist())]


def _specs(
    purpose: Purpose,
    seed: int,
    *,
    per_effect: int,
    nulls: int,
    pairs: int,
    outside: int,
    per_fault: int,
    effects: tuple[str, ...] = EFFECT_IDS,
) -> list[CaseSpec]:
    rng = np.random.default_rng((SEED_BASE[purpose], seed))
    known = all_forms()
    base = SEED_BASE[purpose] + 100_000 * seed
    specs: list[CaseSpec] = []

    def add(kind: CaseKind, ids: tuple[str, ...] = (), form: FormName = "catalogue", excess: float = 0.0,
            fault: str | None = None) -> None:  # fmt: skip
        specs.append(CaseSpec(kind, base + len(specs), ids, form, excess, fault))

    for name in effects:
        strengths = rng.permutation(np.resize(STRENGTHS, per_effect))
        for k in range(per_effect):
            wanted: FormName = "catalogue" if k % 2 == 0 else "other"
            form = wanted if (name, wanted) in known else "catalogue" if wanted == "other" else "other"
            fault = str(rng.choice(FAULTS_OF_SINGLE_CASES)) if rng.random() < 0.1 else None
            add("single", (name,), form, float(strengths[k]), fault)
    for k in range(nulls):
        add("null" if k % 2 == 0 else "parameters")
    for k in range(pairs):
        while True:
            one, two = (str(n) for n in rng.choice(EFFECT_IDS, 2, replace=False))
            # The error of a linear nominal car with saturating tyres dominates that of a second effect.
            if not are_confusable(one, two) and "tyre_saturation" not in (one, two):
                break
        add("pair", (one, two), "catalogue" if k % 2 == 0 else "other", float(rng.choice(STRENGTHS)))
    kinds = [name for name, form in known if form == "outside"]
    for k in range(outside):
        add("outside", (kinds[k % len(kinds)],), "outside", float(rng.choice(STRENGTHS)))
    for name in FAULTS:
        for _ in range(per_fault):
            add("fault", fault=name)
    return specs
