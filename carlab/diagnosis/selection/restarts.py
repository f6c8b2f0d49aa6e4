"""Restarts of a fit from perturbed parameters (multistart), because its cost has several local minima.

Forward selection begins each fit at the parameters of the fit before. So it may end in a minimum near parameters that
are right only without the further effects. Then effects seem to have no influence, or are proxies of others.
"""

from __future__ import annotations

import logging
import math
from functools import partial

import numpy as np

from carlab.core.quantities import FloatArray
from carlab.diagnosis.selection.problem import Model, RunControl, SearchProblem
from carlab.diagnosis.selection.refit import fit_with_scale
from carlab.diagnosis.settings import RESTARTS

log = logging.getLogger(__name__)


def needs_restart(problem: SearchProblem, model: Model) -> bool:
    """Whether a model has several effects and does not reach the noise."""
    return problem.excess_of(model.scale) >= RESTARTS.min_model_error and len(model.effects) >= RESTARTS.min_effects


def restart(problem: SearchProblem, model: Model, control: RunControl) -> Model:
    """The model, or one with the same effects and a lower cost, from perturbed parameters."""
    if control.ends_search():
        return model
    config, free = problem.config_with(model.effects), model.fit.free
    fit = partial(problem.fitter(model.scale).fit, iterations=RESTARTS.iterations)
    fits = control.workers.map(fit, [(config, free, z) for z in _perturbed(model)], stop=control.ends_search)
    best = min((each for each in fits if each is not None), key=lambda each: each.cost, default=model.fit)
    log.info("restarts of %s: cost %.1f, %.1f before", ", ".join(model.effects), best.cost, model.fit.cost)
    if best.cost > (1.0 - RESTARTS.min_fall_share) * model.fit.cost:
        return model
    return fit_with_scale(problem, model.effects, best.z)


def _perturbed(model: Model) -> FloatArray:
    """Coordinates (k, n) near those of the model; choices stay, and the parameters of effects have no prior."""
    free = model.fit.free
    stds = np.array([0.0 if f.choice else f.prior_z if math.isfinite(f.prior_z) else 1.0 for f in free])
    noise = np.random.default_rng(RESTARTS.seed).standard_normal((RESTARTS.count, len(free)))
    return np.asarray(model.fit.z + RESTARTS.width * stds * noise)
