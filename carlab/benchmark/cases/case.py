"""A case with concealed effects: nominal car, true car, two recordings, and the answer."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from carlab.benchmark.cases.refit import Refit, Windows, cut_windows, refit
from carlab.benchmark.effects.catalogue import DRIFTS, LAG_PARAMETERS, Draw, Form, FormName
from carlab.benchmark.effects.data_faults import FAULTS, Table
from carlab.benchmark.effects.forms import all_forms
from carlab.benchmark.world.base_car import BaseCar, draw_nominal
from carlab.benchmark.world.driver import HumanDriver, Track
from carlab.benchmark.world.measurement import Noise, Recording, as_table, record
from carlab.benchmark.world.physics import World
from carlab.benchmark.world.simulation import drive
from carlab.core.errors import ConfigError, DataError

CaseKind = Literal["single", "pair", "null", "parameters", "outside", "fault"]
CHANNELS = ("x", "y", "yaw", "vx", "vy", "yaw_rate")
NEAR = 0.10  # relative tolerance of the search for a strength


@dataclass(frozen=True)
class Concealed:
    """A concealed effect of the true car."""

    form: Form
    parameters: dict[str, float]
    size: float


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

    @property
    def excess(self) -> float:
        """sqrt(refit score^2 - 1) on the held-out recording."""
        return self.refit.excess

    def answer(self) -> dict[str, Any]:
        """Data for scoring, as JSON."""
        total = np.array(self.refit.channels)
        share = np.maximum(total**2 - 1.0, 0.0)
        main = [name for name, s in zip(CHANNELS, share, strict=True) if s >= 0.5 * share.max() > 0.0]
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
        }


class _Scene:
    """Random draws of a case that do not depend on the strength; it can be driven with any effects."""

    def __init__(
        self,
        seed: int,
        kind: CaseKind,
        model: Literal["dynamic", "linear_tyre"],
        lengths_s: tuple[float, float],
        period_s: float,
        true_starts: bool,
    ) -> None:
        draws = np.random.default_rng((seed, 1))
        self.nominal = draw_nominal(draws, period_s, model)
        moved = self.nominal.perturbed(draws)
        self.car = self.nominal if kind == "null" else moved
        self.track = Track(draws)
        self.noise = Noise(self.nominal.position_std, self.nominal.yaw_std, float(draws.choice((0.06, 0.075, 0.09))))
        self.seed, self.lengths_s, self.true_starts = seed, lengths_s, true_starts
        self.draws = draws

    def drive(self, concealed: Sequence[Concealed]) -> tuple[Refit, tuple[Recording, ...], Windows]:
        recordings: list[Recording] = []
        windows: list[Windows] = []
        for part, length_s in enumerate(self.lengths_s):
            world = World(self.car)
            for c in concealed:
                c.form.attach(world, c.parameters)
            human = HumanDriver(self.car, self.track, np.random.default_rng((self.seed, 2, part)))
            what = drive(world, human, length_s, start=human.start())
            recordings.append(record(what, world, self.noise, np.random.default_rng((self.seed, 3, part))))
            windows.append(cut_windows(recordings[-1], self.car, true_starts=self.true_starts))
        fitted = refit(windows[0], windows[1], self.nominal)
        return fitted, tuple(recordings), windows[1]

    def sized(self, form: Form, target: float, tries: int = 8) -> tuple[Concealed, float]:
        """Scale the effect until its excess is ``target``, or as near as possible. Returns it and its excess."""
        draw = Draw.from_rng(self.draws, self.car, self.track.points)
        low, high, best, best_miss, best_excess = 0.0, math.inf, None, math.inf, 0.0
        size, last = min(max(form.typical * target, form.smallest), form.largest), (0.0, 0.0)
        for _ in range(tries):
            candidate = Concealed(form, form.sized(size, draw), size)
            try:
                ratio = self.drive([candidate])[0].excess / target
            except DataError:
                ratio = math.inf
            miss = abs(math.log(max(ratio, 1e-3))) if math.isfinite(ratio) else math.inf
            if miss < best_miss:
                best, best_miss, best_excess = candidate, miss, ratio * target
            if miss < NEAR or (ratio < 1.0 and size >= form.largest) or (ratio > 1.0 and size <= form.smallest):
                break
            low, high = (size, high) if ratio < 1.0 else (low, min(high, size))
            slope = 1.0
            if math.isfinite(ratio) and ratio > 0.05 and last[1] > 0.05 and size != last[0]:
                slope = min(max(math.log(ratio / last[1]) / math.log(size / last[0]), 0.3), 4.0)
            last = (size, ratio if math.isfinite(ratio) else 0.0)
            usable = min(max(ratio, 0.05), 20.0)
            size *= min(max(usable ** (-1.0 / slope), 0.2), 5.0)
            if size <= low or size >= high:
                size = math.sqrt(low * high) if low > 0.0 else 0.3 * high
            size = min(max(size, form.smallest), form.largest)
        if best is None:
            raise DataError(
                f"The car cannot be driven with {form.id} of any size at seed {self.seed}; use another seed."
            )
        return best, best_excess


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
    true_starts: bool = False,
) -> Case:
    """Draw, size and record one case. The same arguments give the same case.

    Args:
        kind: ``null`` (correct car file), ``parameters`` (wrong base parameters), ``single``, ``pair``, ``outside``
            (physics outside the catalogue) or ``fault`` (wrong base parameters and a data fault).
        seed: Seed of all random draws.
        effects: One or two ids; for ``outside`` the id of an uncatalogued form.
        form: Form of the effects; an effect without this form has its other form.
        excess: Target strength of each effect alone.
        fault: Additional data fault, of FAULTS.
        period_s: Control period: 1/30 s, or 1/100 s.
        fit_s: Length of the recording to fit [s].
        hold_s: Length of the held-out recording [s].
        true_starts: Measure the excess from noise-free initial states; the floor is then the recording's noise.

    Raises:
        ConfigError: for an unknown effect or fault, or a wrong number of effects.
    """
    forms = [_form(name, "outside" if kind == "outside" else form) for name in effects]
    wanted = {"single": 1, "outside": 1, "pair": 2}.get(kind, 0)
    if len(forms) != wanted:
        raise ConfigError(f"A case of kind '{kind}' requires {wanted} effects, not {len(forms)}.")
    if fault is not None and fault not in FAULTS:
        raise ConfigError(f"Unknown data fault '{fault}'; known: {', '.join(FAULTS)}.")
    if kind == "fault" and fault is None:
        raise ConfigError("A case of kind 'fault' needs a data fault.")
    linear = any(f.nominal_kind == "linear_tyre" for f in forms)
    scene = _Scene(seed, kind, "linear_tyre" if linear else "dynamic", (fit_s, hold_s), period_s, true_starts)
    found = [scene.sized(f, excess) for f in forms]
    concealed = tuple(c for c, _ in found)
    fitted, recordings, windows = scene.drive(concealed)
    tables = [as_table(r) for r in recordings]
    described = None
    if fault is not None:
        done = [FAULTS[fault](t, np.random.default_rng((seed, 4)), scene.nominal) for t in tables]
        tables = [t for t, _ in done]
        described = {"id": fault, "columns": list(done[0][1].columns), "rows": done[0][1].rows}
    return Case(
        kind, seed, scene.nominal, tables[0], tables[1], scene.car, concealed, fitted,
        tuple(windows.floor.tolist()), excess if forms else 0.0, tuple(e for _, e in found), described, recordings,
    )  # fmt: skip


def _form(name: str, form: FormName) -> Form:
    known = all_forms()
    for wanted in (form, "catalogue", "other") if form != "outside" else ("outside",):
        if (name, wanted) in known:
            return known[(name, wanted)]  # type: ignore[index]
    raise ConfigError(f"There is no effect '{name}' of form '{form}' to conceal.")
