"""Backward elimination: remove effects whose removal does not increase the loss on left-out blocks significantly."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass

from carlab.diagnosis.decisions import Condition, Decision
from carlab.diagnosis.identification.block_jackknife import clustered_gain
from carlab.diagnosis.selection.problem import Model, RunControl, SearchProblem
from carlab.diagnosis.selection.refit import refit_without_each

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Deletion:
    """A model refitted without one effect, and the increase of its loss on left-out blocks in standard errors."""

    without: Model
    standard_errors: float


@dataclass(frozen=True, slots=True)
class EliminationResult:
    """The remaining model, and the deletion of each of its effects."""

    model: Model
    deletions: Mapping[str, Deletion]


def delete_each(problem: SearchProblem, model: Model, control: RunControl) -> EliminationResult:
    """Remove each effect in turn and refit the others."""
    if not model.effects:
        return EliminationResult(model, {})
    without = refit_without_each(problem, model, control)
    models = [model, *without.values()]
    with_all, *losses = control.workers.map(problem.left_out_loss, [(m.fit, m.scale) for m in models])
    assert with_all is not None
    found = {}
    for (name, reduced), loss in zip(without.items(), losses, strict=True):
        assert loss is not None
        rise, error = clustered_gain(loss, with_all, problem.windows)
        found[name] = Deletion(reduced, rise / error)
    return EliminationResult(model, found)


def eliminate(
    problem: SearchProblem,
    model: Model,
    control: RunControl,
    *,
    stage: str = "keep",
    setting: str = "keep_z_min",
    min_effects: int = 1,
) -> EliminationResult:
    """Remove the weakest effect on left-out blocks until all remaining effects are significant.

    ``setting`` is the name of the threshold, and ``stage`` that of the decisions. ``min_effects`` remain in any case.
    """
    threshold = float(getattr(problem.settings.selection, setting))
    result = delete_each(problem, model, control)
    while len(result.model.effects) > min_effects and not control.stop():
        weakest = min(result.deletions, key=lambda name: result.deletions[name].standard_errors)
        deletion = result.deletions[weakest]
        condition = Condition(f"selection.{setting}", deletion.standard_errors, threshold)
        control.record(Decision(stage, weakest, ((condition,),), condition.holds, len(result.model.effects)))
        if condition.holds:
            break
        rise = deletion.standard_errors
        log.info("removed %s: the loss on left-out blocks rises by %.1f standard errors only", weakest, rise)
        result = delete_each(problem, deletion.without, control)
    return result
