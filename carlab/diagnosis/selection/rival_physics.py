"""Uncatalogued physics as a rival of effects: an effect is not accepted if a rival explains as much.

Rivals are fitted like effects (``sim_backends.effects.uncatalogued``) but are never named. The class statement of a
significant rival describes the residual.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

from carlab.diagnosis.identification.fit import Fit
from carlab.diagnosis.selection.problem import Candidate, Model, RunControl, SearchProblem, SearchResult
from carlab.diagnosis.selection.refit import refit, refit_candidate
from carlab.diagnosis.selection.screening import screen_candidates
from sim_backends.effects import EFFECTS, MeasuredCurve
from sim_backends.effects.curves import free_knots

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class RivalPhysics:
    """Significant uncatalogued physics.

    effect      id of the uncatalogued effect
    fit         fit with it and with ``names``
    gain        fall of the cost with it
    names       effects of the catalogue in the fit
    additional  further effects and curves that are a part of this physics
    """

    effect: str
    fit: Fit
    gain: float
    names: tuple[str, ...] = ()
    additional: tuple[str, ...] = ()

    def class_statement(self) -> str:
        """Class of the physics."""
        return EFFECTS[self.effect].class_statement

    def formula(self) -> str:
        """Fitted parameters in one line."""
        return "; ".join(_fitted_numbers(effect, self.fit) for effect in (self.effect, *self.additional))


def _fitted_numbers(effect: str, fit: Fit) -> str:
    """Fitted parameters of an effect, or the deviations of a curve at its knots."""
    info, values = EFFECTS[effect], fit.values()
    labels = _knot_labels(info) if isinstance(info, MeasuredCurve) else [p.name for p in info.parameters]
    numbers = (
        f"{label} {values[f'effects.{effect}.{p.name}']:.3g} {p.unit}".strip()
        for label, p in zip(labels, info.parameters, strict=True)
    )
    return f"{effect}: " + ", ".join(numbers)


def _knot_labels(curve: MeasuredCurve) -> list[str]:
    """Coordinates of each free knot with their units."""
    return [
        "at " + ", ".join(f"{axis.knots[k]:g} {axis.unit}" for axis, k in zip(curve.axes, knot, strict=True))
        for knot in free_knots(curve.axes)
    ]


def replacing_physics(problem: SearchProblem, found: SearchResult, control: RunControl) -> RivalPhysics | None:
    """A rival that explains as much as all effects together or as one of two effects, or None."""
    settings = problem.settings.rivals
    names = found.effects
    if not names or len(names) > 2 * settings.max_single_names or control.stop():
        return None
    design_effect = problem.fitter(found.scale).with_covariance(found.best).design_effect
    single = names if 1 < len(names) <= settings.max_single_names else ()
    for replaced in (names, *((name,) for name in single)):
        kept = tuple(n for n in names if n not in replaced)
        reduced = refit(problem, kept, found.best, found.scale)
        numbers = sum(len(EFFECTS[n].parameters) for n in replaced)
        min_score = settings.min_score_share * (reduced.fit.cost - found.best.cost)
        for rival in _fitted_rivals(problem, reduced, min_score, control):
            more_numbers = len(EFFECTS[rival.effect].parameters) - numbers
            penalty = 0.5 * settings.chi2_per_number * design_effect * more_numbers
            lead = found.best.cost - rival.fit.cost - penalty
            log.info("%s replacing %s: cost lower by %.1f", rival.effect, ", ".join(replaced), lead)
            if lead > 0.0:
                return RivalPhysics(rival.effect, rival.fit, rival.gain, kept)
    return None


def additional_physics(problem: SearchProblem, found: SearchResult, control: RunControl) -> RivalPhysics | None:
    """The strongest significant rival in addition to all effects, or None."""
    if control.stop():
        return None
    chi2_min = problem.settings.rivals.additional_chi2_min
    design_effect = problem.fitter(found.scale).with_covariance(found.best).design_effect
    min_gain = 0.5 * chi2_min * design_effect
    model = found.model if found.effects else refit(problem, (), found.base, found.scale)
    best = max(_fitted_rivals(problem, model, min_gain, control), key=lambda c: c.gain, default=None)
    if best is None or best.gain < min_gain:
        return None
    log.info("%s in addition: gain %.1f", best.effect, best.gain)
    return RivalPhysics(best.effect, best.fit, best.gain, found.effects)


def _fitted_rivals(problem: SearchProblem, model: Model, min_score: float, control: RunControl) -> list[Candidate]:
    """Rivals added to ``model`` whose screening scores are above ``min_score``, fitted, the highest score first."""
    rivals = [e.id for e in EFFECTS.values() if e.is_general_rival and not e.catalogued]
    names = [name for name in rivals if name not in problem.nominal.effects]
    screened = [result for result in screen_candidates(problem, model, names, control) if result.score > min_score]
    chosen = screened[: problem.settings.rivals.max_refits]
    fitted = control.workers.map(refit_candidate, [(problem, model, result) for result in chosen])
    return [candidate for candidate in fitted if candidate is not None]
