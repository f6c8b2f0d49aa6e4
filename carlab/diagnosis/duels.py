"""What becomes of a model when one of its effects is taken out, or a look-alike takes its place, on unseen blocks."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from carlab.diagnosis.fit import Fit, Fitter, Scale, clustered_gain, effect_parameters, inflation_of
from carlab.diagnosis.screen import SCREENED_SHOTS, Screen

if TYPE_CHECKING:
    from carlab.diagnosis.search import Search

log = logging.getLogger(__name__)

UNSEEN_AT_MOST = 12.0
"""Standard deviations beyond which an error on an unseen block counts no more: one spin must not decide."""
KEEP_STANDARD_ERRORS = 1.2
"""An effect among several that unseen blocks miss by less than this is taken out again."""
SET_STANDARD_ERRORS = 2.0
CLOSE = 0.3
"""Candidates that gain less than this share of the best gain are not tried on unseen blocks."""


@dataclass(frozen=True, slots=True)
class Deletion:
    """A model without one of its effects: its fit, and how much unseen blocks miss the effect, in standard errors."""

    without: Fit
    standard_errors: float


def deletions(search: Search, effects: tuple[str, ...], best: Fit, scale: Scale) -> dict[str, Deletion]:
    """Each effect taken out, everything else fitted again."""
    if not effects:
        return {}
    fitter = Fitter(search.shots, scale)
    own = fitter.unseen(best, search.folds, UNSEEN_AT_MOST)
    found = {}
    for name in effects:
        search.progress(f"without {name}", 0.93)
        without = search.refit(tuple(e for e in effects if e != name), best, scale)
        gap, error = clustered_gain(fitter.unseen(without, search.folds, UNSEEN_AT_MOST), own, search.shots)
        found[name] = Deletion(without, gap / error)
    return found


def pruned(
    search: Search, effects: tuple[str, ...], best: Fit, scale: Scale
) -> tuple[tuple[str, ...], Fit, dict[str, Deletion]]:
    """Effects that unseen blocks miss, the fit with them, and each of them taken out."""
    apart = deletions(search, effects, best, scale)
    while len(effects) > 1 and not search.stop():
        weakest = min(apart, key=lambda name: apart[name].standard_errors)
        if apart[weakest].standard_errors >= KEEP_STANDARD_ERRORS:
            break
        log.info("%s is not missed (%.1f standard errors)", weakest, apart[weakest].standard_errors)
        effects, best = tuple(e for e in effects if e != weakest), apart[weakest].without
        apart = deletions(search, effects, best, scale)
    return effects, best, apart


def duels(
    search: Search, effects: tuple[str, ...], best: Fit, scale: Scale, apart: Mapping[str, Deletion]
) -> tuple[dict[str, float], dict[str, tuple[str, ...]]]:
    """How much each effect is needed (chi2), and which look-alikes unseen blocks do not tell from it."""
    chi2: dict[str, float] = {}
    rivals: dict[str, tuple[str, ...]] = {}
    if not effects:
        return chi2, rivals
    fitter = Fitter(search.shots, scale)
    whole = fitter.with_covariance(best)
    own = fitter.unseen(best, search.folds, UNSEEN_AT_MOST)
    for name in effects:
        rest = tuple(e for e in effects if e != name)
        without = apart[name].without
        chi2[name] = 2.0 * (without.cost - best.cost) / inflation_of(whole, name)
        others = [o for o in search.look_alikes.get(name, ()) if o not in effects and search.tries(o)]
        close = []
        screen = Screen(fitter, search.config_with(rest), without, SCREENED_SHOTS)
        for other in others:
            if search.stop():
                break
            search.progress(f"{name} or {other}?", 0.95)
            promise = screen.promise(other, effect_parameters(other, search.nominal))
            rival = search.refitted(fitter, without, (*rest, other), promise)
            if rival.gain < CLOSE * (without.cost - best.cost):
                continue
            loss = fitter.unseen(rival.fit, search.folds, UNSEEN_AT_MOST)
            gap, error = clustered_gain(loss, own, search.shots)
            log.info("duel %s - %s: %.1f (%.1f se)", name, other, gap, gap / error)
            if gap < SET_STANDARD_ERRORS * error:
                close.append((gap, other))
        rivals[name] = tuple(o for _, o in sorted(close)[:2])
    return chi2, rivals


__all__ = ["CLOSE", "UNSEEN_AT_MOST", "Deletion", "deletions", "duels", "pruned"]
