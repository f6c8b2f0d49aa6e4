"""Other explanations of an effect that delays both commands.

A lag of the steering and a lag of the motor of similar size resemble one delay of both commands. The forward selection
adds one effect at a time, so it finds the delay first. The delay then hides the two lags, or stays beside one of them.
Here all effects of delays and lags are replaced together by each set with at most one of them for each command. A delay
or lag of each command is also compared with a delay of both and a further delay or lag of one command.

An effect that delays both commands names its groups (``Effect.split_into``): the delays and lags of each command.
"""

from __future__ import annotations

import itertools
import logging
from dataclasses import dataclass

import numpy as np

from carlab.core.quantities import FloatArray
from carlab.diagnosis.decisions import Condition, Decision
from carlab.diagnosis.identification.block_jackknife import clustered_gain
from carlab.diagnosis.identification.fit import Fit
from carlab.diagnosis.selection.elimination import EliminationResult, eliminate
from carlab.diagnosis.selection.problem import Model, RunControl, SearchProblem
from carlab.diagnosis.selection.refit import refit
from carlab.diagnosis.settings import SelectionSettings
from sim_backends.effects import EFFECTS

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class _Replacement:
    """A fit with ``new`` effects in place of ``old`` ones.

    chi2   twice its gain over the design effect
    loss   of each window (S,) on left-out blocks, with free initial states
    """

    old: frozenset[str]
    new: tuple[str, ...]
    fit: Fit
    chi2: float
    loss: FloatArray


def replace_shared_delays(
    problem: SearchProblem, eliminated: EliminationResult, control: RunControl
) -> EliminationResult:
    """Replace accepted delays and lags by other delays and lags that predict left-out blocks better."""
    for name in (name for name, effect in EFFECTS.items() if effect.split_into):
        model = eliminated.model
        exchanges = (_splits if name in model.effects else _merges)(problem, model, name)
        if not exchanges or control.stop():
            continue
        control.progress(f"comparing {name} with delays and lags of single commands", 0.94)
        arguments = [(problem, model, *exchange) for exchange in exchanges]
        fitted = [each for each in control.workers.map(_fitted, arguments, stop=control.stop) if each is not None]
        own_loss = problem.left_out_loss_of_free_states(model.fit, model.scale) if fitted else np.zeros(0)
        passing = [each for each in fitted if _passes(problem, model, each, own_loss, control)]
        if passing:
            best = min(passing, key=lambda each: float(each.loss.sum()))
            log.info("%s replace %s (chi2 %.1f)", " and ".join(best.new), " and ".join(sorted(best.old)), best.chi2)
            effects = (*(e for e in model.effects if e not in best.old), *best.new)
            eliminated = eliminate(problem, refit(problem, effects, best.fit, model.scale), control)
    return eliminated


Exchange = tuple[frozenset[str], dict[str, float]]
"""Accepted effects, and the effects that may replace them with the lags [s] from which their fit starts."""


def _splits(problem: SearchProblem, model: Model, name: str) -> list[Exchange]:
    """Sets of candidates, at most one from each group, in place of an accepted effect and those of its groups.

    A single effect in place of a single effect is left to the forward selection, which has compared them.
    """
    groups = EFFECTS[name].split_into
    lags = group_lags_s(model, name)
    old = frozenset({name}.union(*groups)).intersection(model.effects)
    if len(old) == 1 and min(lags) <= 0.0:
        return []
    options = [
        [(e, max(lag, 0.0)) for e in group if problem.is_candidate(e)] for group, lag in zip(groups, lags, strict=True)
    ]
    sets = [
        dict(each for each in chosen if each is not None)
        for chosen in itertools.product(*([None, *each] for each in options))
    ]
    return [(old, new) for new in sets if len(new) >= (len(groups) if len(old) == 1 else 1)]


def _merges(problem: SearchProblem, model: Model, name: str) -> list[Exchange]:
    """The effect, with a delay or lag of the later command, in place of one accepted effect of each command."""
    old = effect_of_each_command(model, name)
    if not old or not problem.is_candidate(name):
        return []
    lags = group_lags_s(model, name)
    common, longest = min(lags), max(lags)
    longer = EFFECTS[name].split_into[lags.index(longest)]
    return [(frozenset(old), {name: common, e: longest - common}) for e in longer if problem.is_candidate(e)]


