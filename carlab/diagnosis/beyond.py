"""Physics outside the catalogue as rivals of the names: a name is not given to what one of them explains as well.

They are fitted like any effect (``sim_backends.effects.uncatalogued``) but never named; where one of them is what the
recordings call for, its sentence makes the class statement.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

from carlab.diagnosis.fit import Fit, Fitter, effect_parameters
from carlab.diagnosis.screen import SCREENED_SHOTS, Promise, Screen
from carlab.diagnosis.search import Candidate, Search, SearchResult
from sim_backends.effects import EFFECTS
from sim_backends.effects.uncatalogued import UNCATALOGUED

log = logging.getLogger(__name__)

REFITTED = 2
PROMISING = 0.6
"""Share of the names' gain that a rival must promise to be fitted."""
NUMBER_COSTS = 4.0
"""Twice the inflated gain that every further number of a rival must be worth."""
FEW = 2
"""Up to so many names are questioned one by one, and up to twice as many together."""


@dataclass(frozen=True, slots=True)
class Outside:
    """Physics outside the catalogue that a fit calls for.

    fit: with it, and with ``names`` of the catalogue beside it; gain: fall of the cost by it.
    """

    effect: str
    fit: Fit
    gain: float
    names: tuple[str, ...] = ()

    def words(self) -> str:
        """The class statement."""
        return EFFECTS[self.effect].class_statement

    def formula(self) -> str:
        """Its numbers."""
        values = self.fit.values()
        numbers = ((p.name, values[f"effects.{self.effect}.{p.name}"], p.unit) for p in EFFECTS[self.effect].parameters)
        return f"{self.effect}: " + ", ".join(f"{name} {value:.3g} {unit}".strip() for name, value, unit in numbers)


def instead(search: Search, found: SearchResult) -> Outside | None:
    """What explains as much as the names of ``found``, or as one of them beside the other; None where nothing does."""
    names = found.effects
    if not names or len(names) > 2 * FEW or search.stop():
        return None
    fitter = Fitter(search.shots, found.scale)
    inflation = fitter.with_covariance(found.best).inflation
    single = names if 1 < len(names) <= FEW else ()
    for gone in (names, *((name,) for name in single)):
        rest = tuple(n for n in names if n not in gone)
        without = search.refit(rest, found.best, found.scale)
        numbers = sum(len(EFFECTS[n].parameters) for n in gone)
        for rival in _fitted(search, fitter, without, rest, PROMISING * (without.cost - found.best.cost)):
            more = len(EFFECTS[rival.effect].parameters) - numbers
            ahead = found.best.cost - rival.fit.cost - 0.5 * NUMBER_COSTS * inflation * more
            log.info("BEYOND %s instead of %s: ahead by %.1f", rival.effect, ", ".join(gone), ahead)
            if ahead > 0.0:
                return Outside(rival.effect, rival.fit, rival.gain, rest)
    return None


def beside(search: Search, found: SearchResult, least_chi2: float) -> Outside | None:
    """What the fit with all names of ``found`` still calls for, with at least so much inflated twofold gain."""
    if search.stop():
        return None
    fitter = Fitter(search.shots, found.scale)
    least = 0.5 * least_chi2 * fitter.with_covariance(found.best).inflation
    best = found.best if found.effects else search.refit((), found.base, found.scale)
    rivals = _fitted(search, fitter, best, found.effects, least)
    best_rival = max(rivals, key=lambda c: c.gain, default=None)
    if best_rival is None or best_rival.gain < least:
        return None
    log.info("BEYOND %s beside: gain %.1f", best_rival.effect, best_rival.gain)
    return Outside(best_rival.effect, best_rival.fit, best_rival.gain, found.effects)


def _fitted(search: Search, fitter: Fitter, best: Fit, names: tuple[str, ...], least: float) -> list[Candidate]:
    """Rivals that promise at least so much beside ``names``, fitted; the best two."""
    screen = Screen(fitter, search.config_with(names), best, SCREENED_SHOTS)
    promises: Sequence[Promise] = [
        screen.promise(e.id, effect_parameters(e.id, search.nominal))
        for e in UNCATALOGUED if e.id not in search.nominal.effects
    ]  # fmt: skip
    chosen = sorted((p for p in promises if p.gain > least), key=lambda p: -p.gain)[:REFITTED]
    return [search.refitted(fitter, best, (*names, p.effect), p) for p in chosen]


__all__ = ["Outside", "beside", "instead"]
