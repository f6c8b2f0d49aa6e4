"""Moves after an effect is accepted: remove earlier effects, or swap them with confusable effects.

The first accepted effect is often a proxy of the true effect.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping

from carlab.diagnosis.selection.problem import Candidate, Model, RunControl, SearchProblem, numbers_of
from carlab.diagnosis.selection.refit import fit_with_scale, refit_candidate, refit_without_each
from carlab.diagnosis.selection.screening import Screen, screen_of

log = logging.getLogger(__name__)


def apply_moves(problem: SearchProblem, model: Model, control: RunControl) -> Model:
    """Remove earlier effects that are no longer significant, and swap those with a better confusable effect."""
    if len(model.effects) < 2 or control.ends_search():
        return model
    with_covariance = problem.fitter(model.scale).with_covariance(model.fit)
    significant: dict[str, Model] = {}
    without_each = refit_without_each(problem, model, control, model.effects[:-1], is_comparison=True)
    for name, reduced in without_each.items():
        chi2 = 2.0 * (reduced.fit.cost - model.fit.cost) / with_covariance.design_effect_of(name)
        if chi2 < problem.settings.selection.keep_chi2_min:
            swapped = _swap(problem, model, significant, control)
            if swapped is not None:
                return swapped
            log.info("%s is no longer significant (chi2 %.1f)", name, chi2)
            smaller = fit_with_scale(problem, reduced.effects, reduced.fit.z)
            return apply_moves(problem, smaller, control)
        significant[name] = reduced
    return _swap(problem, model, significant, control) or model


def _swap(problem: SearchProblem, model: Model, reduced: Mapping[str, Model], control: RunControl) -> Model | None:
    """The model with one effect replaced by a confusable effect with which the loss is significantly lower.

    ``reduced`` has the model without each effect that may be replaced, refitted. The first replacement in its order is
    made; None if there is none.
    """
    settings = problem.settings.selection
    pairs = [
        (name, other)
        for name in reduced
        for other in problem.confusable.get(name, ())
        if other not in model.effects and problem.is_candidate(other)
    ]
    if not pairs or control.ends_search():
        return None
    screens = {name: screen_of(problem, reduced[name]) for name in dict(pairs)}
    arguments = [(problem, model, reduced[name], screens[name], other) for name, other in pairs]
    swaps = control.workers.map(_fitted_swap, arguments, stop=control.ends_search)
    for (name, _), swap in zip(pairs, swaps, strict=True):
        if swap is None:
            continue
        candidate, chi2 = swap
        more_numbers = max(len(numbers_of(candidate.effect)) - len(numbers_of(name)), 0)
        if chi2 > settings.keep_chi2_min + settings.accept_chi2_per_number * more_numbers:
            log.info("%s replaces %s (chi2 %.1f)", candidate.effect, name, chi2)
            return fit_with_scale(problem, (*reduced[name].effects, candidate.effect), candidate.fit.z)
    return None


def _fitted_swap(
    problem: SearchProblem, model: Model, reduced: Model, screen: Screen, other: str
) -> tuple[Candidate, float] | None:
    """Fit ``other`` in addition to ``reduced``, with the chi2 by which it is better than ``model``.

    None if its screening score is too small a share of the gain of the effect that ``reduced`` lacks.
    """
    screened = screen.score(other)
    if screened.score < problem.settings.selection.swap_score_share * (reduced.fit.cost - model.fit.cost):
        return None
    candidate = refit_candidate(problem, reduced, screened)
    design_effect = problem.fitter(model.scale).with_covariance(candidate.fit).design_effect_of(other)
    return candidate, 2.0 * (model.fit.cost - candidate.fit.cost) / design_effect
