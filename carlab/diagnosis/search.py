"""Which effects are missing: a projected screen of all candidates, joint refits, duels on unseen blocks, and moves.

Every candidate is refitted together with the base parameters, because base parameters absorb most of any effect.
Its gain in likelihood is divided by how much the dependence of neighbouring errors overstates it (the sandwich
covariance over the naive one; Kent 1982), and must hold on blocks of the recording that were not fitted.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from carlab.core.quantities import FloatArray
from carlab.diagnosis.duels import CLOSE, UNSEEN_AT_MOST, deletions, duels, pruned
from carlab.diagnosis.fit import (
    Fit,
    Fitter,
    Free,
    Scale,
    base_parameters,
    clustered_gain,
    effect_parameters,
    inflation_of,
    with_effect,
)
from carlab.diagnosis.prediction import Predictor, errors
from carlab.diagnosis.screen import SCREENED_SHOTS, Promise, Screen, usable
from carlab.diagnosis.shots import Shots
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.effects import CATALOGUE, EFFECTS

log = logging.getLogger(__name__)

REFITTED = 10
FOLDS = 6
WORTH = 0.1
"""Candidates that promise less than this share of the best promise are not refitted."""
ACCEPT_CHI2 = 25.0
ACCEPT_CHI2_MORE = 8.0
"""For every further number of the effect, and where its identity is infinite: so many more places to overfit."""
ACCEPT_SHARE = 0.015
"""Unseen gain, as a share of the loss that a perfect simulator would leave."""
ACCEPT_UNSEEN = 0.3
"""Unseen gain, as a share of the gain on the blocks that were fitted."""
STEADY_STANDARD_ERRORS = 3.0
STEADY_SHARE = 0.03
"""An unseen gain of this size that is alike in all blocks also convinces."""
KEEP_CHI2 = 16.0
HOPELESS_CHI2 = 8.0
"""Candidates that promise less than this are not refitted."""
MAX_EFFECTS = 10
SWAP_PROMISE = 0.7
"""A look-alike that promises this share of an effect's gain is tried in its place."""
SETTLED = 0.03
"""Relative change of the scale of errors below which it has settled."""
Progress = Callable[[str, float], None]


@dataclass(frozen=True, slots=True)
class Candidate:
    """An effect tried beside those already found.

    gain: fall of the loss, in sample. chi2: twice the gain over its inflation. unseen_gain and unseen_error: on blocks
    that were not fitted, with the clustered standard error; unseen_loss (S,) of each shot, empty where not tried.
    """

    effect: str
    fit: Fit
    gain: float
    chi2: float = 0.0
    unseen_gain: float = -math.inf
    unseen_error: float = math.inf
    unseen_loss: FloatArray = field(default_factory=lambda: np.zeros(0))

    @property
    def standard_errors(self) -> float:
        """Unseen gain in standard errors."""
        return self.unseen_gain / self.unseen_error if math.isfinite(self.unseen_error) else 0.0


