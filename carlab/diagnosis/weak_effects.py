"""Withdrawal of single effects that do not matter: too small to act on, or harmful on held-out recordings.

With enough rows, a test finds effects of any size. An effect is negligible if all channels that are predicted without
it, after a refit of the other parameters, differ by less than a share of the error that remains with it.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable

import numpy as np

from carlab.diagnosis.decisions import Alternatives, Condition, Decision
from carlab.diagnosis.identification.fit import Fit
from carlab.diagnosis.identification.held_out_errors import HeldOut
from carlab.diagnosis.selection.problem import Model, RunControl, SearchProblem, SearchResult
from carlab.diagnosis.selection.refit import refit_without_each
from carlab.diagnosis.selection.search import with_model
from carlab.diagnosis.settings import SelectionSettings
from carlab.prediction.errors import simulation_errors

log = logging.getLogger(__name__)


def without_negligible_effects(problem: SearchProblem, found: SearchResult, control: RunControl) -> SearchResult:
    """Remove negligible effects one by one, the smallest first, and refit the others."""
    min_size = problem.settings.selection.min_practical_size

    def conditions(name: str, model: Model, without: Fit) -> Alternatives:
        return ((Condition("selection.min_practical_size", practical_size(problem, model, without), min_size),),)

    return _with_confirmed_effects(problem, found, conditions, control)


def without_harmful_effects(
    problem: SearchProblem, found: SearchResult, held_out: HeldOut, control: RunControl
) -> SearchResult:
    """Remove effects one by one that raise the held-out error when they are added last, the most harmful first."""

    def conditions(name: str, model: Model, without: Fit) -> Alternatives:
        return held_out_conditions(held_out, without, model.fit, problem.settings.selection)

    return _with_confirmed_effects(problem, found, conditions, control)


def held_out_conditions(held_out: HeldOut, without: Fit, fit: Fit, settings: SelectionSettings) -> Alternatives:
    """Conditions that ``fit`` lowers the error on held-out recordings, by its score or by its robust likelihood.

    With a single held-out block, the likelihood has no standard error, and its sign counts.
    """
    before, after = held_out.final_error(without.config), held_out.final_error(fit.config)
    gain, error = held_out.gain(before, after)
    rise = held_out.score(before) / max(held_out.score(after), 1e-12) - 1.0
    return (
        (Condition("selection.min_held_out_rise", rise, settings.min_held_out_rise),),
        (
            Condition(
                "selection.min_held_out_z", gain / (error if math.isfinite(error) else 1.0), settings.min_held_out_z
            ),
        ),
    )


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
    before, after = (simulation_errors(problem.windows, fit.config)[:, -1] for fit in (without, model.fit))
    difference = np.sqrt(np.mean((before - after) ** 2, axis=0))
    return float((difference / model.scale.sigma[-1]).max())


def _with_confirmed_effects(
    problem: SearchProblem,
    found: SearchResult,
    conditions_of: Callable[[str, Model, Fit], Alternatives],
    control: RunControl,
) -> SearchResult:
    """The result with the effects whose conditions hold; the conditions get name, model and the fit without it."""
    model = found.model
    while model.effects:
        removed = {}
        for name, without in refit_without_each(problem, model, control).items():
            conditions = conditions_of(name, model, without.fit)
            removed[name] = (without, conditions, _margin(conditions))
        weakest = min(removed, key=lambda name: removed[name][2])
        confirmed = removed[weakest][2] > 0.0
        for name in removed if confirmed else (weakest,):
            control.record(Decision("confirm", name, removed[name][1], confirmed, len(model.effects)))
        if confirmed:
            break
        numbers = ", ".join(f"{c.setting} {c.statistic:.3g}" for (c, *_) in removed[weakest][1])
        log.info("%s: withdrawn (%s)", weakest, numbers)
        model = removed[weakest][0]
    if model.effects == found.effects:
        return found
    # A refit from the first fit could end in another optimum, whose effects were not judged.
    return with_model(problem, found, model, control) if model.effects else found.without_effects()


def _margin(alternatives: Alternatives) -> float:
    """The best alternative's smallest excess of a statistic over its threshold; above 0 if it confirms the effect."""
    return max(min(c.statistic - c.threshold for c in conditions) for conditions in alternatives)
