"""Backward elimination: remove effects whose removal does not increase the loss on left-out blocks."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass

from carlab.diagnosis.decisions import Condition, Decision
from carlab.diagnosis.identification.fit import Fit
from carlab.diagnosis.identification.gains import clustered_gain
from carlab.diagnosis.selection.problem import Model, RunControl, SearchProblem
from carlab.diagnosis.selection.refit import refit_without_each

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Deletion:
    """A refitted model without one effect, and the increase of its loss on left-out blocks in standard errors."""

    without: Fit
    standard_errors: float


@dataclass(frozen=True, slots=True)
class EliminationResult:
    """The remaining model, and the deletion of each of its effects."""

    model: Model
    deletions: Mapping[str, Deletion]


def delete_each(problem: SearchProblem, model: Model, control: RunControl) -> dict[str, Deletion]:
    """Remove each effect in turn and refit the others."""
    if not model.effects:
        return {}
    fitter = problem.fitter(model.scale)
    folds, limit = problem.folds(), problem.settings.selection.max_left_out_error
    without = refit_without_each(problem, model, control)
    fits = [model.fit, *(reduced.fit for reduced in without.values())]
    with_all, *losses = control.workers.map(fitter.leave_fold_out_loss, [(fit, folds, limit) for fit in fits])
    assert with_all is not None
    found = {}
    for (name, reduced), loss in zip(without.items(), losses, strict=True):
        assert loss is not None
        rise, error = clustered_gain(loss, with_all, problem.windows)
        found[name] = Deletion(reduced.fit, rise / error)
    return found


def eliminate(problem: SearchProblem, model: Model, control: RunControl) -> EliminationResult:
    """Remove the weakest effect on left-out blocks until all remaining effects are significant."""
    keep_z_min = problem.settings.selection.keep_z_min
    deletions = delete_each(problem, model, control)
    while len(model.effects) > 1 and not control.stop():
        weakest = min(deletions, key=lambda name: deletions[name].standard_errors)
        z = deletions[weakest].standard_errors
        condition = Condition("selection.keep_z_min", z, keep_z_min)
        control.record(Decision("keep", weakest, ((condition,),), condition.holds, len(model.effects)))
        if condition.holds:
            break
        log.info("removed %s: the loss on left-out blocks rises by %.1f standard errors only", weakest, z)
        model = Model(tuple(e for e in model.effects if e != weakest), deletions[weakest].without, model.scale)
        deletions = delete_each(problem, model, control)
    return EliminationResult(model, deletions)
