"""Pairwise comparison of each accepted effect with its confusable effects on unseen blocks.

The comparison is that of non-nested models (Vuong 1989), with losses on blocks that are not fitted and standard errors
clustered by block.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field

from carlab.core.quantities import FloatArray
from carlab.diagnosis.identification.fit import clustered_gain, design_effect_of
from carlab.diagnosis.identification.fit_parameters import effect_parameters
from carlab.diagnosis.selection.elimination import EliminationResult
from carlab.diagnosis.selection.problem import Model, RunControl, SearchProblem
from carlab.diagnosis.selection.refit import refit_candidate
from carlab.diagnosis.selection.screening import Screen

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class PairwiseResult:
    """Strength and rivals of each accepted effect.

    chi2     twice the gain of the effect over its design effect
    rivals   effects that unseen blocks do not distinguish from it, the nearest first
    """

    chi2: Mapping[str, float] = field(default_factory=dict)
    rivals: Mapping[str, tuple[str, ...]] = field(default_factory=dict)


def compare_pairs(problem: SearchProblem, eliminated: EliminationResult, control: RunControl) -> PairwiseResult:
    """Compare each effect of a model with its confusable effects."""
    model = eliminated.model
    if not model.effects:
        return PairwiseResult()
    fitter = problem.fitter(model.scale)
    with_covariance = fitter.with_covariance(model.fit)
    own_loss = fitter.leave_fold_out_loss(model.fit, problem.folds(), problem.settings.selection.max_unseen_error)
    chi2, rivals = {}, {}
    for name in model.effects:
        others = tuple(e for e in model.effects if e != name)
        reduced = Model(others, eliminated.deletions[name].without, model.scale)
        gain = reduced.fit.cost - model.fit.cost
        chi2[name] = 2.0 * gain / design_effect_of(with_covariance, name)
        rivals[name] = _rivals_of(problem, model, reduced, name, own_loss, control)
    return PairwiseResult(chi2, rivals)


def _rivals_of(
    problem: SearchProblem, model: Model, reduced: Model, name: str, own_loss: FloatArray, control: RunControl
) -> tuple[str, ...]:
    """Effects that predict unseen blocks as well as ``name`` when they replace it in ``model``."""
    settings = problem.settings.selection
    fitter = problem.fitter(model.scale)
    screening = problem.settings.screening
    screen = Screen(fitter, problem.config_with(reduced.effects), reduced.fit, screening.max_windows, screening)
    gain = reduced.fit.cost - model.fit.cost
    ties = []
    for other in problem.confusable.get(name, ()):
        if other in model.effects or not problem.is_candidate(other):
            continue
        if control.stop():
            break
        control.progress(f"{name} or {other}?", 0.95)
        rival = refit_candidate(problem, reduced, screen.score(other, effect_parameters(other, problem.nominal)))
        if rival.gain < settings.min_gain_share * gain:
            continue
        loss = fitter.leave_fold_out_loss(rival.fit, problem.folds(), settings.max_unseen_error)
        difference, error = clustered_gain(loss, own_loss, problem.windows)
        log.info("%s against %s: %.1f (%.1f standard errors)", name, other, difference, difference / error)
        if difference < settings.tie_z * error:
            ties.append((difference, other))
    return tuple(other for _, other in sorted(ties)[: settings.max_set_rivals])


__all__ = ["PairwiseResult", "compare_pairs"]
