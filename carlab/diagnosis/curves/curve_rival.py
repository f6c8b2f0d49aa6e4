"""A measured curve as a rival of the named effects that it contains.

A curve contains the named form as a special case, so it fits about as well if that form is the physics. If it predicts
left-out blocks significantly better, by a relevant share of its own gain over the refit, the named form is not the
physics: the residual is then described by the class of the curve. The initial states of the windows are free, because
their errors hide most of the difference (``identification.free_initial_states``).
"""

from __future__ import annotations

import logging

from carlab.diagnosis.decisions import Alternatives, Condition
from carlab.diagnosis.identification.block_jackknife import clustered_gain
from carlab.diagnosis.selection.problem import RunControl, SearchProblem, SearchResult, is_applicable
from carlab.diagnosis.selection.refit import refit
from carlab.diagnosis.selection.rival_physics import RivalPhysics
from sim_backends.effects import EFFECTS
from sim_backends.effects.curves import SteeringCurve, ThrottleCurve
from sim_backends.effects.steering import SteeringOffset

log = logging.getLogger(__name__)

RIVAL_CURVES: dict[str, tuple[str, ...]] = {SteeringCurve.id: (SteeringOffset.id,), ThrottleCurve.id: ()}
"""Curves that are fitted in place of named effects, and the effects that are fitted with each. They have one dimension,
so their fits take seconds."""


def replacing_curve(problem: SearchProblem, found: SearchResult, control: RunControl) -> RivalPhysics | None:
    """The first measured curve that explains significantly more than the accepted effects that it contains.

    It is fitted with the other effects. None if no curve explains more, if no accepted effect is contained in a curve,
    and after a search that was cut short: the curve may then imitate an effect that was not tried.
    """
    if not found.is_complete:
        return None
    for curve in RIVAL_CURVES:
        contained = tuple(n for n in found.effects if _is_contained(n, curve))
        if not contained or not _is_free(problem, curve) or control.stop():
            continue
        control.progress(f"measured curve in place of {', '.join(contained)}", 0.96)
        rival = curve_in_addition(problem, found, curve, tuple(n for n in found.effects if n not in contained))
        if not control.are_confirmed(contained, _limits(problem, found, rival), len(found.effects)):
            return rival
    return None


def curve_in_addition(problem: SearchProblem, found: SearchResult, curve: str, names: tuple[str, ...]) -> RivalPhysics:
    """A curve and its effects, fitted together with ``names`` from the point of the accepted effects."""
    without = refit(problem, names, found.best, found.scale).fit
    fit = refit(problem, (*names, *RIVAL_CURVES[curve], curve), found.best, found.scale).fit
    return RivalPhysics(curve, fit, without.cost - fit.cost, names)


def _limits(problem: SearchProblem, found: SearchResult, rival: RivalPhysics) -> Alternatives:
    """Conditions on the gain of the curve beyond that of the named effects."""
    fits = (found.base, found.best, rival.fit)
    base, own, with_curve = (problem.left_out_loss_of_free_states(fit, found.scale) for fit in fits)
    gain, error = clustered_gain(own, with_curve, problem.windows)
    total = float((base - with_curve).sum())
    share = gain / total if total > 0.0 else 0.0
    log.info("%s in place of named effects: %.2f of its gain, z %.1f", rival.effect, share, gain / error)
    settings = problem.settings.rivals
    return (
        (Condition("rivals.curve_z_min", gain / error, settings.curve_z_min, above=False),),
        (Condition("rivals.min_curve_share", share, settings.min_curve_share, above=False),),
    )


def _is_contained(effect: str, curve: str) -> bool:
    """Whether a curve with its effects contains the effect."""
    return effect in RIVAL_CURVES[curve] or curve in EFFECTS[effect].represented_by


def _is_free(problem: SearchProblem, curve: str) -> bool:
    """Whether the base model has the curve and its effects, and neither it nor a curve with it is in the car file."""
    stated = problem.nominal.effects
    in_car_file = curve in stated or any(c in stated for c in EFFECTS[curve].represented_by)
    return not in_car_file and all(is_applicable(problem.nominal, e) for e in (curve, *RIVAL_CURVES[curve]))
