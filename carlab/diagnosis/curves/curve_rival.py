"""Measured curves as rivals of named effects.

A map of a command contains the named effects of this command as special cases, so it fits about as well if one of them
is the physics; so does an error of the heading over the heading, which contains a yaw misalignment. A side force and a
yaw moment over the speed or the slip angle do not contain all effects that turn the car to one side; if one of these is
the physics, they fit about as well or worse. The curve replaces the named effects if it lowers the error on left-out
blocks significantly, by a relevant share of its own gain over the refit. The residual is then described by the class of
the curve. The initial states of the windows are free, because their errors hide most of the difference
(``identification.free_initial_states``).
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

from carlab.diagnosis.decisions import Alternatives, Condition
from carlab.diagnosis.identification.block_jackknife import clustered_gain
from carlab.diagnosis.selection.problem import RunControl, SearchProblem, SearchResult, is_applicable
from carlab.diagnosis.selection.refit import refit
from carlab.diagnosis.selection.rival_physics import RivalPhysics
from sim_backends.effects import EFFECTS
from sim_backends.effects.body import LateralBias, TorqueSteer
from sim_backends.effects.curves import SteeringCurve, ThrottleCurve
from sim_backends.effects.force_curves import (
    SideForceOverSlip,
    SideForceOverSpeed,
    YawMomentOverSlip,
    YawMomentOverSpeed,
)
from sim_backends.effects.observations import MocapYawMisalignment
from sim_backends.effects.steering import SteeringAsymmetry, SteeringOffset
from sim_backends.effects.uncatalogued import HeadingError

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class RivalCurve:
    """A measured curve of one dimension, whose fit takes seconds.

    curve       id of the measured curve, or of ``HeadingError``, a Fourier series
    additional  effects and further curves that are fitted with it
    replaced    effects that it replaces in addition to those with this curve in ``represented_by``
    """

    curve: str
    additional: tuple[str, ...] = ()
    replaced: tuple[str, ...] = ()

    def replaces(self, effect: str) -> bool:
        """Whether the curve is fitted in place of the effect."""
        return effect in self.replaced or self.curve in EFFECTS[effect].represented_by


_TO_ONE_SIDE = (LateralBias.id, SteeringOffset.id, TorqueSteer.id, MocapYawMisalignment.id)
RIVAL_CURVES: dict[str, RivalCurve] = {
    rival.curve: rival
    for rival in (
        RivalCurve(SteeringCurve.id, additional=(SteeringOffset.id,), replaced=(SteeringOffset.id,)),
        RivalCurve(ThrottleCurve.id),
        RivalCurve(HeadingError.id, replaced=(MocapYawMisalignment.id,)),
        RivalCurve(SideForceOverSpeed.id, additional=(YawMomentOverSpeed.id,), replaced=_TO_ONE_SIDE),
        RivalCurve(
            SideForceOverSlip.id, additional=(YawMomentOverSlip.id,), replaced=(*_TO_ONE_SIDE, SteeringAsymmetry.id)
        ),
    )
}
"""By the id of the curve."""


def replacing_curve(problem: SearchProblem, found: SearchResult, control: RunControl) -> RivalPhysics | None:
    """The first measured curve that explains significantly more than the accepted effects that it replaces.

    It is fitted with the other effects. None if no curve explains more, if no curve replaces an accepted effect, and
    after a search that was cut short: the curve may then imitate an effect that was not tried.
    """
    if not found.is_complete:
        return None
    for curve, rival_curve in RIVAL_CURVES.items():
        replaced = tuple(n for n in found.effects if rival_curve.replaces(n))
        if not replaced or not _is_available(problem, rival_curve) or control.stop():
            continue
        control.progress(f"measured curve in place of {', '.join(replaced)}", 0.96)
        rival = curve_in_addition(problem, found, curve, tuple(n for n in found.effects if n not in replaced))
        if not control.are_confirmed(replaced, _limits(problem, found, rival), len(found.effects)):
            return rival
    return None


def curve_in_addition(problem: SearchProblem, found: SearchResult, curve: str, names: tuple[str, ...]) -> RivalPhysics:
    """A curve and its effects, fitted together with ``names`` from the point of the accepted effects."""
    without = refit(problem, names, found.best, found.scale).fit
    additional = RIVAL_CURVES[curve].additional
    fit = refit(problem, (*names, *additional, curve), found.best, found.scale).fit
    return RivalPhysics(curve, fit, without.cost - fit.cost, names, additional)


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


def _is_available(problem: SearchProblem, rival: RivalCurve) -> bool:
    """Whether the base model has the curve and its effects, and the car file no curve that contains it."""
    stated = problem.nominal.effects
    in_car_file = any(c in stated for c in (rival.curve, *EFFECTS[rival.curve].represented_by))
    return not in_car_file and all(is_applicable(problem.nominal, e) for e in (rival.curve, *rival.additional))
