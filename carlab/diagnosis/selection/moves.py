"""Moves after an effect is accepted: remove earlier effects, or swap them with confusable effects.

The first accepted effect is often a proxy of the true effect.
"""

from __future__ import annotations

import logging

from carlab.diagnosis.identification.fit import design_effect_of
from carlab.diagnosis.identification.fit_parameters import effect_parameters
from carlab.diagnosis.selection.problem import Model, RunControl, SearchProblem
from carlab.diagnosis.selection.refit import fit_with_scale, refit, refit_candidate
from carlab.diagnosis.selection.screening import Screen

log = logging.getLogger(__name__)


def apply_moves(problem: SearchProblem, model: Model, control: RunControl) -> Model:
    """Remove earlier effects that are no longer significant, and swap those with a better confusable effect."""
    if len(model.effects) < 2 or control.ends_search():
        return model
    fitter = problem.fitter(model.scale)
    for name in model.effects[:-1]:
        others = tuple(e for e in model.effects if e != name)
        reduced = refit(problem, others, model.fit, model.scale)
        chi2 = 2.0 * (reduced.fit.cost - model.fit.cost) / design_effect_of(fitter.with_covariance(model.fit), name)
        if chi2 < problem.settings.selection.keep_chi2_min:
            log.info("%s is no longer significant (chi2 %.1f)", name, chi2)
            config = problem.config_with(others)
            smaller = fit_with_scale(problem, others, config, reduced.fit.free, reduced.fit.z)
            return apply_moves(problem, smaller, control)
        swapped = _swap(problem, model, reduced, name, control)
        if swapped is not None:
            return swapped
    return model


def _swap(problem: SearchProblem, model: Model, reduced: Model, name: str, control: RunControl) -> Model | None:
    """The model with a confusable effect in place of ``name``; None if none is significantly better."""
    settings = problem.settings.selection
    screening = problem.settings.screening
    fitter = problem.fitter(model.scale)
    screen = Screen(fitter, problem.config_with(reduced.effects), reduced.fit, screening.max_windows, screening)
    gain = reduced.fit.cost - model.fit.cost
    for other in problem.confusable.get(name, ()):
        if control.ends_search() or other in model.effects or not problem.is_candidate(other):
            continue
        screened = screen.score(other, effect_parameters(other, problem.nominal))
        if screened.score < settings.swap_score_share * gain:
            continue
        rival = refit_candidate(problem, reduced, screened)
        design_effect = design_effect_of(fitter.with_covariance(rival.fit), other)
        chi2 = 2.0 * (model.fit.cost - rival.fit.cost) / design_effect
        if chi2 > settings.keep_chi2_min:
            log.info("%s replaces %s (chi2 %.1f)", other, name, chi2)
            fit = rival.fit
            return fit_with_scale(problem, (*reduced.effects, other), fit.config, fit.free, fit.z)
    return None


__all__ = ["apply_moves"]