def _fitted(problem: SearchProblem, model: Model, old: frozenset[str], new: dict[str, float]) -> _Replacement | None:
    """Fit ``new`` effects in place of ``old`` ones; None if the fit is significantly worse, or not as required."""
    effects = (*(e for e in model.effects if e not in old), *new)
    known = model.fit.coordinates()
    lags = {f"effects.{e}.{EFFECTS[e].lag_parameter}": lag for e, lag in new.items()}
    free = problem.free_parameters(effects)
    start = np.array([
        f.coordinate(f.origin + lags[f.name]) if f.name in lags else known.get(f.name, 0.0) for f in free
    ])  # fmt: skip
    fitter, settings = problem.fitter(model.scale), problem.settings.selection
    fit = fitter.fit(problem.config_with(effects), free, start)
    with_covariance = fitter.with_covariance(fit)
    chi2 = 2.0 * (model.fit.cost - fit.cost) / max(with_covariance.design_effect_of(e) for e in new)
    if chi2 < (settings.accept_chi2_min if len(new) > len(old) else -settings.accept_chi2_min):
        return None
    return _Replacement(old, tuple(new), fit, chi2, problem.left_out_loss_of_free_states(fit, model.scale))


def _passes(
    problem: SearchProblem, model: Model, replacement: _Replacement, own_loss: FloatArray, control: RunControl
) -> bool:
    """Whether the new effects replace the old ones, by the conditions of ``_conditions``."""
    gain, error = clustered_gain(own_loss, replacement.loss, problem.windows)
    conditions = _conditions(replacement, gain / error, problem.settings.selection)
    passed = all(condition.holds for condition in conditions)
    for effect in replacement.new:
        control.record(Decision("replace", effect, (conditions,), passed, len(model.effects)))
    log.info("%s: chi2 %.1f, %.1f standard errors", " and ".join(replacement.new), replacement.chi2, gain / error)
    return passed


def _conditions(replacement: _Replacement, z: float, settings: SelectionSettings) -> tuple[Condition, ...]:
    """Conditions of a replacement by which the loss on left-out blocks falls by ``z`` standard errors.

    An additional effect needs the significance of any accepted effect. An equal number needs a lower loss on left-out
    blocks. Fewer effects need a loss that is not significantly higher.
    """
    if len(replacement.new) > len(replacement.old):
        return (
            Condition("selection.accept_chi2_min", replacement.chi2, settings.accept_chi2_min),
            Condition("selection.split_z_min", z, settings.split_z_min),
        )
    if len(replacement.new) == len(replacement.old):
        return (Condition("selection.replace_z_min", z, settings.replace_z_min),)
    return (Condition("selection.keep_z_min", -z, settings.keep_z_min, above=False),)


def lag_s(model: Model, name: str) -> float:
    """Delay or time constant of an accepted effect [s], relative to the car file."""
    parameter = f"effects.{name}.{EFFECTS[name].lag_parameter}"
    return next(
        float(f.value(z)) - f.origin for f, z in zip(model.fit.free, model.fit.z, strict=True) if f.name == parameter
    )


def group_lags_s(model: Model, name: str) -> list[float]:
    """Sum of the effect's own delay and of the delays and lags of each group [s], relative to the car file."""
    return [sum(lag_s(model, e) for e in (name, *group) if e in model.effects) for group in EFFECTS[name].split_into]


def effect_of_each_command(model: Model, name: str) -> tuple[str, ...]:
    """The accepted delay or lag of each group of ``name``, the shorter one first.

    Empty if a group has none or several, or if an accepted effect already delays both commands.
    """
    old = [[e for e in group if e in model.effects] for group in EFFECTS[name].split_into]
    if any(len(each) != 1 for each in old) or any(EFFECTS[e].split_into for e in model.effects):
        return ()
    return tuple(sorted((each[0] for each in old), key=lambda e: lag_s(model, e)))


def confusable_shared_delays(model: Model) -> list[tuple[str, str]]:
    """Pairs of an accepted delay or lag of one command and a delay of both commands that may replace it.

    A delay of both commands replaces the shorter of two delays or lags; the longer one becomes shorter by it.
    """
    shared = (name for name, effect in EFFECTS.items() if effect.split_into)
    return [(found[0], name) for name in shared if (found := effect_of_each_command(model, name))]
