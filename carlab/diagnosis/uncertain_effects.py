"""Withdrawal of effects whose numbers do not differ from those without the effect.

The search has windows with estimated initial states, and an effect can follow from the errors of these estimates; a
joint fit of parameters and initial states does not confirm it. A limit that may also be infinite is no finding either.
"""

from __future__ import annotations

import logging
import math

import numpy as np

from carlab.diagnosis.decisions import Condition, Decision
from carlab.diagnosis.evidence import ScoredSearch, estimate
from carlab.diagnosis.selection.problem import RunControl, has_infinite_identity, numbers_of
from carlab.diagnosis.selection.search import restrict
from carlab.diagnosis.settings import EVIDENCE
from sim_backends.effects import EFFECTS

log = logging.getLogger(__name__)

MIN_VARIANCE = 1e-18
"""Variance of a coordinate below which it has no influence on the errors: it lies beyond a bound."""
MIN_OFFSET = 1e-9
"""Distance of a coordinate from its identity below which it is there."""


def without_uncertain_effects(scored: ScoredSearch, control: RunControl) -> ScoredSearch:
    """The search without effects whose numbers do not differ from those of the car file, or else from their identity.

    Effects are removed one by one, the most uncertain first, because two that resemble each other are uncertain only
    together.
    """
    while scored.found.effects:
        conditions = {name: _conditions(scored, name) for name in scored.found.effects}
        ratios = {
            name: min((c.statistic / c.threshold for c in own), default=math.inf) for name, own in conditions.items()
        }
        weakest = min(ratios, key=lambda name: ratios[name])
        confirmed = ratios[weakest] > 1.0
        for name in conditions if confirmed else (weakest,):
            if conditions[name]:
                control.record(Decision("confirm", name, (conditions[name],), confirmed, len(conditions)))
        if confirmed:
            break
        log.info("%s: withdrawn, because the fit does not distinguish it from its identity", weakest)
        remaining = tuple(name for name in conditions if name != weakest)
        found = restrict(scored.problem, scored.found, remaining, control)
        scored = ScoredSearch.of(scored.problem, found, scored.held_out)
    return scored


def _conditions(scored: ScoredSearch, effect: str) -> tuple[Condition, ...]:
    """Conditions that confirm an effect: one after a joint fit, one for an effect with an infinite identity."""
    found = []
    if scored.is_joint:
        distance = identity_distance(scored, effect)
        found.append(Condition("evidence.identity_distance_min", distance, EVIDENCE.identity_distance_min))
    if effect not in scored.problem.nominal.effects and any(map(has_infinite_identity, numbers_of(effect))):
        found.append(Condition("evidence.range_ratio_min", range_ratio(scored, effect), EVIDENCE.range_ratio_min))
    return tuple(found)


def range_ratio(scored: ScoredSearch, effect: str) -> float:
    """The end of the range over the upper end of the 90 % interval, for the numbers with an infinite identity.

    The largest ratio of the effect; infinite if the interval of another number does not contain its identity.
    """
    ends = {f.name: f.high for f in scored.fit.free}
    ratios = []
    for p in numbers_of(effect):
        found = estimate(scored, name := f"effects.{effect}.{p.name}")
        if has_infinite_identity(p):
            ratios.append(ends[name] / found.high90)
        elif p.identity is not None and not found.low90 <= p.identity <= found.high90:
            return math.inf
    return max(ratios)


def identity_distance(scored: ScoredSearch, effect: str) -> float:
    """Mahalanobis distance of the effect's numbers from those of the car file, or else from their identities.

    The covariance is that of the fit. Place and radius of a disc have no identity: the effect is absent at any place if
    its other numbers are at their identities. So they count only where the car file states the effect. The distance is
    infinite for an effect with a number without a finite identity, with a number at the other end of its range, or with
    another form than in the car file.
    """
    is_stated = effect in scored.problem.nominal.effects
    without_identity = () if is_stated else EFFECTS[effect].disc_parameters
    parameters = (p for p in EFFECTS[effect].parameters if p.name not in without_identity)
    numbers = {f"effects.{effect}.{p.name}": p for p in parameters}
    if not is_stated and any(p.identity is None or math.isinf(p.identity) for p in numbers.values() if not p.choices):
        return math.inf
    fit = scored.fit
    assert fit.covariance is not None
    own, offsets = [], []
    for k, each in enumerate(fit.free):
        if each.name not in numbers:
            continue
        value = float(each.value(np.array(fit.z[k])))
        if each.choice:
            if is_stated and value != each.origin:
                return math.inf
            continue
        offset = each.coordinate(value)
        if fit.covariance[k, k] > MIN_VARIANCE:
            own.append(k)
            offsets.append(offset)
        elif abs(offset) > MIN_OFFSET and value in (each.low, each.high):
            return math.inf
    if not own:
        return 0.0
    precision = np.linalg.pinv(fit.covariance[np.ix_(own, own)])
    return float(np.sqrt(np.array(offsets) @ precision @ np.array(offsets)))
