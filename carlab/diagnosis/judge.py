"""Evidence for what a search has found, on held-out shots: how much, where, how sure, and the verdict."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from carlab.core.errors import DataError
from carlab.core.quantities import STATE_NAMES, FloatArray
from carlab.diagnosis.findings import (
    DataFault,
    EffectFinding,
    Estimate,
    Evidence,
    Exhibits,
    Trace,
    Verdict,
    Where,
)
from carlab.diagnosis.fit import Fit, Fitter, clustered_gain
from carlab.diagnosis.prediction import Predictor, errors
from carlab.diagnosis.scoring import HeldOut
from carlab.diagnosis.search import Search, SearchResult
from carlab.diagnosis.shots import Shots, Track, cut
from carlab.diagnosis.unexplained import REGIMES, start_features, worst_regime
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.effects import EFFECTS
from sim_backends.registry import REGISTRY

HORIZON_S = 1.0
PARAMETER_STANDARD_ERRORS = 4.0
PARAMETER_SHARE = 0.05
Z90 = 1.6449
WIDER = 1.25
MODEL_ERROR = 0.01
"""Intervals are so much wider than the sandwich's, and never narrower than this share of the value: set on development
cases, where the plain intervals covered 79 % instead of 90 %."""
MISSING_SCORE = 1.2
"""Held-out score of the refit above which unnamed terms amount to missing physics."""
MISSING_WITHOUT_FORMULA_SCORE = 1.8
"""The same where no term explains anything."""
EVEN, STEEP = 8.0, 5.0
"""Root of chi2 at which half of the names are right, and how fast they become surer: a logistic regression on the
names that were given to development cases."""
LAG_NAMES = ("time_constant", "delay", "extra_delay", "latency")
THROTTLE_WORDS = ("throttle", "motor", "traction", "brake", "battery", "drag", "rolling", "slip")


@dataclass(frozen=True, slots=True)
class Texts:
    """Where sentences come from: of one effect and its numbers, of the whole, and the drive that separates a set."""

    effect: Callable[[str, Mapping[str, Estimate]], str]
    separating_drive: Callable[[str, Sequence[str]], str]
    look_alikes: Mapping[str, Sequence[str]]


class Judge:
    """Evidence for what was found, on held-out shots."""

    def __init__(self, search: Search, found: SearchResult, held_out: HeldOut, texts: Texts) -> None:
        self.search = search
        self.found = found
        self.held_out = held_out
        self.texts = texts
        self.fitter = Fitter(search.shots, found.scale)
        self.best = self.fitter.with_covariance(found.best)
        self.errors = {
            "nominal": held_out.final_error(search.nominal),
            "refit": held_out.final_error(found.base.config),
            "with_effects": held_out.final_error(found.best.config),
        }
        self.ladder = [("nominal", held_out.score(self.errors["nominal"]))]
        self.ladder.append(("refit", held_out.score(self.errors["refit"])))

    def findings(self, progress: Callable[[float], None]) -> tuple[EffectFinding, ...]:
        """Each effect with its evidence, the strongest first."""
        made = []
        for k, name in enumerate(self.found.effects):
            progress(k / len(self.found.effects))
            made.append(self._finding(name))
        for name, fit in self.found.history:
            self.ladder.append((f"+ {name}", self.held_out.score(self.held_out.final_error(fit.config))))
        if self.found.history and self.found.history[-1][1] is not self.found.best:
            self.ladder.append(("those that stay", self.held_out.score(self.errors["with_effects"])))
        return tuple(made)

    def _finding(self, name: str) -> EffectFinding:
        rest = tuple(e for e in self.found.effects if e != name)
        without = self.search.refit(rest, self.best, self.found.scale)
        error = self.held_out.final_error(without.config)
        full = self.errors["with_effects"]
        gain, spread = self.held_out.gain(error, full)
        fingerprint = HeldOut.fingerprint(error, full)
        parameters = {p.name: self.estimate(f"effects.{name}.{p.name}") for p in EFFECTS[name].parameters}
        others = self.found.rivals.get(name, ())
        reduction = 1.0 - self.held_out.score(full) / max(self.held_out.score(error), 1e-12)
        evidence = Evidence(reduction, gain / spread, self.visibility(name), fingerprint)
        confidence = 1.0 / (1.0 + (EVEN / math.sqrt(max(self.found.chi2[name], 1e-3))) ** STEEP)
        return EffectFinding(
            id=name,
            confidence=confidence / (1 + len(others)),
            parameters=parameters,
            where=self._where(name, parameters, error, without),
            evidence=evidence,
            sentence=self.texts.effect(name, parameters),
            indistinguishable_from=others,
            separating_drive=self.texts.separating_drive(name, others) if others else "",
        )

    def _where(self, name: str, parameters: Mapping[str, Estimate], error: FloatArray, without: Fit) -> Where:
        """Channels by how much of the squared score the effect takes away; regime, lag, time and place."""
        floor = self.held_out.floor
        gone = np.mean((error / floor) ** 2, axis=0) - np.mean((self.errors["with_effects"] / floor) ** 2, axis=0)
        main = gone >= min(0.5 * gone.max(), gone.max())
        channels = tuple(STATE_NAMES[k] for k in np.argsort(-gone) if main[k])
        lag = next((parameters[k].value for k in LAG_NAMES if k in parameters), None)
        place = None
        if {"x", "y", "radius"} <= parameters.keys():
            place = (parameters["x"].value, parameters["y"].value, parameters["radius"].value)
        shots = self.search.shots
        time = (0.0, float(shots.t0_s.max())) if name in ("battery_sag", "friction_drift") else None
        white = errors(Predictor(shots, without.config)(), shots)[0, :, -1]
        channel = STATE_NAMES.index(channels[0])
        return Where(channels, worst_regime(start_features(shots), np.abs(white[:, channel])), lag, time, place)

    def estimate(self, name: str) -> Estimate:
        """A fitted number with its interval."""
        index = [f.name for f in self.best.free].index(name)
        free, z = self.best.free[index], float(self.best.z[index])
        assert self.best.covariance is not None
        spread = WIDER * math.sqrt(max(float(self.best.covariance[index, index]), 0.0))
        low, value, high = (float(free.value(np.array(z + k * spread))) for k in (-Z90, 0.0, Z90))
        beyond = Z90 * MODEL_ERROR * abs(value)
        low = max(value - math.hypot(value - min(low, high), beyond), free.low)
        high = min(value + math.hypot(max(low, high) - value, beyond), free.high)
        return Estimate(value, (high - low) / (2 * Z90), low, high, REGISTRY[name].unit)

    def parameters(self) -> dict[str, Estimate]:
        """Base parameters with everything found."""
        return {f.name: self.estimate(f.name) for f in self.best.free if not f.name.startswith("effects.")}

    def visibility(self, effect: str) -> float:
        """Share of an effect's influence that base parameters cannot imitate, in [0, 1]."""
        free = self.best.free
        jacobian = self.fitter.linear(self.best)[0].reshape(len(free), -1)
        own = [k for k, f in enumerate(free) if f.name.startswith(f"effects.{effect}.")]
        other = [k for k in range(len(free)) if k not in own]
        basis, _ = np.linalg.qr(jacobian[other].T)
        columns = jacobian[own]
        left = columns - (columns @ basis) @ basis.T
        return float(np.linalg.norm(left) / max(float(np.linalg.norm(columns)), 1e-12))

    def verdict(self, more: bool, data_faults: Sequence[DataFault]) -> Verdict:
        """What the figures amount to; ``more``: whether something without a name is called for."""
        if any(f.action.startswith("unusable") for f in data_faults):
            return "data"
        if self.found.effects:
            return "mismatch"
        shots = self.search.shots
        score = {name: self.held_out.score(error) for name, error in self.errors.items()}
        best = min(score["refit"], score["nominal"])  # few recordings may lead a refit astray
        if (more and best > MISSING_SCORE) or best > MISSING_WITHOUT_FORMULA_SCORE:
            return "unexplained"
        nominal_loss = self.fitter.loss(self.search.nominal)
        gain, spread = clustered_gain(nominal_loss, self.found.base.loss, shots)
        moved = gain / spread > PARAMETER_STANDARD_ERRORS and gain > PARAMETER_SHARE * float(nominal_loss.sum())
        return "parameters" if moved and score["refit"] < 0.98 * score["nominal"] else "none"

    def exhibits(self, tracks: Sequence[Track]) -> Exhibits:
        """Material for the pictures."""
        shots, held = self.search.shots, self.held_out.shots
        regimes: dict[str, tuple[FloatArray, FloatArray, FloatArray]] = {}
        seen = start_features(held)
        size = {name: np.sqrt(np.mean((e / self.held_out.floor) ** 2, axis=1)) for name, e in self.errors.items()}
        for name, unit, value in REGIMES:
            feature = value(seen)
            edges = np.unique(np.quantile(feature, np.linspace(0, 1, 7)))
            if len(edges) < 3:
                continue
            index = np.clip(np.searchsorted(edges, feature, side="right") - 1, 0, len(edges) - 2)
            centres = np.array([feature[index == k].mean() for k in range(len(edges) - 1)])
            curves = [
                np.array([np.sqrt(np.mean(size[which][index == k] ** 2)) for k in range(len(edges) - 1)])
                for which in ("refit", "with_effects")
            ]
            regimes[f"{name} [{unit}]" if unit else name] = (centres, curves[0], curves[1])
        correlation = {
            name: _correlation(shots, self.found.base.config, "throttle" if _on_throttle(name) else "steering")
            for name in self.found.effects[:3]
        }
        models = {
            "nominal": self.search.nominal,
            "refit": self.found.base.config,
            "with_effects": self.found.best.config,
        }
        longest = sorted(tracks, key=lambda track: -len(track.t_s))
        traces = tuple(found for track in longest[:6] if (found := _trace(track, models)) is not None)[:3]
        candidates = tuple(
            (c.effect, c.standard_errors if math.isfinite(c.unseen_error) else 0.0, float(c.fit.loss.sum()))
            for c in self.found.tried
        )
        return Exhibits(traces, (*self.ladder, ("noise floor", 1.0)), regimes, correlation, candidates)


