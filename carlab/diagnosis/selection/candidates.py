"""Candidates for the next effect: screening, refit, test on left-out blocks, acceptance.

A gain in likelihood is divided by its design effect (Kent 1982): the ratio of the covariance by blocks to that for
independent errors, because neighbouring errors are dependent. It must hold on blocks of the recording that are not
fitted.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from typing import TypeVar

from carlab.core.quantities import FloatArray
from carlab.diagnosis.decisions import Alternatives, Condition, Decision, passes
from carlab.diagnosis.identification.block_jackknife import clustered_gain
from carlab.diagnosis.identification.error_scale import Scale
from carlab.diagnosis.selection.problem import Candidate, Model, RunControl, SearchProblem, numbers_of
from carlab.diagnosis.selection.refit import begin_refit, finish_refit
from carlab.diagnosis.selection.screening import ScreeningResult, screen_candidates

log = logging.getLogger(__name__)

Begun = TypeVar("Begun", ScreeningResult, Candidate)


def next_candidates(problem: SearchProblem, model: Model, control: RunControl) -> tuple[Candidate, ...]:
    """Refitted candidates, sorted by gain; those tested on left-out blocks come first.

    If the model has an effect, candidates with a small gain after the first iteration wait, except those that are
    confusable with the best one. They are fitted further and tested only if none of the others is accepted. All
    candidates for the first effect are compared, because the report shows them.
    """
    names = [n for n in problem.candidates if n not in model.effects and problem.is_candidate(n)]
    screened = screen_candidates(problem, model, names, control)
    fitter = problem.fitter(model.scale)
    linearisation = fitter.linearised(model.fit)
    chosen = _to_refit(problem, screened, fitter.with_covariance(model.fit, linearisation).design_effect)
    begun = _fitted(begin_refit, problem, model, chosen, _step(problem, model, control, 0.0, 0.3))
    if not begun:
        return ()
    reference = problem.left_out_loss(model.fit, model.scale, linearisation)
    found: tuple[Candidate, ...] = ()
    groups = _first_and_waiting(problem, model, begun)
    for group, (first, middle, last) in zip(groups, ((0.3, 0.6, 0.7), (0.7, 0.9, 1.0)), strict=True):
        refitted = _fitted(finish_refit, problem, model, group, _step(problem, model, control, first, middle))
        found = _tested(problem, model, (*found, *refitted), reference, _step(problem, model, control, middle, last))
        if any(is_accepted(problem, c) for c in found):
            break
    return found


def _first_and_waiting(
    problem: SearchProblem, model: Model, begun: Sequence[Candidate]
) -> tuple[list[Candidate], list[Candidate]]:
    """The candidates that are fitted further at once, and those that wait."""
    best = max(begun, key=lambda c: c.gain)
    if not model.effects or best.gain <= 0.0:
        return list(begun), []
    min_gain = problem.settings.selection.min_first_gain_share * best.gain
    confusable = problem.confusable.get(best.effect, ())
    waits = [c.gain < min_gain and c.effect not in confusable for c in begun]
    return (
        [c for c, waiting in zip(begun, waits, strict=True) if not waiting],
        [c for c, waiting in zip(begun, waits, strict=True) if waiting],
    )


def _step(problem: SearchProblem, model: Model, control: RunControl, first: float, last: float) -> RunControl:
    """The control of a part of the step that adds an effect, from ``first`` to ``last`` as shares of the step."""
    done, steps = len(model.effects), problem.settings.selection.max_effects
    return control.part((done + first) / steps, (done + last) / steps)


def _fitted(
    refit: Callable[[SearchProblem, Model, Begun], Candidate],
    problem: SearchProblem,
    model: Model,
    items: Sequence[Begun],
    control: RunControl,
) -> list[Candidate]:
    """Fits of candidates by the workers; fewer if the search is to end."""
    fitted = control.workers.map(
        refit,
        [(problem, model, item) for item in items],
        stop=control.ends_search,
        started=lambda k: control.progress(f"refitting with {items[k].effect}", k / len(items)),
    )
    return [candidate for candidate in fitted if candidate is not None]


def _to_refit(
    problem: SearchProblem, screened: tuple[ScreeningResult, ...], design_effect: float
) -> tuple[ScreeningResult, ...]:
    """Candidates with the best screening scores, and the confusable effects of the leading ones."""
    if not screened:
        return ()
    settings = problem.settings.selection
    by_name = {result.effect: result for result in screened}
    highest = max(result.score for result in screened)
    lowest = max(settings.min_score_share * highest, 0.5 * settings.min_score_chi2 * design_effect)
    names = [result.effect for result in screened if result.score > lowest][: settings.max_refits]
    for name in names[: settings.confusable_leaders]:
        names += [n for n in problem.confusable.get(name, ()) if n in by_name and n not in names]
    return tuple(by_name[name] for name in names)


def _tested(
    problem: SearchProblem, model: Model, refitted: Sequence[Candidate], reference: FloatArray, control: RunControl
) -> tuple[Candidate, ...]:
    """Test the candidates with the largest gains on left-out blocks; ``reference`` (S,) is the loss of the model."""
    settings = problem.settings.selection
    by_gain = sorted(refitted, key=lambda c: -c.gain)
    min_gain = settings.min_gain_share * by_gain[0].gain if by_gain else 0.0
    new = [c for k, c in enumerate(by_gain) if (c.gain >= min_gain or k < 2) and not c.is_tested]
    tested = control.workers.map(
        with_left_out_gain,
        [(problem, model.scale, candidate, reference) for candidate in new],
        stop=control.ends_search,
        started=lambda k: control.progress(f"cross-validating {new[k].effect}", k / len(new)),
    )
    for c in tested:
        if c is not None:
            _log(problem, model, c)
    by_effect = {c.effect: c for c in tested if c is not None}
    found = [by_effect.get(c.effect, c) for c in by_gain]
    return tuple(sorted(found, key=lambda c: (not c.is_tested, -(c.gain + c.left_out_gain))))


def with_left_out_gain(problem: SearchProblem, scale: Scale, candidate: Candidate, reference: FloatArray) -> Candidate:
    """The candidate with its chi2 and with its gain over ``reference`` (S,) on left-out blocks."""
    fitter = problem.fitter(scale)
    linearisation = fitter.linearised(candidate.fit)
    fit = fitter.with_covariance(candidate.fit, linearisation)
    loss = problem.left_out_loss(fit, scale, linearisation)
    gain, error = clustered_gain(reference, loss, problem.windows)
    chi2 = 2.0 * candidate.gain / fit.design_effect_of(candidate.effect)
    return Candidate(candidate.effect, fit, candidate.gain, chi2, gain, error, loss)


def acceptance(problem: SearchProblem, candidate: Candidate) -> Alternatives:
    """Alternative sets of conditions; a candidate is accepted if all conditions of one set hold."""
    settings = problem.settings.selection
    share = candidate.left_out_gain / problem.perfect_loss()
    ratio = candidate.left_out_gain / candidate.gain if candidate.gain > 0.0 else -math.inf
    extra = problem.required_chi2(candidate.effect) - settings.accept_chi2_min
    holds_left_out = Condition("selection.accept_left_out_ratio", ratio, settings.accept_left_out_ratio)
    return (
        (
            holds_left_out,
            Condition("selection.accept_chi2_min", candidate.chi2 - extra, settings.accept_chi2_min),
            Condition("selection.accept_left_out_share", share, settings.accept_left_out_share),
        ),
        (
            holds_left_out,
            Condition("selection.steady_z_min", candidate.standard_errors, settings.steady_z_min),
            Condition("selection.steady_left_out_share", share, settings.steady_left_out_share),
        ),
    )


def is_accepted(problem: SearchProblem, candidate: Candidate) -> bool:
    """Whether the candidate is accepted as the next effect."""
    return candidate.is_tested and passes(acceptance(problem, candidate))


def accepted(
    problem: SearchProblem, model: Model, candidates: tuple[Candidate, ...], control: RunControl
) -> tuple[Candidate, ...]:
    """The candidates that are accepted, the next effect first; records the decision about each tested one.

    An accepted candidate that is confusable with the best one is next if it has fewer numbers and a loss on left-out
    blocks that is higher by less than one standard error (Breiman et al. 1984).
    """
    tested = [c for c in candidates if c.is_tested]
    for c in tested:
        conditions = acceptance(problem, c)
        control.record(Decision("accept", c.effect, conditions, is_accepted(problem, c), len(model.effects)))
    chosen = [c for c in tested if is_accepted(problem, c)]
    if not chosen:
        return ()
    best = chosen[0]
    simpler = [c for c in chosen if c is best or _is_simpler(problem, c, best)]
    simplest = min(simpler, key=lambda c: len(numbers_of(c.effect)))
    return (simplest, *(c for c in chosen if c is not simplest))


def _is_simpler(problem: SearchProblem, candidate: Candidate, best: Candidate) -> bool:
    """Whether a confusable candidate has fewer numbers, and no significantly higher loss on left-out blocks."""
    if candidate.effect not in problem.confusable.get(best.effect, ()):
        return False
    if len(numbers_of(candidate.effect)) >= len(numbers_of(best.effect)):
        return False
    lead, error = clustered_gain(candidate.left_out_loss, best.left_out_loss, problem.windows)
    return lead < problem.settings.selection.simpler_z_max * error


def _log(problem: SearchProblem, model: Model, c: Candidate) -> None:
    numbers = {k: round(v, 4) for k, v in c.fit.values().items() if k.startswith("effects." + c.effect)}
    log.info(
        "candidate %d %s: gain %.1f, chi2 %.1f (required %.0f), left-out gain %.1f (%.1f std errors, share %.3f) %s",
        len(model.effects), c.effect, c.gain, c.chi2, problem.required_chi2(c.effect), c.left_out_gain,
        c.standard_errors, c.left_out_gain / problem.perfect_loss(), numbers,
    )  # fmt: skip
