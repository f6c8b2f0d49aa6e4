"""Estimates of the effects that a diagnosis does not name: how large each of them can be.

The estimate is one Gauss-Newton step from the identity of the effect, together with the other parameters of the fit (a
score test, Rao 1948). The slope is that of a secant from the identity to the end of the resulting interval, because a
dead band has no slope at its identity.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from carlab.core.quantities import FloatArray
from carlab.diagnosis.evidence import ScoredSearch, standard_error_factor
from carlab.diagnosis.findings import Estimate
from carlab.diagnosis.identification.block_jackknife import interval_quantile
from carlab.diagnosis.identification.fit import Fit, Fitter, Linearisation
from carlab.diagnosis.identification.fit_parameters import FitParameter, effect_parameters, with_effect
from carlab.diagnosis.settings import EVIDENCE
from carlab.jobs.function_workers import FunctionWorkers
from sim_backends.effects import CATALOGUE
from sim_backends.registry import REGISTRY

SECANT_ITERATIONS = 3
"""Number of iterations in which the secants are evaluated at the ends of the intervals of the iteration before."""
MIN_SIZE = 1e-9
"""Size of a coordinate below which it is at the end of its range."""
MIN_INFORMATION = 1e-6
"""Mean square change of the whitened errors per typical size below which a parameter has no influence."""


def effect_limits(scored: ScoredSearch, workers: FunctionWorkers) -> dict[str, dict[str, Estimate]]:
    """Estimates of the parameters of each candidate effect that is not named, by effect and parameter.

    An effect is omitted if one of its parameters has an infinite identity, or no influence at the identities of the
    others.
    """
    problem, found = scored.problem, scored.found
    fitter = problem.fitter(found.scale)
    fit = replace(scored.fit, config=problem.config_with(found.effects))
    linearised = fitter.linearised(scored.fit)
    z90 = interval_quantile(len(np.unique(problem.windows.block)), EVIDENCE.interval_probability)
    factor = standard_error_factor(scored)
    joints = {}
    for effect in CATALOGUE:
        if effect in found.effects or not problem.is_candidate(effect):
            continue
        free = tuple(p for p in effect_parameters(effect, problem.nominal) if not p.choice)
        if not any(p.logarithmic for p in free):
            joints[effect] = replace(
                fit,
                config=with_effect(fit.config, effect),
                free=(*fit.free, *free),
                z=np.concatenate([fit.z, np.zeros(len(free))]),
            )
    limits = workers.map(_limits, [(fitter, joint, linearised, factor, z90) for joint in joints.values()])
    return {effect: parameters for effect, parameters in zip(joints, limits, strict=True) if parameters}


def _limits(
    fitter: Fitter, joint: Fit, linearised: Linearisation, std_factor: float, z90: float
) -> dict[str, Estimate]:
    """Estimates of the last coordinates of ``joint``, which ``linearised`` lacks; empty if one has no influence."""
    count = len(linearised.jacobian)
    own = joint.free[count:]
    sizes = np.ones(len(own))
    fitted = replace(joint, free=joint.free[:count], z=joint.z[:count])
    held = np.append(fitter.held_at_bounds(fitted, linearised), np.zeros(len(own), bool))
    for _ in range(SECANT_ITERATIONS):
        secants = _secants(fitter, joint, sizes, linearised.white)
        if np.mean(secants**2, axis=(1, 2, 3)).min(initial=math.inf) < MIN_INFORMATION:
            return {}
        jacobian = np.concatenate([linearised.jacobian, secants])
        step = fitter.gauss_newton_step(joint, Linearisation(jacobian, linearised.white), held)
        residual = linearised.white + np.tensordot(step, jacobian, axes=1)
        covariance = fitter.with_covariance(joint, Linearisation(jacobian, residual), held).covariance
        assert covariance is not None
        std = std_factor * np.sqrt(np.diag(covariance)[count:])
        sizes = np.abs(step[count:]) + z90 * std
    estimates = [_estimate(p, z, s, z90) for p, z, s in zip(own, step[count:], std, strict=True)]
    return {p.name.rpartition(".")[2]: estimate for p, estimate in zip(own, estimates, strict=True)}


def _secants(fitter: Fitter, joint: Fit, sizes: FloatArray, white: FloatArray) -> FloatArray:
    """Changes (n, S, U, 6) of the whitened errors per unit of each of the last n coordinates, at the sizes (n,).

    The mean of both signs, if the range of the parameter allows both.
    """
    secants = []
    for k, size in enumerate(sizes, start=len(joint.free) - len(sizes)):
        p = joint.free[k]
        ends = [p.coordinate(float(p.value(np.array(sign * size)))) for sign in (1.0, -1.0)]
        points = np.tile(joint.z, (2, 1))
        points[:, k] = ends
        moved = fitter.white(joint.config, joint.free, points)
        slopes = [(each - white) / end for each, end in zip(moved, ends, strict=True) if abs(end) > MIN_SIZE]
        secants.append(np.mean(slopes, axis=0) if slopes else np.zeros_like(white))
    return np.asarray(secants)


def _estimate(p: FitParameter, z: float, std: float, z90: float) -> Estimate:
    low, value, high = (float(p.value(np.array(z + k * std))) for k in (-z90, 0.0, z90))
    unit, at_limit = REGISTRY[p.name].unit, low == high  # the whole interval lies outside the range
    return Estimate(value, float(std * p.size), min(low, high), max(low, high), unit, at_limit)
