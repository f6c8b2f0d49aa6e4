"""A case with concealed effects: nominal car, true car, two recordings, and the answer."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from carlab.benchmark.cases.conditions import Conditions, with_stamp_delays
from carlab.benchmark.cases.refit import Refit
from carlab.benchmark.cases.scene import Concealed, Scene
from carlab.benchmark.effects.catalogue import DRIFTS, LAG_PARAMETERS, Form, FormName
from carlab.benchmark.effects.data_faults import FAULTS, Table
from carlab.benchmark.effects.forms import all_forms
from carlab.benchmark.world.base_car import BaseCar
from carlab.benchmark.world.measurement import Recording, as_table
from carlab.core.errors import ConfigError

CaseKind = Literal["single", "pair", "multiple", "null", "parameters", "outside", "fault"]
CHANNELS = ("x", "y", "yaw", "vx", "vy", "yaw_rate")
EFFECT_COUNTS = {"single": (1,), "outside": (1,), "pair": (2,), "multiple": (3, 4, 5)}
PLAIN = Conditions()


@dataclass(frozen=True)
class Case:
    """A case: the diagnosis gets ``nominal``, ``fit`` and ``hold``; the other fields are for scoring."""

    kind: CaseKind
    seed: int
    nominal: BaseCar
    fit: Table
    hold: Table
    true_car: BaseCar
    concealed: tuple[Concealed, ...]
    refit: Refit
    floor: tuple[float, ...]
    target_excess: float
    single_excesses: tuple[float, ...] = ()
    fault: dict[str, Any] | None = None
    recordings: tuple[Recording, ...] = field(default=(), repr=False)
    conditions: Conditions = PLAIN
    fit_s: float = 100.0

    @property
    def excess(self) -> float:
        """sqrt(refit score^2 - 1) on the held-out recording."""
        return self.refit.excess

    def answer(self) -> dict[str, Any]:
        """Data for scoring, as JSON."""
        total = np.array(self.refit.channels)
        share = np.maximum(total**2 - 1.0, 0.0)
        main = [name for name, s in zip(CHANNELS, share, strict=True) if s >= 0.5 * share.max() > 0.0]
        concealed = {c.form.id for c in self.concealed}
        return {
            "kind": self.kind,
            "seed": self.seed,
            "effects": [self._effect(c) for c in self.concealed],
            "main_channels": main,
            "channel_scores": dict(zip(CHANNELS, self.refit.channels, strict=True)),
            "base_parameters": self.true_car.free(),
            "floor": dict(zip(CHANNELS, self.floor, strict=True)),
            "target_excess": self.target_excess,
            "excess": self.excess,
            "single_excesses": list(self.single_excesses),
            "nominal_score": self.refit.nominal_score,
            "refit_score": self.refit.score,
            "fault": self.fault,
            "conditions": self.conditions.names(self.fit_s),
            "implied_effects": [e for e in self.conditions.implied_effects() if e not in concealed],
        }

    def _effect(self, c: Concealed) -> dict[str, Any]:
        lag = LAG_PARAMETERS.get(c.form.id)
        if c.form.id == "mocap_latency":
            lag_s: float | None = c.parameters["latency"] - self.nominal.latency
        else:
            lag_s = c.parameters[lag] if lag is not None and lag in c.parameters else None
        place = c.form.id == "low_friction_patch"
        return {
            "id": c.form.id,
            "form": c.form.form,
            "parameters": dict(c.parameters),
            "fixed": dict(c.form.fixed or {}),
            "lag_s": lag_s,
            "place": {k: c.parameters[k] for k in ("x", "y", "radius")} if place else None,
            "time": "drift" if c.form.id in DRIFTS else None,
            "class_words": [list(group) for group in c.form.class_words],
            "resemblance": None if c.resemblance is None else dataclasses.asdict(c.resemblance),
        }


def make_case(
    kind: CaseKind,
    seed: int,
    *,
    effects: Sequence[str] = (),
    form: FormName = "catalogue",
    excess: float = 1.0,
    fault: str | None = None,
    period_s: float = 1.0 / 30.0,
    fit_s: float = 100.0,
    hold_s: float = 40.0,
    conditions: Conditions = PLAIN,
) -> Case:
    """Draw, size and record one case. The same arguments give the same case.

    Args:
        kind: ``null`` (correct car file), ``parameters`` (wrong base parameters), ``single``, ``pair``, ``multiple``
            (three to five effects), ``outside`` (physics outside the catalogue) or ``fault`` (wrong base parameters
            and a data fault).
        seed: Seed of all random draws.
        effects: Ids of the effects; for ``outside`` the id of an uncatalogued or random form.
        form: Form of the effects; an effect without this form has its other form.
        excess: Target strength of each effect alone, measured with the kind of model of the true car.
        fault: Additional data fault, of FAULTS.
        period_s: Control period: 1/30 s, or 1/100 s.
        fit_s: Length of the recording to fit [s].
        hold_s: Length of the held-out recording [s].
        conditions: Conditions of driving, recording and car file.

    Raises:
        ConfigError: for an unknown effect or fault, or a wrong number of effects.
    """
    forms = _checked_forms(kind, effects, form, fault)
    linear = any(f.nominal_kind == "linear_tyre" for f in forms)
    scene = Scene(
        seed, "linear_tyre" if linear else "dynamic", (fit_s, hold_s), period_s,
        feedback_only=conditions.feedback_only, is_null=kind == "null",
    )  # fmt: skip
    found = [scene.sized(f, excess) for f in forms]
    concealed = tuple(c for c, _ in found)
    fitted, recordings, windows = scene.drive(concealed)
    tables, described = _tables(scene, recordings, fault, conditions)
    nominal = scene.nominal
    if conditions.base_model != "same":
        nominal = dataclasses.replace(nominal, kind=conditions.base_model)
    return Case(
        kind, seed, nominal, tables[0], tables[1], scene.car, concealed, fitted, tuple(windows.floor.tolist()),
        excess if forms else 0.0, tuple(e for _, e in found), described, recordings, conditions, fit_s,
    )  # fmt: skip


def _checked_forms(kind: CaseKind, effects: Sequence[str], form: FormName, fault: str | None) -> list[Form]:
    forms = [_form(name, "outside" if kind == "outside" else form) for name in effects]
    wanted = EFFECT_COUNTS.get(kind, (0,))
    if len(forms) not in wanted:
        numbers = " or ".join(map(str, wanted))
        raise ConfigError(f"A case of kind '{kind}' requires {numbers} effects, not {len(forms)}.")
    if fault is not None and fault not in FAULTS:
        raise ConfigError(f"Unknown data fault '{fault}'; known: {', '.join(FAULTS)}.")
    if kind == "fault" and fault is None:
        raise ConfigError("A case of kind 'fault' needs a data fault.")
    return forms


def _tables(
    scene: Scene, recordings: Sequence[Recording], fault: str | None, conditions: Conditions
) -> tuple[list[Table], dict[str, Any] | None]:
    """Columns of the recordings with the data fault and the delayed stamps, and a description of the fault."""
    tables, described = [as_table(r) for r in recordings], None
    if fault is not None:
        done = [FAULTS[fault](t, np.random.default_rng((scene.seed, 4)), scene.nominal) for t in tables]
        tables = [table for table, *_ in done]
        described = {"id": fault, "columns": list(done[0][1]), "rows": done[0][2]}
    if conditions.stamp_delay_periods > 0.0:
        period_s = scene.nominal.control_period
        mean_s = conditions.stamp_delay_periods * period_s
        tables = [
            with_stamp_delays(t, mean_s, period_s, np.random.default_rng((scene.seed, 5, part)))
            for part, t in enumerate(tables)
        ]
    return tables, described


def _form(name: str, form: FormName) -> Form:
    known = all_forms()
    for wanted in ("outside", "random") if form == "outside" else (form, "catalogue", "other"):
        if (name, wanted) in known:
            return known[(name, wanted)]
    raise ConfigError(f"There is no effect '{name}' of form '{form}' to conceal.")
