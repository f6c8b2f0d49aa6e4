"""Moves after an effect is accepted: remove earlier effects, or swap them with confusable effects.

The first accepted effect is often a proxy of the true effect.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping

from carlab.diagnosis.identification.fit import design_effect_of
from carlab.diagnosis.identification.fit_parameters import effect_parameters
from carlab.diagnosis.selection.problem import Candidate, Model, RunControl, SearchProblem
from carlab.diagnosis.selection.refit import fit_with_scale, refit_candidate, refit_without_each
from carlab.diagnosis.selection.screening import Screen

log = logging.getLogger(__name__)


def apply_moves(problem: SearchProblem, model: Model, control: RunControl) -> Model:
    """Remove earlier effects that are no longer significant, and swap those with a better confusable effect."""
    if len(model.effects) < 2 or control.ends_search():
        return model
    with_covariance = problem.fitter(model.scale).with_covariance(model.fit)
    significant: dict[str, Model] = {}
    for name, reduced in refit_without_each(problem, model, control, model.effects[:-1]).items():
        chi2 = 2.0 * (reduced.fit.cost - model.fit.cost) / design_effect_of(with_covariance, name)
        if chi2 < problem.settings.selection.keep_chi2_min:
            swapped = _swap(problem, model, significant, control)
            return swapped or apply_moves(problem, _without(problem, reduced, name, chi2), control)
        significant[name] = reduced
    return _swap(problem, model, significant, control) or model


def _without(problem: SearchProblem, reduced: Model, name: str, chi2: float) -> Model:
    """The model ``reduced``, which lacks the insignificant effect ``name``, with its own scale."""
    log.info("%s is no longer significant (chi2 %.1f)", name, chi2)
    config = problem.config_with(reduced.effects)
    return fit_with_scale(problem, reduced.effects, config, reduced.fit.free, reduced.fit.z)


def _swap(problem: SearchProblem, model: Model, reduced: Mapping[str, Model], control: RunControl) -> Model | None:
    """The model with a confusable effect in place of one of its effects; None if none is significantly better.

    Args:
        problem: the search problem.
        model: the model.
        reduced: the model without an effect, by effect; the first effect with a better confusable one is replaced.
        control: workers, which share the fits of all confusable effects.
    """
    settings, screening = problem.settings.selection, problem.settings.screening
    pairs = [
        (name, other)
        for name in reduced
        for other in problem.confusable.get(name, ())
        if other not in model.effects and problem.is_candidate(other)
    ]
    if not pairs or control.ends_search():
        return None
    fitter = problem.fitter(model.scale)
    screens = {}
    for name in dict(pairs):
        config, fit = problem.config_with(reduced[name].effects), reduced[name].fit
        screens[name] = Screen(fitter, config, fit, screening.max_windows, screening)
    arguments = [
        (
            problem.without_refits(),
            model,
            reduced[name],
            screens[name],
            other,
            settings.swap_score_share * (reduced[name].fit.cost - model.fit.cost),
        )
        for name, other in pairs
    ]
    swaps = control.workers.map(_fitted_swap, arguments, stop=control.ends_search)
    for (name, _), swap in zip(pairs, swaps, strict=True):
        if swap is not None and swap[1] > settings.keep_chi2_min:
            candidate, chi2 = swap
            log.info("%s replaces %s (chi2 %.1f)", candidate.effect, name, chi2)
            fit, effects = candidate.fit, (*reduced[name].effects, candidate.effect)
            return fit_with_scale(problem, effects, fit.config, fit.free, fit.z)
    return None


def _fitted_swap(
    problem: SearchProblem, model: Model, reduced: Model, screen: Screen, other: str, min_score: float
) -> tuple[Candidate, float] | None:
    """Fit ``other`` in addition to ``reduced``, with the chi2 by which it is better than ``model``.

    None if its screening score is below ``min_score``.
    """
    screened = screen.score(other, effect_parameters(other, problem.nominal))
    if screened.score < min_score:
        return None
    candidate = refit_candidate(problem, reduced, screened)
    design_effect = design_effect_of(problem.fitter(model.scale).with_covariance(candidate.fit), other)
    return candidate, 2.0 * (model.fit.cost - candidate.fit.cost) / design_effect
