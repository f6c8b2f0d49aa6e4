"""Pairwise comparison of each accepted effect with its confusable effects on left-out blocks.

The comparison is that of non-nested models (Vuong 1989), with losses on left-out blocks and standard errors
clustered by block. Confusable effects differ little, so the initial states of the windows are free
(``free_initial_states``).
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field

from carlab.core.quantities import FloatArray
from carlab.diagnosis.identification.block_jackknife import clustered_gain
from carlab.diagnosis.identification.fit import Fit
from carlab.diagnosis.selection.elimination import EliminationResult, delete_each
from carlab.diagnosis.selection.problem import Candidate, Model, RunControl, SearchProblem
from carlab.diagnosis.selection.refit import refit, refit_candidate
from carlab.diagnosis.selection.screening import screen_of
from carlab.diagnosis.selection.shared_delays import confusable_shared_delays

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class PairwiseResult:
    """Strength and indistinguishable effects of each accepted effect.

    chi2               twice the gain of the effect over its design effect
    indistinguishable  effects that left-out blocks do not distinguish from it, the nearest first
    replacements       for an effect: the confusable effect with the lowest loss on left-out blocks, if that is lower;
                       for an effect whose only number is at a bound, an indistinguishable one within its range
    """

    chi2: Mapping[str, float] = field(default_factory=dict)
    indistinguishable: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    replacements: Mapping[str, Candidate] = field(default_factory=dict)


def choose_confusable(
    problem: SearchProblem, eliminated: EliminationResult, control: RunControl
) -> tuple[Model, PairwiseResult]:
    """Replace effects of a model by confusable effects with a lower loss on left-out blocks.

    A replaced effect does not return: each comparison fits the alternative once more than the model, so two effects
    that fit equally well would replace one another again and again.
    """
    pairs = compare_pairs(problem, eliminated, control)
    replaced: set[str] = set()
    for _ in eliminated.model.effects:
        new = ((name, each) for name, each in pairs.replacements.items() if each.effect not in replaced)
        if (replacement := next(new, None)) is None or control.stop():
            break
        name, candidate = replacement
        replaced.add(name)
        log.info("%s replaces %s", candidate.effect, name)
        before = eliminated.model
        effects = tuple(candidate.effect if e == name else e for e in before.effects)
        model = refit(problem, effects, candidate.fit, before.scale)
        eliminated = delete_each(problem, model, control)
        pairs = compare_pairs(problem, eliminated, control)
    return eliminated.model, pairs


def compare_pairs(problem: SearchProblem, eliminated: EliminationResult, control: RunControl) -> PairwiseResult:
    """Compare each effect of a model with its confusable effects."""
    model, settings = eliminated.model, problem.settings.selection
    if not model.effects:
        return PairwiseResult()
    fitter = problem.fitter(model.scale)
    linearisation = fitter.linearised(model.fit)
    with_covariance = fitter.with_covariance(model.fit, linearisation)
    own_loss = problem.left_out_loss_of_free_states(model.fit, model.scale, linearisation)
    fitted = _fitted_alternatives(problem, eliminated, control)
    chi2, indistinguishable, replacements = {}, {}, {}
    for name in model.effects:
        gain = eliminated.deletions[name].without.fit.cost - model.fit.cost
        chi2[name] = 2.0 * gain / with_covariance.design_effect_of(name)
        compared = []
        for candidate, loss in fitted[name]:
            difference, error = clustered_gain(loss, own_loss, problem.windows)
            log.info(
                "%s against %s: %.1f (%.1f standard errors)", name, candidate.effect, difference, difference / error
            )
            compared.append((difference, error, candidate))
        compared.sort(key=lambda each: each[0])
        close = [c.effect for d, e, c in compared if d < settings.indistinguishable_z * e]
        indistinguishable[name] = tuple(close[: settings.max_indistinguishable])
        if compared and compared[0][0] < -settings.replace_z_min * compared[0][1]:
            replacements[name] = compared[0][2]
        elif _is_at_bound(model.fit, name):
            within = (c for _, _, c in compared if c.effect in close and not _is_at_bound(c.fit, c.effect))
            if (candidate_within := next(within, None)) is not None:
                replacements[name] = candidate_within
    return PairwiseResult(chi2, indistinguishable, replacements)


def _is_at_bound(fit: Fit, effect: str) -> bool:
    """Whether the only number of an effect ended at a bound of its range.

    One of several numbers may be at a bound although the effect is true: a sharp limit has the roundness 0.
    """
    own = [each for each in zip(fit.free, fit.z, strict=True) if each[0].name.startswith(f"effects.{effect}.")]
    numbers = [(free, z) for free, z in own if not free.choice]
    return len(numbers) == 1 and all(float(free.value(z)) in (free.low, free.high) for free, z in numbers)


def _fitted_alternatives(
    problem: SearchProblem, eliminated: EliminationResult, control: RunControl
) -> dict[str, list[tuple[Candidate, FloatArray]]]:
    """For each effect of a model, the confusable effects in its place that explain a similar part.

    Each has its loss on left-out blocks (S,).
    """
    model = eliminated.model
    confusable = [(name, other) for name in model.effects for other in problem.confusable.get(name, ())]
    pairs = [
        (name, other)
        for name, other in dict.fromkeys(confusable + confusable_shared_delays(model))
        if other not in model.effects and problem.is_candidate(other)
    ]
    fitted = control.workers.map(
        _fitted_alternative,
        [(problem, model, eliminated.deletions[name].without, other) for name, other in pairs],
        stop=control.stop,
        started=lambda k: control.progress(f"comparing {pairs[k][0]} with {pairs[k][1]}", 0.95),
    )
    found: dict[str, list[tuple[Candidate, FloatArray]]] = {name: [] for name in model.effects}
    for (name, _), candidate in zip(pairs, fitted, strict=True):
        if candidate is not None:
            found[name].append(candidate)
    return found


def _fitted_alternative(
    problem: SearchProblem, model: Model, without: Model, other: str
) -> tuple[Candidate, FloatArray] | None:
    """Add ``other`` to a model ``without`` an effect of ``model``, with its loss on left-out blocks (S,).

    None if it explains too little.
    """
    candidate = refit_candidate(problem, without, screen_of(problem, without).score(other))
    if candidate.gain < problem.settings.selection.min_gain_share * (without.fit.cost - model.fit.cost):
        return None
    return candidate, problem.left_out_loss_of_free_states(candidate.fit, model.scale)
