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


def without_uncertain_effects(scored: ScoredSearch, control: RunControl) -> ScoredSearch:
    """The search without effects whose numbers do not differ from their identity; unchanged without a joint fit."""
    if not scored.is_joint:
        return scored
    limit = scored.problem.settings.evidence.identity_z_min
    standing = []
    for name in scored.found.effects:
        condition = Condition("evidence.identity_z_min", identity_distance(scored, name), limit)
        control.record(Decision("stand", name, ((condition,),), condition.holds, len(scored.found.effects)))
        standing += [name] if condition.holds else []
    if len(standing) == len(scored.found.effects):
        return scored
    log.info("%s: withdrawn (at the identity)", ", ".join(e for e in scored.found.effects if e not in standing))
    found = restrict(scored.problem, scored.found, tuple(standing), control)
    return ScoredSearch.of(scored.problem, found, scored.held_out)


def identity_distance(scored: ScoredSearch, effect: str) -> float:
    """The largest distance of a number of the effect from its identity, in standard deviations.

    It is infinite if a number has no finite identity.
    """
    numbers = {f"effects.{effect}.{p.name}": p for p in EFFECTS[effect].parameters if not p.choices}
    if any(p.identity is None or math.isinf(p.identity) for p in numbers.values()):
        return math.inf
    assert scored.fit.covariance is not None
    std = np.sqrt(np.diag(scored.fit.covariance))
    fitted = zip(scored.fit.free, scored.fit.z, std, strict=True)
    own = [abs(float(z)) / max(float(s), 1e-12) for f, z, s in fitted if f.name in numbers]
    return max(own, default=math.inf)


__all__ = ["identity_distance", "without_uncertain_effects"]
