"""Withdrawal of single effects that do not matter: too small to act on, or harmful on held-out recordings.

With enough rows, a test finds effects of any size. An effect is negligible if all channels that are predicted without
it, after a refit of the other parameters, differ by less than a share of the error that remains with it.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np

from carlab.diagnosis.decisions import Condition, Decision
from carlab.diagnosis.identification.fit import Fit
from carlab.diagnosis.identification.held_out_errors import HeldOut
from carlab.diagnosis.selection.problem import Model, RunControl, SearchProblem, SearchResult
from carlab.diagnosis.selection.refit import refit
from carlab.diagnosis.selection.search import restrict
from carlab.prediction.errors import prediction_errors
from carlab.prediction.predict import simulate_windows

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class _Removal:
    """A model refitted without one effect.

    without           the fit
    size              practical size of the effect
    score_rise        relative rise of the held-out score
    standard_errors   fall of the held-out log-likelihood, in standard errors
    """

    without: Fit
    size: float
    score_rise: float
    standard_errors: float


def without_weak_effects(
    problem: SearchProblem, found: SearchResult, held_out: HeldOut, control: RunControl
) -> SearchResult:
    """Remove effects one by one, smaller ones first, that are negligible or raise the held-out error.

    An effect that unseen blocks do not distinguish from others is not removed for its held-out error: another member of
    the set may be the right one.
    """
    model = found.model
    while model.effects:
        removals = {name: _removal(problem, model, name, held_out) for name in model.effects}
        conditions = {name: _conditions(problem, found, name, removal) for name, removal in removals.items()}
        by_size = sorted(model.effects, key=lambda name: removals[name].size)
        dropped = next((name for name in by_size if not _stands(conditions[name])), None)
        for name in model.effects if dropped is None else (dropped,):
            control.record(Decision("stand", name, conditions[name], name != dropped, len(model.effects)))
        if dropped is None:
            break
        gone = removals[dropped]
        log.info(
            "%s: withdrawn, its size is %.3f, the held-out score rises by %.2f %% without it (%.1f standard errors)",
            dropped, gone.size, 100.0 * gone.score_rise, gone.standard_errors,
        )  # fmt: skip
        model = Model(tuple(e for e in model.effects if e != dropped), gone.without, model.scale)
    return found if model.effects == found.effects else restrict(problem, found, model.effects, control)


def practical_size(problem: SearchProblem, model: Model, without: Fit) -> float:
    """Size of an effect: how much it changes predictions, compared with the error that remains.

    Args:
        problem: windows of the recordings to fit.
        model: fit with the effect.
        without: fit of all other parameters without it.

    Returns:
        The largest ratio over channels of two numbers at the end of the windows: the root mean square difference of
        both predictions, and the error scale of ``model``, which is at least the noise floor.
    """
    windows = problem.windows
    errors = [
        prediction_errors(simulate_windows(windows, fit.config), windows)[0, :, -1] for fit in (model.fit, without)
    ]
    difference = np.sqrt(np.mean((errors[1] - errors[0]) ** 2, axis=0))
    return float((difference / model.scale.sigma[-1]).max())


def _removal(problem: SearchProblem, model: Model, name: str, held_out: HeldOut) -> _Removal:
    without = refit(problem, tuple(e for e in model.effects if e != name), model.fit, model.scale).fit
    before, after = held_out.final_error(without.config), held_out.final_error(model.fit.config)
    gain, error = held_out.gain(before, after)
    rise = held_out.score(before) / max(held_out.score(after), 1e-12) - 1.0
    return _Removal(without, practical_size(problem, model, without), rise, gain / error)


def _conditions(
    problem: SearchProblem, found: SearchResult, name: str, removal: _Removal
) -> tuple[tuple[Condition, ...], ...]:
    """Alternative sets of conditions; an effect stands if all conditions of one set hold."""
    settings = problem.settings.selection
    size = Condition("selection.min_practical_size", removal.size, settings.min_practical_size)
    if found.rivals.get(name):
        return ((size,),)
    return (
        (size, Condition("selection.min_held_out_rise", removal.score_rise, settings.min_held_out_rise)),
        (size, Condition("selection.min_held_out_z", removal.standard_errors, settings.min_held_out_z)),
    )


def _stands(alternatives: tuple[tuple[Condition, ...], ...]) -> bool:
    return any(all(c.statistic > c.threshold for c in conditions) for conditions in alternatives)


__all__ = ["practical_size", "without_weak_effects"]
