"""Withdrawal of effects that a joint fit of parameters and initial states does not confirm.

The search has windows with estimated initial states, and an effect can follow from the errors of these estimates.
"""

from __future__ import annotations

import logging
import math

import numpy as np

from carlab.diagnosis.decisions import Condition, Decision
from carlab.diagnosis.evidence import ScoredSearch
from carlab.diagnosis.selection.problem import RunControl
from carlab.diagnosis.selection.search import restrict
from sim_backends.effects import EFFECTS

log = logging.getLogger(__name__)

MIN_VARIANCE = 1e-18
"""Variance of a coordinate below which it has no influence on the errors: it lies beyond a bound."""
MIN_OFFSET = 1e-9
"""Distance of a coordinate from its identity below which it is there."""


def without_uncertain_effects(scored: ScoredSearch, control: RunControl) -> ScoredSearch:
    """The search without effects whose numbers do not differ from those of the car file, or else from their identity.

    Unchanged without a joint fit.

    Effects are removed one by one, the most uncertain first, because two that resemble each other are uncertain only
    together.
    """
    limit = scored.problem.settings.evidence.identity_distance_min
    while scored.is_joint and scored.found.effects:
        distances = {name: identity_distance(scored, name) for name in scored.found.effects}
        weakest = min(distances, key=lambda name: distances[name])
        stands = distances[weakest] > limit
        for name in distances if stands else (weakest,):
            condition = Condition("evidence.identity_distance_min", distances[name], limit)
            control.record(Decision("stand", name, ((condition,),), stands, len(distances)))
        if stands:
            break
        log.info("%s: withdrawn, because the joint fit does not distinguish it from its identity", weakest)
        remaining = tuple(name for name in distances if name != weakest)
        found = restrict(scored.problem, scored.found, remaining, control)
        scored = ScoredSearch.of(scored.problem, found, scored.held_out)
    return scored


def identity_distance(scored: ScoredSearch, effect: str) -> float:
    """Mahalanobis distance of the effect's numbers from those of the car file, or else from their identities.

    The covariance is that of the fit. The distance is infinite for an effect with a number without a finite identity,
    with a number at the other end of its range, or with another form than in the car file.
    """
    numbers = {f"effects.{effect}.{p.name}": p for p in EFFECTS[effect].parameters}
    is_stated = effect in scored.problem.nominal.effects
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
