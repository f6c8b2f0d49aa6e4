"""A measured curve as a rival of the named effects that it contains.

A curve contains the named form as a special case, so it fits about as well if that form is the physics. If it predicts
left-out blocks significantly better, by a relevant share of its own gain over the refit, the named form is not the
physics: the residual is then described by the class of the curve. The initial states of the windows are free, because
their errors hide most of the difference (``identification.free_initial_states``).
"""

from __future__ import annotations

import logging

from carlab.diagnosis.decisions import Condition
from carlab.diagnosis.identification.gains import clustered_gain
from carlab.diagnosis.selection.pairwise_tests import left_out_loss
from carlab.diagnosis.selection.problem import RunControl, SearchProblem, SearchResult, is_applicable
from carlab.diagnosis.selection.refit import refit
from carlab.diagnosis.selection.rival_physics import RivalPhysics
from sim_backends.effects import EFFECTS
from sim_backends.effects.curves import SteeringCurve
from sim_backends.effects.steering import SteeringOffset

log = logging.getLogger(__name__)


def replacing_curve(problem: SearchProblem, found: SearchResult, control: RunControl) -> RivalPhysics | None:
    """The steering curve, if it explains significantly more than the accepted static effects of the steering.

    Args:
        problem: the search problem.
        found: the accepted effects.
        control: records the decision about each effect that the curve contains.

    Returns:
        The curve with the other effects. None if the named effects stand, without any that the curve contains, and
        after a search that was cut short: the curve may then stand for an effect that was not tried.
    """
    contained = tuple(n for n in found.effects if _is_contained(n))
    if not contained or not found.is_complete or not _is_free(problem) or control.stop():
        return None
    control.progress(f"measured curve in place of {', '.join(contained)}", 0.96)
    rival = curve_in_addition(problem, found, tuple(n for n in found.effects if n not in contained))
    base, own, with_curve = (left_out_loss(problem, fit, found.scale) for fit in (found.base, found.best, rival.fit))
    gain, error = clustered_gain(own, with_curve, problem.windows)
    total = float((base - with_curve).sum())
    share = gain / total if total > 0.0 else 0.0
    settings = problem.settings.rivals
    alternatives = (
        (Condition("rivals.curve_z_min", gain / error, settings.curve_z_min, above=False),),
        (Condition("rivals.min_curve_share", share, settings.min_curve_share, above=False),),
    )
    confirmed = control.are_confirmed(contained, alternatives, len(found.effects))
    log.info("curve in place of %s: %.2f of its gain, z %.1f", ", ".join(contained), share, gain / error)
    return None if confirmed else rival


def curve_in_addition(problem: SearchProblem, found: SearchResult, names: tuple[str, ...]) -> RivalPhysics:
    """The steering curve and its offset, fitted together with ``names`` from the point of the accepted effects."""
    without = refit(problem, names, found.best, found.scale).fit
    fit = refit(problem, (*names, SteeringOffset.id, SteeringCurve.id), found.best, found.scale).fit
    return RivalPhysics(SteeringCurve.id, fit, without.cost - fit.cost, names)


def _is_contained(effect: str) -> bool:
    """Whether the steering curve with its offset contains the effect."""
    return effect == SteeringOffset.id or EFFECTS[effect].represented_by == SteeringCurve.id


def _is_free(problem: SearchProblem) -> bool:
    """Whether the base model has the curve and its offset, and the curve is not in the car file."""
    added = SteeringOffset.id, SteeringCurve.id
    return SteeringCurve.id not in problem.nominal.effects and all(is_applicable(problem.nominal, e) for e in added)
