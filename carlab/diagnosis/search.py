"""Which effects are missing: a projected screen of all candidates, joint refits, duels on unseen blocks, and moves.

Every candidate is refitted together with the base parameters, because base parameters absorb most of any effect.
What decides is the likelihood of blocks of the recording that were not fitted (two folds), with a standard error
that takes the shots of a block as one observation.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from carlab.core.quantities import FloatArray
from carlab.diagnosis.fit import (
    HUBER,
    Fit,
    Fitter,
    Free,
    Scale,
    base_parameters,
    clustered_gain,
    effect_parameters,
    huber,
    with_effect,
)
from carlab.diagnosis.prediction import Predictor, errors
from carlab.diagnosis.shots import Shots
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.effects import EFFECTS

log = logging.getLogger(__name__)

SIZES = (0.1, 0.3, 1.0, 2.5)
REFITTED = 7
ACCEPT_STANDARD_ERRORS = 3.0
ACCEPT_SHARE = 0.01
SET_STANDARD_ERRORS = 2.0
MAX_EFFECTS = 6
Progress = Callable[[str, float], None]


@dataclass(frozen=True, slots=True)
class Candidate:
    """An effect tried beside those already found: in-sample fit, and gain on unseen blocks with its standard error."""

    effect: str
    fit: Fit
    gain: float
    unseen_gain: float = 0.0
    unseen_error: float = math.inf
    unseen_loss: FloatArray = field(default_factory=lambda: np.zeros(0))

    @property
    def standard_errors(self) -> float:
        """Unseen gain in standard errors."""
        return self.unseen_gain / self.unseen_error


@dataclass(frozen=True, slots=True)
class Step:
    """One accepted effect and the rivals that came close."""

    chosen: Candidate
    rivals: tuple[Candidate, ...]


@dataclass(frozen=True, slots=True)
class SearchResult:
    """base: the refit without effects; best: with the effects found; steps: in the order of acceptance."""

    base: Fit
    best: Fit
    effects: tuple[str, ...]
    steps: tuple[Step, ...]
    tried: tuple[Candidate, ...]
    scale: Scale


class Search:
    """Looks for effects that ``nominal`` lacks, on ``shots`` with a noise floor (6,) by channel.

    Args:
        nominal: the car file's simulator; effects it already has stay, with their numbers fitted.
        shots: of the recordings to fit.
        floor: standard deviation of each channel's error that a perfect simulator would leave.
        look_alikes: by effect id, the effects that may be taken for it.
        allowed: effects to try; all of the catalogue unless given.
        progress: told what is being done and how much of it is done, in [0, 1].
        stop: asked between fits; once true, the search ends with what it has accepted.
    """

    def __init__(
        self,
        nominal: SimulatorConfig,
        shots: Shots,
        floor: FloatArray,
        look_alikes: Mapping[str, Sequence[str]],
        allowed: Sequence[str] | None = None,
        progress: Progress = lambda what, share: None,
        stop: Callable[[], bool] = lambda: False,
    ) -> None:
        self.stop = stop
        self.nominal = nominal
        self.shots = shots
        self.floor = floor
        self.look_alikes = look_alikes
        self.allowed = tuple(EFFECTS) if allowed is None else tuple(allowed)
        self.progress = progress
        self.base_free = base_parameters(nominal)
        # Folds of alternating blocks of ten seconds; a shot near a border belongs to one of them alone.
        parity = (shots.block // 2) % 2
        self.folds = (parity == 0, parity == 1)

    def run(self) -> SearchResult:
        """Search until nothing more is gained."""
        self.progress("refit of the base parameters", 0.0)
        base, scale = self._settled(self.nominal, self._free(()))
        best, steps = base, list[Step]()
        effects: tuple[str, ...] = ()
        tried: tuple[Candidate, ...] = ()
        while len(effects) < MAX_EFFECTS and not self.stop():
            self.progress(f"looking for effect {len(effects) + 1}", len(effects) / MAX_EFFECTS)
            found = self._next(best, effects, scale)
            if not effects:
                tried = tuple(found)
            if self.stop() or not found or not self._accepts(found[0], best, effects, scale):
                break
            leader = found[0]
            steps.append(Step(leader, tuple(self._rivals(leader, found[1:]))))
            effects = (*effects, leader.effect)
            best, scale = self._settled(leader.fit.config, leader.fit.free, leader.fit.z)
            effects, best, scale, steps = self._pruned(effects, best, scale, steps)
        return SearchResult(base, best, tuple(effects), tuple(steps), tried, scale)

    # -- pieces ---------------------------------------------------------------------------------------------------

    def _free(self, effects: Sequence[str]) -> tuple[Free, ...]:
        own = [f for name in self.nominal.effects for f in effect_parameters(name, self.nominal)]
        return (*self.base_free, *own, *(f for name in effects for f in effect_parameters(name, self.nominal)))

    def _config(self, effects: Sequence[str]) -> SimulatorConfig:
        config = self.nominal
        for name in effects:
            config = with_effect(config, name)
        return config

    def _settled(
        self, config: SimulatorConfig, free: tuple[Free, ...], z: FloatArray | None = None
    ) -> tuple[Fit, Scale]:
        """Fit, and let the scale of the errors settle with it."""
        start = self._own_start(free) if z is None else z
        error = errors(Predictor(self.shots, config)(_values(free, start)), self.shots)[0]
        scale = Scale.of(error, self.floor)
        for _ in range(3):
            fit = Fitter(self.shots, scale).fit(config, free, start)
            start = fit.z
            error = errors(Predictor(self.shots, fit.config)(), self.shots)[0]
            scale = Scale.of(error, self.floor)
        return Fitter(self.shots, scale).fit(config, free, start), scale

    def _own_start(self, free: Sequence[Free]) -> FloatArray:
        values = self.nominal.values()
        return np.array([f.coordinate(values[f.name]) if f.name in values else 0.0 for f in free])

    def _next(self, best: Fit, effects: Sequence[str], scale: Scale) -> list[Candidate]:
        """Candidates refitted beside ``effects``, the best on unseen blocks first."""
        screened = self._screen(best, effects, scale)
        names = [name for name, _, _ in screened[:REFITTED]]
        for name, _, _ in screened[:2]:
            names += [n for n in self.look_alikes.get(name, ()) if n in self.allowed and n not in (*names, *effects)]
        starts = {name: start for name, _, start in screened}
        fitter = Fitter(self.shots, scale)
        found = []
        for k, name in enumerate(names):
            self.progress(f"refitting with {name}", (len(effects) + 0.5 * k / len(names)) / MAX_EFFECTS)
            if name not in starts or self.stop():
                continue
            config = self._config((*effects, name))
            free = self._free((*effects, name))
            fit = fitter.fit(config, free, np.concatenate([best.z, starts[name]]))
            found.append(Candidate(name, fit, best.cost - fit.cost))
        found.sort(key=lambda c: -c.gain)
        reference = self._unseen(self._config(effects), best.free, best.z, scale)
        judged = []
        for k, candidate in enumerate(found):
            close = candidate.gain > 0.3 * found[0].gain or k < 2
            if not close or self.stop():
                judged.append(candidate)
                continue
            self.progress(f"testing {candidate.effect} on unseen blocks", (len(effects) + 0.7) / MAX_EFFECTS)
            loss = self._unseen(self._config((*effects, candidate.effect)), candidate.fit.free, candidate.fit.z, scale)
            gain, error = clustered_gain(reference, loss, self.shots)
            judged.append(Candidate(candidate.effect, candidate.fit, candidate.gain, gain, error, loss))
        judged.sort(key=lambda c: -c.unseen_gain)
        return judged

    def _screen(self, best: Fit, effects: Sequence[str], scale: Scale) -> list[tuple[str, float, FloatArray]]:
        """Gain that each candidate promises when the present parameters are free to follow, and where it starts.

        The error changes by a secant g when the candidate is switched on at some size; what the present parameters
        could do themselves (their Jacobian) is projected out of it (a score test at finite size: Rao 1948).
        """
        fitter = Fitter(self.shots, scale)
        count, step = len(best.free), 0.02
        config = self._config(effects)
        whites = fitter.white(config, best.free, np.vstack([best.z, best.z + step * np.eye(count)]))
        white = whites[0].reshape(-1)
        weight = np.sqrt(np.minimum(1.0, HUBER / np.maximum(np.abs(white), 1e-12)))
        jacobian = ((whites[1:].reshape(count, -1) - white) / step * weight).T
        prior = np.diag([1.0 / f.prior_z for f in best.free])
        basis, _ = np.linalg.qr(np.vstack([jacobian, prior]))
        inside = basis[: len(white)]
        residual = weight * white
        residual = residual - inside @ (inside.T @ residual)
        found = []
        for name in self.allowed:
            if name in effects or name in self.nominal.effects:
                continue
            free = effect_parameters(name, self.nominal)
            starts = _starts(free)
            trial_free = (*best.free, *free)
            trial_config = self._config((*effects, name))
            points = np.hstack([np.tile(best.z, (len(starts), 1)), starts])
            promised, chosen = -math.inf, starts[0]
            for part in np.array_split(np.arange(len(starts)), max(1, math.ceil(len(starts) / 8))):
                for k, moved in zip(part, fitter.white(trial_config, trial_free, points[part]), strict=True):
                    secant = weight * np.clip(moved.reshape(-1) - white, -50.0, 50.0)
                    left = secant - inside @ (inside.T @ secant)
                    size = float(left @ left)
                    slope = -float(left @ residual)
                    along = min(max(slope / max(size, 1e-12), 0.0), 2.0)
                    gain = along * slope - 0.5 * along**2 * size
                    if gain > promised:
                        promised, chosen = gain, starts[k] * min(max(along, 0.3), 1.5)
            found.append((name, promised, chosen))
        found.sort(key=lambda item: -item[1])
        return found

    def _unseen(self, config: SimulatorConfig, free: tuple[Free, ...], z: FloatArray, scale: Scale) -> FloatArray:
        """Loss of every shot (S,) by a fit that has not seen its block."""
        loss = np.zeros(len(self.shots))
        for fold in self.folds:
            if not fold.any() or fold.all():
                return Fitter(self.shots, scale).loss(config, free, z)
            fit = Fitter(self.shots.take(~fold), scale).fit(config, free, z, iterations=6)
            loss[fold] = Fitter(self.shots.take(fold), scale).loss(config, fit.free, fit.z)
        return loss

    def _accepts(self, leader: Candidate, best: Fit, effects: Sequence[str], scale: Scale) -> bool:
        share = leader.unseen_gain / max(float(best.loss.sum()), 1e-9)
        log.info(
            "%s: unseen gain %.1f (%.1f standard errors)", leader.effect, leader.unseen_gain, leader.standard_errors
        )
        return leader.standard_errors > ACCEPT_STANDARD_ERRORS and share > ACCEPT_SHARE

    def _rivals(self, leader: Candidate, others: Sequence[Candidate]) -> list[Candidate]:
        """Look-alikes that unseen blocks do not tell from the leader."""
        close = []
        for other in others:
            if other.effect not in self.look_alikes.get(leader.effect, ()) or not len(other.unseen_loss):
                continue
            gap, error = clustered_gain(other.unseen_loss, leader.unseen_loss, self.shots)
            if gap < SET_STANDARD_ERRORS * error and other.standard_errors > ACCEPT_STANDARD_ERRORS:
                close.append(other)
        return close[:2]

    def _pruned(
        self, effects: tuple[str, ...], best: Fit, scale: Scale, steps: list[Step]
    ) -> tuple[tuple[str, ...], Fit, Scale, list[Step]]:
        """Take out again what the rest makes needless: the first effect accepted is often a proxy."""
        while len(effects) > 1:
            full = self._unseen(self._config(effects), best.free, best.z, scale)
            worst: tuple[float, str, Fit] | None = None
            for name in effects[:-1]:
                rest = tuple(e for e in effects if e != name)
                keep = [k for k, f in enumerate(best.free) if not f.name.startswith(f"effects.{name}.")]
                free = self._free(rest)
                start = np.array([best.z[[f.name for f in best.free].index(f.name)] for f in free])
                assert len(keep) == len(free)
                fit = Fitter(self.shots, scale).fit(self._config(rest), free, start)
                gain, error = clustered_gain(self._unseen(self._config(rest), free, fit.z, scale), full, self.shots)
                if gain / error < SET_STANDARD_ERRORS and (worst is None or gain / error < worst[0]):
                    worst = (gain / error, name, fit)
            if worst is None:
                break
            _, name, fit = worst
            log.info("%s is no longer needed", name)
            effects = tuple(e for e in effects if e != name)
            steps = [s for s in steps if s.chosen.effect != name]
            best, scale = self._settled(self._config(effects), fit.free, fit.z)
        return effects, best, scale, steps


def _values(free: Sequence[Free], z: FloatArray) -> dict[str, FloatArray]:
    return {f.name: np.atleast_1d(f.value(np.asarray(v))) for f, v in zip(free, z, strict=True)}


def _starts(free: Sequence[Free]) -> FloatArray:
    """Coordinates (P, n) at which a candidate is tried: several sizes, both signs where there are two."""
    grids = []
    for f in free:
        if f.logarithmic:
            grids.append([math.log(r) / f.size for r in (0.25, 0.5, 1.0, 2.0, 4.0)])
        elif f.low < f.origin:
            grids.append([s * sign for s in SIZES for sign in (1.0, -1.0)])
        else:
            grids.append(list(SIZES))
    if len(free) == 1:
        return np.array(grids[0])[:, None]
    if len(free) == 2:
        return np.array([(a, b) for a in [*grids[0], 0.0][::2] for b in [*grids[1], 0.0][::2] if (a, b) != (0.0, 0.0)])
    rng = np.random.default_rng(0)
    return np.array([[rng.choice(g) for g in grids] for _ in range(24)])


__all__ = ["Candidate", "Search", "SearchResult", "Step", "huber"]
