"""Joint fit of measured curves, base parameters and effects; curves that left-out blocks do not need are removed."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np

from carlab.diagnosis.findings import RejectedCurves
from carlab.diagnosis.identification.block_jackknife import clustered_gain
from carlab.diagnosis.identification.fit import Fit
from carlab.diagnosis.identification.fit_parameters import numbers_at
from carlab.diagnosis.selection.problem import RunControl, SearchProblem, SearchResult, is_applicable
from sim_backends.effects import CATALOGUE, CURVES, EFFECTS

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class CurveFit:
    """A fit with measured curves.

    curves            ids of the curves
    fit               the fit, with covariance
    """

    curves: tuple[str, ...]
    fit: Fit


def fit_curves(
    problem: SearchProblem, found: SearchResult, control: RunControl
) -> tuple[CurveFit | None, tuple[RejectedCurves, ...]]:
    """Fit all applicable curves, and remove those that left-out blocks do not need.

    Named effects, and curves, that a curve contains are omitted. The fit begins on fewer windows, to save time.

    Returns:
        The fit with the accepted curves, or None without any, and the rejected curves.
    """
    stated = problem.nominal.effects
    curves = tuple(
        c.id for c in CURVES if c.in_fits_of_curves and is_applicable(problem.nominal, c.id) and c.id not in stated
    )
    effects = _effects_with(problem, found, curves)
    settings = problem.settings.curves
    few = replace(problem, windows=problem.windows.thinned(settings.max_windows))
    control.progress("fitting measured curves", 0.0)
    fit = _fit(few, (*effects, *curves), found.best.coordinates(), settings.first_iterations, settings.last_iterations)
    fit, curves, rejected = _eliminate(few, fit, effects, curves, control)
    if not curves or control.stop():
        return None, rejected
    control.progress("fitting measured curves to all windows", 0.6)
    effects = _effects_with(problem, found, curves)
    fit = _fit(problem, (*effects, *curves), fit.coordinates(), settings.iterations, settings.last_iterations)
    scale = problem.scale_of(fit.config)
    named = _effects_with(problem, found, ())
    reference = _fit(problem, named, found.best.coordinates(), settings.first_iterations, settings.last_iterations)
    losses = [problem.left_out_loss(each, scale) for each in (reference, fit)]
    gain, error = clustered_gain(losses[0], losses[1], problem.windows)
    log.info("measured curves %s: gain on left-out blocks %.1f standard errors", ", ".join(curves), gain / error)
    if gain < settings.accept_z_min * error:
        return None, (*rejected, RejectedCurves(curves, gain / error, settings.accept_z_min))
    fit = problem.fitter(scale).with_covariance(fit)
    return CurveFit(curves, fit), rejected


def _effects_with(problem: SearchProblem, found: SearchResult, curves: tuple[str, ...]) -> tuple[str, ...]:
    """Accepted effects that no curve contains, and the effects that accompany every curve."""
    accepted = [e for e in found.effects if not set(EFFECTS[e].represented_by).intersection(curves)]
    added = [
        e.id
        for e in CATALOGUE.values()
        if e.fitted_with_curves and e.id not in accepted and is_applicable(problem.nominal, e.id)
    ]
    return (*accepted, *added)


def _fit(problem: SearchProblem, effects: tuple[str, ...], start: dict[str, float], *iterations: int) -> Fit:
    """Successive fits with these numbers of iterations, each with the error scale of the one before."""
    free = problem.free_parameters(effects)
    z = np.array([start.get(f.name, 0.0) for f in free])
    config = problem.config_with(effects)
    fit = None
    for count in iterations:
        scale = problem.scale_of(config.with_values(numbers_at(free, z)))
        fit = problem.fitter(scale).fit(config, free, z, iterations=count, tolerance=problem.settings.curves.tolerance)
        z = fit.z
    assert fit is not None
    return fit


def _eliminate(
    problem: SearchProblem, fit: Fit, effects: tuple[str, ...], curves: tuple[str, ...], control: RunControl
) -> tuple[Fit, tuple[str, ...], tuple[RejectedCurves, ...]]:
    """Remove each curve, the last one first, if the loss on left-out blocks does not rise without it.

    Returns:
        The fit with the remaining curves, these curves, and the removed ones.
    """
    settings = problem.settings.curves
    scale = problem.scale_of(fit.config)
    loss = problem.left_out_loss(fit, scale)
    rejected: list[RejectedCurves] = []
    for k, name in enumerate(reversed(curves)):
        if control.stop():
            break
        control.progress(f"measured curves without {EFFECTS[name].class_statement}", 0.3 + 0.06 * k)
        others = tuple(c for c in curves if c != name)
        without = _fit(problem, (*effects, *others), fit.coordinates(), settings.last_iterations)
        loss_without = problem.left_out_loss(without, scale)
        rise, error = clustered_gain(loss_without, loss, problem.windows)
        log.info("without %s: the loss on left-out blocks rises by %.1f standard errors", name, rise / error)
        if rise < settings.keep_z_min * error:
            fit, curves, loss = without, others, loss_without
            rejected.append(RejectedCurves((name,), rise / error, settings.keep_z_min))
    return fit, curves, tuple(rejected)
