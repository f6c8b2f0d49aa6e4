"""Test of accepted effects with decorrelated errors.

The errors of a simulator that lacks physics are correlated between the steps and channels of a window. The search
counts them as independent, so an effect that imitates a part of them may pass. Here the errors are decorrelated by the
covariance of the model's own errors (generalised least squares, Aitken 1936): directions in which the model errs count
little. An effect that does not lower the loss on left-out blocks significantly is removed.
"""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from carlab.diagnosis.decisions import Condition, Decision
from carlab.diagnosis.identification.error_model import ErrorModel
from carlab.diagnosis.identification.error_scale import Scale
from carlab.diagnosis.selection.elimination import delete_each
from carlab.diagnosis.selection.problem import Model, RunControl, SearchProblem, SearchResult
from carlab.diagnosis.selection.refit import refit
from carlab.diagnosis.selection.search import restrict

log = logging.getLogger(__name__)


def without_unsupported_effects(problem: SearchProblem, found: SearchResult, control: RunControl) -> SearchResult:
    """The result without effects that decorrelated errors do not support; unchanged if the simulator has no error."""
    settings = problem.settings.selection
    excess = float(np.mean((found.scale.sigma / problem.floor) ** 2)) - 1.0
    if not found.effects or excess < settings.min_model_error:
        return found
    model = refit(problem, found.effects, found.best, decorrelating(problem, found.model))
    while model.effects and not control.stop():
        deletions = delete_each(problem, model, control)
        weakest = min(deletions, key=lambda name: deletions[name].standard_errors)
        condition = Condition("selection.supported_z_min", deletions[weakest].standard_errors, settings.supported_z_min)
        control.record(Decision("support", weakest, ((condition,),), condition.holds, len(model.effects)))
        if condition.holds:
            break
        log.info("removed %s: %.1f standard errors with decorrelated errors", weakest, condition.statistic)
        remaining = tuple(e for e in model.effects if e != weakest)
        model = Model(remaining, deletions[weakest].without, model.scale)
    return found if model.effects == found.effects else restrict(problem, found, model.effects, control)


def decorrelating(problem: SearchProblem, model: Model) -> Scale:
    """The scale of a model's errors with their covariance."""
    fitter = problem.fitter(model.scale)
    white = fitter.white(model.fit.config, (), np.zeros((1, 0)))[0]
    limit = problem.settings.selection.max_left_out_error
    errors = white.reshape(len(white), -1).clip(-limit, limit)
    root = ErrorModel.of(errors, problem.settings.selection.error_ridge_share).root
    return replace(model.scale, root=root)
