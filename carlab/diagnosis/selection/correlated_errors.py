"""Test of accepted effects with decorrelated errors.

The errors of a simulator that lacks physics are correlated between the steps and channels of a window. The search
counts them as independent, so an effect that imitates a part of them may pass. Here the errors are decorrelated by the
covariance of the model's own errors (generalised least squares, Aitken 1936): directions in which the model errs count
little. An effect that does not lower the loss on left-out blocks significantly is removed.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from carlab.diagnosis.identification.error_model import ErrorModel
from carlab.diagnosis.identification.error_scale import Scale
from carlab.diagnosis.selection.elimination import eliminate
from carlab.diagnosis.selection.problem import Model, RunControl, SearchProblem, SearchResult
from carlab.diagnosis.selection.refit import refit
from carlab.diagnosis.selection.search import restrict


def without_unsupported_effects(problem: SearchProblem, found: SearchResult, control: RunControl) -> SearchResult:
    """The result without effects that decorrelated errors do not support; unchanged if the simulator has no error."""
    if (
        control.stop()
        or not found.effects
        or problem.excess_of(found.scale) < problem.settings.selection.min_model_error
    ):
        return found
    model = refit(problem, found.effects, found.best, decorrelating(problem, found.model))
    result = eliminate(problem, model, control, stage="support", setting="supported_z_min", min_effects=0)
    supported = result.model.effects
    return found if supported == found.effects else restrict(problem, found, supported, control)


def decorrelating(problem: SearchProblem, model: Model) -> Scale:
    """The scale of a model's errors with their covariance."""
    fitter = problem.fitter(model.scale)
    white = fitter.white(model.fit.config, (), np.zeros((1, 0)))[0]
    limit = problem.settings.selection.max_left_out_error
    errors = white.reshape(len(white), -1).clip(-limit, limit)
    root = ErrorModel.of(errors, problem.settings.selection.error_ridge_share).root
    return replace(model.scale, root=root)