def _on_throttle(effect: str) -> bool:
    return any(word in effect for word in THROTTLE_WORDS)


def _correlation(shots: Shots, config: SimulatorConfig, channel: str) -> tuple[FloatArray, FloatArray, float]:
    """Correlation of the missing acceleration with the rate of a command at lags [s], and its 99 % bound."""
    error = errors(Predictor(shots, config)(), shots)[0]
    step = min(max(round(0.2 / shots.period_s), 1), shots.steps)
    column = 5 if channel == "steering" else 3
    missing = -error[:, step, column] / (step * shots.period_s)
    command = shots.history[:, :, 0 if channel == "steering" else 1]
    lags = np.arange(0, command.shape[1] - 1)
    values = []
    for lag in lags:
        rate = command[:, -1 - lag] - command[:, -2 - lag]
        values.append(float(np.corrcoef(rate, missing)[0, 1]) if rate.std() > 1e-9 else 0.0)
    blocks = len(np.unique(shots.block))
    return lags * shots.period_s, np.array(values), 2.58 / math.sqrt(max(blocks, 1))


def _trace(track: Track, models: Mapping[str, SimulatorConfig]) -> Trace | None:
    """Predictions along a track, restarted every horizon; None where the car does not move long enough."""
    period_s = track.period_s
    try:
        shots = cut([track], HORIZON_S, HORIZON_S)
    except DataError:
        return None
    predicted = {}
    worst: list[tuple[float, float]] = []
    for name, config in models.items():
        rows = np.full_like(track.states, np.nan)
        out = Predictor(shots, config)()
        for k, row in enumerate(shots.row):
            rows[row : row + shots.steps] = out[0, k, : shots.steps]
        predicted[name] = rows
        if name == "refit":
            final = np.linalg.norm(errors(out, shots)[0, :, -1, :2], axis=1)
            span_s = shots.steps * period_s
            worst = [(float(shots.t0_s[k]), float(shots.t0_s[k] + span_s)) for k in np.argsort(-final)[:3]]
    return Trace(f"recording {track.recording + 1}", track.t_s, track.states, predicted, tuple(sorted(worst)))