@dataclass(frozen=True, slots=True)
class SearchResult:
    """What a search found.

    base: the refit without effects; best: with the effects found, strongest first; chi2: of each of them, taken out of
    the whole; rivals: look-alikes that do as well in its place; history: (effect, fit) as they were accepted;
    tried: candidates for the first effect.
    """

    base: Fit
    best: Fit
    effects: tuple[str, ...]
    chi2: Mapping[str, float]
    rivals: Mapping[str, tuple[str, ...]]
    history: tuple[tuple[str, Fit], ...]
    tried: tuple[Candidate, ...]
    scale: Scale

    def without_effects(self) -> SearchResult:
        """The same search where no name is believed."""
        return replace(self, best=self.base, effects=(), chi2={}, rivals={}, history=())


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
        self.allowed = tuple(CATALOGUE) if allowed is None else tuple(allowed)
        self.progress = progress
        self.base_free = base_parameters(nominal)
        blocks = np.unique(shots.block)
        self.folds = np.searchsorted(blocks, shots.block) % min(FOLDS, max(len(blocks), 1))

    def run(self) -> SearchResult:
        """Search until nothing more is gained."""
        self.progress("refit of the base parameters", 0.0)
        base, scale = self._settled(self.nominal, self.free_with(()))
        best, history = base, list[tuple[str, Fit]]()
        effects: tuple[str, ...] = ()
        tried: tuple[Candidate, ...] = ()
        while len(effects) < MAX_EFFECTS and not self.stop():
            self.progress(f"looking for effect {len(effects) + 1}", len(effects) / MAX_EFFECTS)
            found = self._next(best, effects, scale)
            if not effects:
                tried = tuple(found)
            leader = next((c for c in found if self._accepts(c)), None)
            if self.stop() or leader is None:
                break
            log.info("accepted %s", leader.effect)
            before = effects
            effects = (*effects, leader.effect)
            best, scale = self._settled(leader.fit.config, leader.fit.free, leader.fit.z)
            effects, best, scale = self._moved(effects, best, scale)
            history.append((leader.effect, best))
            if set(effects) == set(before):
                break
        effects, best, apart = pruned(self, effects, best, scale)
        chi2, rivals = duels(self, effects, best, scale, apart)
        ordered = tuple(sorted(effects, key=lambda e: -chi2[e]))
        return SearchResult(base, best, ordered, chi2, rivals, tuple(history), tried, scale)

    def only(self, found: SearchResult, names: tuple[str, ...]) -> SearchResult:
        """What was found, with these of its names alone."""
        if not names:
            return found.without_effects()
        fit = self.refit(names, found.best, found.scale)
        chi2, rivals = duels(self, names, fit, found.scale, deletions(self, names, fit, found.scale))
        history = tuple((name, step) for name, step in found.history if name in names)
        return replace(found, best=fit, effects=names, chi2=chi2, rivals=rivals, history=history)

    # -- pieces ---------------------------------------------------------------------------------------------------

    def free_with(self, effects: Sequence[str]) -> tuple[Free, ...]:
        """The numbers that a fit with ``effects`` moves."""
        own = [f for name in self.nominal.effects for f in effect_parameters(name, self.nominal)]
        return (*self.base_free, *own, *(f for name in effects for f in effect_parameters(name, self.nominal)))

    def config_with(self, effects: Sequence[str]) -> SimulatorConfig:
        """The simulator with ``effects`` switched on, doing nothing yet."""
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
        for _ in range(4):
            fit = Fitter(self.shots, scale).fit(config, free, start)
            start = fit.z
            error = errors(Predictor(self.shots, fit.config)(), self.shots)[0]
            before, scale = scale, Scale.of(error, self.floor)
            if np.abs(scale.sigma / before.sigma - 1.0).max() < SETTLED:
                return fit, before
        return Fitter(self.shots, scale).fit(config, free, start), scale

    def _own_start(self, free: Sequence[Free]) -> FloatArray:
        values = self.nominal.values()
        return np.array([f.coordinate(values[f.name]) if f.name in values else 0.0 for f in free])

    def _next(self, best: Fit, effects: Sequence[str], scale: Scale) -> list[Candidate]:
        """Candidates refitted beside ``effects``: those tried on unseen blocks first, the best of them first."""
        fitter = Fitter(self.shots, scale)
        promises = {p.effect: p for p in self._screen(best, effects, scale)}
        if not promises:
            return []
        top = max(p.gain for p in promises.values())
        least = 0.5 * HOPELESS_CHI2 * fitter.with_covariance(best).inflation
        names = [n for n, p in promises.items() if p.gain > max(WORTH * top, least)][:REFITTED]
        for name in names[:3]:
            names += [n for n in self.look_alikes.get(name, ()) if n in promises and n not in names]
        found = []
        for k, name in enumerate(names):
            self.progress(f"refitting with {name}", (len(effects) + 0.5 * k / len(names)) / MAX_EFFECTS)
            if self.stop():
                break
            found.append(self.refitted(fitter, best, (*effects, name), promises[name]))
        found.sort(key=lambda c: -c.gain)
        if not found:
            return []
        reference = fitter.unseen(best, self.folds, UNSEEN_AT_MOST)
        judged = []
        for k, candidate in enumerate(found):
            if self.stop() or (candidate.gain < CLOSE * found[0].gain and k >= 2):
                judged.append(candidate)
                continue
            self.progress(f"testing {candidate.effect} on unseen blocks", (len(effects) + 0.7) / MAX_EFFECTS)
            judged.append(self._tested(fitter, candidate, reference))
        judged.sort(key=lambda c: (not len(c.unseen_loss), -(c.gain + c.unseen_gain)))
        for c in judged:
            if len(c.unseen_loss):
                log.info(
                    "CAND %d %s gain %.1f chi2 %.1f need %.0f unseen %.1f (%.1f se) share %.3f %s",
                    len(effects), c.effect, c.gain, c.chi2, self._needed(c.effect), c.unseen_gain, c.standard_errors,
                    c.unseen_gain / self._expected(),
                    {k: round(v, 4) for k, v in c.fit.values().items() if k.startswith("effects." + c.effect)},
                )  # fmt: skip
        return judged

    def refitted(self, fitter: Fitter, best: Fit, effects: tuple[str, ...], promise: Promise) -> Candidate:
        """Fit ``effects``, the last of them from where it promised most beside ``best``."""
        config, free = self.config_with(effects), self.free_with(effects)
        starts = [np.concatenate([best.z, s]) for s in promise.starts]
        if len(starts) > 1:
            tries = [fitter.fit(config, free, s, iterations=3) for s in starts]
            starts = [min(tries, key=lambda f: f.cost).z]
        fit = fitter.fit(config, free, starts[0])
        return Candidate(promise.effect, fit, best.cost - fit.cost)

    def _tested(self, fitter: Fitter, candidate: Candidate, reference: FloatArray) -> Candidate:
        fit = fitter.with_covariance(candidate.fit)
        loss = fitter.unseen(fit, self.folds, UNSEEN_AT_MOST)
        gain, error = clustered_gain(reference, loss, self.shots)
        chi2 = 2.0 * candidate.gain / inflation_of(fit, candidate.effect)
        return Candidate(candidate.effect, fit, candidate.gain, chi2, gain, error, loss)

    def _screen(self, best: Fit, effects: Sequence[str], scale: Scale) -> list[Promise]:
        """What each candidate promises beside ``effects``, the best first."""
        screen = Screen(Fitter(self.shots, scale), self.config_with(effects), best, SCREENED_SHOTS)
        found = []
        for name in self.allowed:
            if name in effects or not self.tries(name):
                continue
            found.append(screen.promise(name, effect_parameters(name, self.nominal)))
        found.sort(key=lambda p: -p.gain)
        return found

    def _expected(self) -> float:
        """Loss of a perfect simulator: half for each whitened error."""
        return 0.5 * len(self.shots) * 36

    def tries(self, effect: str) -> bool:
        """Whether an effect may be tried at all."""
        return effect in self.allowed and effect not in self.nominal.effects and usable(self.nominal, effect)

    def _needed(self, effect: str) -> float:
        """What chi2 must exceed."""
        numbers = [p for p in EFFECTS[effect].parameters if not p.choices]
        infinite = any(p.identity is not None and math.isinf(p.identity) for p in numbers)
        return ACCEPT_CHI2 + ACCEPT_CHI2_MORE * (len(numbers) - 1 + infinite)

    def _accepts(self, candidate: Candidate) -> bool:
        if not len(candidate.unseen_loss) or candidate.unseen_gain < ACCEPT_UNSEEN * candidate.gain:
            return False
        share = candidate.unseen_gain / self._expected()
        sure = candidate.chi2 > self._needed(candidate.effect) and share > ACCEPT_SHARE
        return sure or (candidate.standard_errors > STEADY_STANDARD_ERRORS and share > STEADY_SHARE)

    def refit(self, effects: tuple[str, ...], like: Fit, scale: Scale) -> Fit:
        """Fit with ``effects``, from the numbers that ``like`` has of them."""
        free = self.free_with(effects)
        known = {f.name: float(z) for f, z in zip(like.free, like.z, strict=True)}
        start = np.array([known.get(f.name, 0.0) for f in free])
        return Fitter(self.shots, scale).fit(self.config_with(effects), free, start)

    def _moved(self, effects: tuple[str, ...], best: Fit, scale: Scale) -> tuple[tuple[str, ...], Fit, Scale]:
        """Take out or swap what others do better: the first effect accepted is often a proxy."""
        if len(effects) < 2 or self.stop():
            return effects, best, scale
        fitter = Fitter(self.shots, scale)
        for name in effects[:-1]:
            rest = tuple(e for e in effects if e != name)
            without = self.refit(rest, best, scale)
            chi2 = 2.0 * (without.cost - best.cost) / inflation_of(fitter.with_covariance(best), name)
            if chi2 < KEEP_CHI2:
                log.info("%s is no longer needed (%.1f)", name, chi2)
                kept, scale = self._settled(self.config_with(rest), without.free, without.z)
                return self._moved(rest, kept, scale)
            screen = Screen(fitter, self.config_with(rest), without, SCREENED_SHOTS)
            for other_name in self.look_alikes.get(name, ()):
                if self.stop() or other_name in effects or not self.tries(other_name):
                    continue
                promise = screen.promise(other_name, effect_parameters(other_name, self.nominal))
                if promise.gain < SWAP_PROMISE * (without.cost - best.cost):
                    continue
                other = self.refitted(fitter, without, (*rest, promise.effect), promise)
                deflated = (
                    2.0 * (best.cost - other.fit.cost) / inflation_of(fitter.with_covariance(other.fit), promise.effect)
                )
                if deflated > KEEP_CHI2:
                    log.info("%s takes the place of %s (%.1f)", promise.effect, name, deflated)
                    fit, scale = self._settled(other.fit.config, other.fit.free, other.fit.z)
                    return (*rest, promise.effect), fit, scale
        return effects, best, scale


def _values(free: Sequence[Free], z: FloatArray) -> dict[str, FloatArray]:
    return {f.name: np.atleast_1d(f.value(np.asarray(v))) for f, v in zip(free, z, strict=True)}


__all__ = ["Candidate", "Search", "SearchResult"]
