"""Which of the names that a search found are believed, and what is said where none is.

A name must not be forced upon physics that has none. It is taken back where physics outside the catalogue explains as
much in its place, where terms without a name explain much beside or instead of it, or where the held-out recordings
are predicted worse with it than without.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np

from carlab.core.quantities import FloatArray
from carlab.diagnosis.beyond import Outside, beside, instead
from carlab.diagnosis.findings import Unexplained
from carlab.diagnosis.fit import Fitter
from carlab.diagnosis.scoring import HeldOut
from carlab.diagnosis.search import Search, SearchResult
from carlab.diagnosis.unexplained import Rest, describe, missing_terms, start_features
from carlab.diagnosis.vibration import Vibration
from sim_backends.car_parameters import SimulatorConfig

log = logging.getLogger(__name__)

FORCED_SHARE = 0.1
FORCED_SHARE_MANY = 0.3
MANY_EFFECTS = 3
LEAST_LEFT = 0.04
BETTER_UNNAMED = 1.15
BESIDE_CHI2 = 20.0
"""Physics outside the catalogue that gains so much beside the names is reported."""
WEAK_CHI2 = 14.0
"""Where something is missing for certain, terms of this strength are good enough to describe it."""
SHAKEN_SHARE = 0.02
"""Vibration is what is missing, and not just there too, where its lower bound is this share of the squared excess."""
AS_GOOD = 0.85
"""Physics outside the catalogue describes what is left where it gains this share of what free terms gain."""


@dataclass(frozen=True, slots=True)
class Believed:
    """The names that stand, and beside them terms without a name, physics outside the catalogue, and vibration."""

    found: SearchResult
    left: Rest
    outside: Outside | None
    vibration: Vibration | None

    @property
    def something(self) -> bool:
        """Whether anything is called for beside the names."""
        return bool(self.left.chosen) or self.outside is not None or self.vibration is not None


def believed(search: Search, found: SearchResult, held_out: HeldOut, vibration: Vibration | None) -> Believed:
    """Question the names of ``found``."""
    names = found.effects
    outside = instead(search, found)
    if outside is not None:
        found = search.only(found, outside.names)
    left = missing_terms(search.shots, found.best, found.scale)
    if outside is None:
        outside = beside(search, found, BESIDE_CHI2)
    if found.effects and _forced(search, found, left, outside):
        found = found.without_effects()
    elif found.effects and _contradicted(found, held_out):
        log.info("%s: the held-out recordings are predicted worse with it", ", ".join(found.effects))
        found = found.without_effects()
    if names and not found.effects:
        log.info("%s would be a forced name", ", ".join(names))
        left = missing_terms(search.shots, found.best, found.scale)
        outside = outside if outside is not None and not outside.names else beside(search, found, BESIDE_CHI2)
    return Believed(found, left, outside, vibration)


def _forced(search: Search, found: SearchResult, left: Rest, outside: Outside | None) -> bool:
    """Whether what has no name explains so much that the names would be forced.

    One or two names must leave nearly nothing, and must explain what happens about as well as three terms that have no
    name; a car with many things wrong may keep something that has none.
    """
    shots, scale = search.shots, found.scale
    named = float(Fitter(shots, scale).loss(found.base.config).sum() - found.best.loss.sum())
    few = len(found.effects) < MANY_EFFECTS
    least = LEAST_LEFT * 0.5 * scale.sigma.size * len(shots)
    unnamed = max(left.gain, outside.gain if outside is not None and outside.names == found.effects else 0.0)
    if unnamed > max((FORCED_SHARE if few else FORCED_SHARE_MANY) * (unnamed + named), least):
        return True
    if not few:
        return False
    free = missing_terms(shots, found.base, scale)
    return free.gain > max(BETTER_UNNAMED * named, named + least)


def _contradicted(found: SearchResult, held_out: HeldOut) -> bool:
    """Whether the held-out score and likelihood are both worse with the names than with the refit alone."""
    without, with_names = held_out.final_error(found.base.config), held_out.final_error(found.best.config)
    return held_out.score(with_names) > held_out.score(without) and held_out.gain(without, with_names)[0] < 0.0


def unexplained(
    search: Search, what: Believed, share: float, error: FloatArray, held_out: HeldOut
) -> tuple[Unexplained, SimulatorConfig | None]:
    """What is said of the rest, and the simulator with it where physics outside the catalogue is what it is.

    Args:
        search: with its shots.
        what: the names that stand, and what is left beside them.
        share: of the squared excess that is left.
        error: held-out errors with the names that stand (S, 6).
        held_out: shots and floor.
    """
    left, outside = what.left, what.outside
    if not what.something:
        left = missing_terms(search.shots, what.found.best, what.found.scale, WEAK_CHI2)
    squared = (error / held_out.floor) ** 2
    fall: FloatArray = left.fall / held_out.floor**2
    words, formula = left.words(), left.formula()
    model = None
    if outside is not None and outside.names == what.found.effects and outside.gain > AS_GOOD * left.gain:
        after = held_out.final_error(outside.fit.config)
        if held_out.score(after) < held_out.score(error):
            fall = np.mean(squared - (after / held_out.floor) ** 2, axis=0)
            before_score, after_score = held_out.score(error), held_out.score(after)
            words = f"{outside.words()} (with it in model.toml the score is {after_score:.3g}, not {before_score:.3g})"
            formula, model = outside.formula(), outside.fit.config
    over = np.maximum(squared.mean(axis=0) - 1.0, 0.0)
    if what.vibration is not None:
        shaken = 0.5 * (what.vibration.amplitude / held_out.floor) ** 2
        first = bool(shaken.max() > SHAKEN_SHARE * over.max())
        shaking = [(what.vibration.words(), what.vibration.formula())]
        terms = [(words, formula)] if formula else []
        parts = shaking + terms if first else terms + shaking
        words, formula = ". ".join(w for w, _ in parts), "; ".join(f for _, f in parts)
        fall = over if first else fall
    if fall.max() <= 0.0:
        fall = over
    size: FloatArray = np.sqrt(squared.mean(axis=1))
    return describe(share, words, formula, fall, size, start_features(held_out.shots)), model


__all__ = ["Believed", "believed", "unexplained"]
