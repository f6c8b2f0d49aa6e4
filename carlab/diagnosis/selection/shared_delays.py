"""Other explanations of an effect that delays both commands.

A lag of the steering and a lag of the motor of similar size resemble one delay of both commands. The forward selection
adds one effect at a time, so it finds the delay first. The delay then hides the two lags, or stays beside one of them.
Here all effects of delays and lags are replaced together by each set with at most one of them for each command.
"""

from __future__ import annotations

import itertools
import logging
from dataclasses import dataclass

import numpy as np

from carlab.core.quantities import FloatArray
from carlab.diagnosis.decisions import Condition, Decision
from carlab.diagnosis.identification.fit import Fit, clustered_gain, design_effect_of
from carlab.diagnosis.selection.elimination import EliminationResult, eliminate
from carlab.diagnosis.selection.pairwise_tests import unseen_loss
from carlab.diagnosis.selection.problem import Model, RunControl, SearchProblem
from carlab.diagnosis.selection.refit import refit
from carlab.diagnosis.settings import SelectionSettings
from sim_backends.effects import EFFECTS

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class _Replacement:
    """A fit with ``new`` effects in place of ``old`` ones.

    chi2   twice its gain over the design effect
    loss   of each window (S,) on unseen blocks, with free initial states
    """

    old: frozenset[str]
    new: tuple[str, ...]
    fit: Fit
    chi2: float
    loss: FloatArray


def replace_shared_delays(
    problem: SearchProblem, eliminated: EliminationResult, control: RunControl
) -> EliminationResult:
    """Replace effects that delay both commands by effects of single commands that predict unseen blocks better."""
    for name in eliminated.model.effects:
        model = eliminated.model
        sets = _sets(problem, model, name)
        if not sets or control.stop():
            continue
        control.progress(f"comparing {name} with delays and lags of single commands", 0.94)
        arguments = [(problem.without_refits(), model, name, new) for new in sets]
        fitted = [each for each in control.workers.map(_fitted, arguments, stop=control.stop) if each is not None]
        own_loss = unseen_loss(problem, model.fit, model.scale) if fitted else np.zeros(0)
        passing = [each for each in fitted if _passes(problem, model, each, own_loss, control)]
        if passing:
            best = min(passing, key=lambda each: float(each.loss.sum()))
            log.info("%s replace %s (chi2 %.1f)", " and ".join(best.new), " and ".join(sorted(best.old)), best.chi2)
            effects = (*(e for e in model.effects if e not in best.old), *best.new)
            eliminated = eliminate(problem, refit(problem, effects, best.fit, model.scale), control)
    return eliminated


def _sets(problem: SearchProblem, model: Model, name: str) -> list[tuple[str, ...]]:
    """Sets of candidates, at most one from each group, that may replace the effect; none if it is not in the model.

    A single effect in place of a single effect is left to the forward selection, which has compared them.
    """
    groups = EFFECTS[name].split_into
    if name not in model.effects or not groups:
        return []
    is_alone = len(_old(model, name)) == 1
    if is_alone and _lag_s(model, name) <= 0.0:
        return []
    fewest = len(groups) if is_alone else 1
    chosen = itertools.product(*([None, *(e for e in group if problem.is_candidate(e))] for group in groups))
    sets = [tuple(effect for effect in each if effect is not None) for each in chosen]
    return [each for each in sets if len(each) >= fewest]


def _old(model: Model, name: str) -> frozenset[str]:
    """The effect, and the effects of its groups that are in the model."""
    return frozenset({name}.union(*EFFECTS[name].split_into)).intersection(model.effects)


def _lag_s(model: Model, name: str) -> float:
    """Delay or time constant of an effect [s], relative to the car file."""
    parameter = f"effects.{name}.{EFFECTS[name].lag_parameter}"
    return next(
        float(f.value(z)) - f.origin for f, z in zip(model.fit.free, model.fit.z, strict=True) if f.name == parameter
    )


def _fitted(problem: SearchProblem, model: Model, name: str, new: tuple[str, ...]) -> _Replacement | None:
    """Fit ``new`` in place of all effects that it replaces; None if it fits significantly worse, or not as required."""
    old = _old(model, name)
    effects = (*(e for e in model.effects if e not in old), *new)
    known = {f.name: float(z) for f, z in zip(model.fit.free, model.fit.z, strict=True)}
    starts = {f"effects.{e}.{EFFECTS[e].lag_parameter}": _total_lag_s(model, name, e) for e in new}
    free = problem.free_parameters(effects)
    start = np.array([f.coordinate(starts[f.name]) if f.name in starts else known.get(f.name, 0.0) for f in free])
    fitter, settings = problem.fitter(model.scale), problem.settings.selection
    fit = fitter.fit(problem.config_with(effects), free, start)
    with_covariance = fitter.with_covariance(fit)
    chi2 = 2.0 * (model.fit.cost - fit.cost) / max(design_effect_of(with_covariance, e) for e in new)
    if chi2 < (settings.accept_chi2_min if len(new) > len(old) else -settings.accept_chi2_min):
        return None
    return _Replacement(old, new, fit, chi2, unseen_loss(problem, fit, model.scale))


def _total_lag_s(model: Model, name: str, effect: str) -> float:
    """Delay of both commands and lags of the command that the effect acts on [s], at least 0."""
    group = next(group for group in EFFECTS[name].split_into if effect in group)
    return max(_lag_s(model, name) + sum(_lag_s(model, e) for e in group if e in model.effects), 0.0)


def _passes(
    problem: SearchProblem, model: Model, replacement: _Replacement, own_loss: FloatArray, control: RunControl
) -> bool:
    """Whether the effects are better than those that they replace, or fewer and not worse."""
    gain, error = clustered_gain(own_loss, replacement.loss, problem.windows)
    conditions = _conditions(replacement, gain / error, problem.settings.selection)
    passed = all(condition.holds for condition in conditions)
    for effect in replacement.new:
        control.record(Decision("replace", effect, (conditions,), passed, len(model.effects)))
    log.info("%s: chi2 %.1f, %.1f standard errors", " and ".join(replacement.new), replacement.chi2, gain / error)
    return passed


def _conditions(replacement: _Replacement, z: float, settings: SelectionSettings) -> tuple[Condition, ...]:
    """More effects must be significantly better, as many must be better, and fewer must not be worse."""
    if len(replacement.new) > len(replacement.old):
        return (
            Condition("selection.accept_chi2_min", replacement.chi2, settings.accept_chi2_min),
            Condition("selection.split_z_min", z, settings.split_z_min),
        )
    if len(replacement.new) == len(replacement.old):
        return (Condition("selection.better_rival_z", z, settings.better_rival_z),)
    return (Condition("selection.keep_z_min", -z, settings.keep_z_min, above=False),)


__all__ = ["replace_shared_delays"]
