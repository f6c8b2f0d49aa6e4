"""Joint refits of effects and base parameters, because base parameters absorb most of an effect."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import replace

import numpy as np

from carlab.core.quantities import FloatArray
from carlab.diagnosis.identification.error_scale import Scale
from carlab.diagnosis.identification.fit import Fit, Fitter
from carlab.diagnosis.identification.fit_parameters import FitParameter, coordinates_in, values_at
from carlab.diagnosis.selection.problem import Candidate, Model, RunControl, SearchProblem
from carlab.diagnosis.selection.screening import ScreeningResult


def refit(problem: SearchProblem, effects: tuple[str, ...], initial: Fit, scale: Scale) -> Model:
    """Fit with ``effects``, starting from their values in ``initial``; an equal refit is not repeated."""
    start = _start(problem, effects, initial)
    key = _key(problem, effects, start, scale)
    if key not in problem.refits:
        problem.refits[key] = _fit_from(problem, effects, start, scale)
    return _in_order(problem, problem.refits[key], effects)


def refit_without_each(
    problem: SearchProblem,
    model: Model,
    control: RunControl,
    names: Sequence[str] | None = None,
    *,
    is_comparison: bool = False,
) -> dict[str, Model]:
    """For each effect of a model (or each of ``names``), the model without it, refitted.

    With ``is_comparison``, each fit ends early (``compared_cost`` of ``Fitter.fit``), unless it was fitted before.
    """
    removed = model.effects if names is None else names
    others = {name: tuple(e for e in model.effects if e != name) for name in removed}
    starts = {name: _start(problem, effects, model.fit) for name, effects in others.items()}
    cost = model.fit.cost if is_comparison else None
    keys = {name: _key(problem, effects, starts[name], model.scale) for name, effects in others.items()}
    if is_comparison:
        keys = {name: key if key in problem.refits else (key, cost) for name, key in keys.items()}
    new = [name for name in removed if keys[name] not in problem.refits]
    fitted = control.workers.map(
        _fit_from,
        [(problem, others[name], starts[name], model.scale, cost) for name in new],
        started=lambda k: control.progress(f"refitting without {new[k]}", 0.93),
    )
    problem.refits.update((keys[name], each) for name, each in zip(new, fitted, strict=True) if each is not None)
    return {name: _in_order(problem, problem.refits[key], others[name]) for name, key in keys.items()}


def _start(problem: SearchProblem, effects: tuple[str, ...], initial: Fit) -> FloatArray:
    """Coordinates of a fit with ``effects`` at the values of ``initial``; 0 without a value."""
    known = initial.coordinates()
    return np.array([known.get(f.name, 0.0) for f in problem.free_parameters(effects)])


def _key(problem: SearchProblem, effects: tuple[str, ...], start: FloatArray, scale: Scale) -> Hashable:
    """Starting values by name, and the scale: what a refit depends on. The order of effects changes rounding only."""
    names = (f.name for f in problem.free_parameters(effects))
    return frozenset(zip(names, start.tolist(), strict=True)), scale.as_bytes()


def _in_order(problem: SearchProblem, model: Model, effects: tuple[str, ...]) -> Model:
    """The model with its effects and parameters in the order of ``effects``."""
    free, z = problem.free_parameters(effects), _start(problem, effects, model.fit)
    return replace(model, effects=effects, fit=replace(model.fit, free=free, z=z))


def _fit_from(
    problem: SearchProblem,
    effects: tuple[str, ...],
    start: FloatArray,
    scale: Scale,
    compared_cost: float | None = None,
) -> Model:
    config, free = problem.config_with(effects), problem.free_parameters(effects)
    return Model(effects, problem.fitter(scale).fit(config, free, start, compared_cost=compared_cost), scale)


def refit_candidate(problem: SearchProblem, model: Model, screened: ScreeningResult, iterations: int = 12) -> Candidate:
    """Fit the candidate together with ``model``, from the initial points of its screening.

    The initial points are compared after a few iterations on part of the windows (``_distinct_starts``).
    """
    fitter = problem.fitter(model.scale)
    effects = (*model.effects, screened.effect)
    config, free = problem.config_with(effects), problem.free_parameters(effects)
    before = _start(problem, model.effects, model.fit)
    settings = problem.settings.selection
    own_starts = _distinct_starts(free[len(before) :], screened.starts, settings.limit_start_ratios)
    starts = [np.concatenate([before, s]) for s in own_starts]
    if len(starts) > 1:
        few = Fitter(problem.windows.thinned(settings.max_start_windows), model.scale)
        tries = [few.fit(config, free, s, iterations=settings.start_iterations) for s in starts]
        starts = [min(tries, key=lambda f: f.cost).z]
    fit = fitter.fit(config, free, starts[0], iterations=iterations)
    return Candidate(screened.effect, fit, model.fit.cost - fit.cost)


def begin_refit(problem: SearchProblem, model: Model, screened: ScreeningResult) -> Candidate:
    """The first iterations of ``refit_candidate``."""
    return refit_candidate(problem, model, screened, problem.settings.selection.first_gain_iterations)


def finish_refit(problem: SearchProblem, model: Model, begun: Candidate) -> Candidate:
    """The further iterations of a candidate's fit, to compare it with the model and with other candidates."""
    config = problem.config_with((*model.effects, begun.effect))
    cost = model.fit.cost
    fit = problem.fitter(model.scale).fit(config, begun.fit.free, begun.fit.z, compared_cost=cost)
    return Candidate(begun.effect, fit, cost - fit.cost)


def _distinct_starts(own: Sequence[FitParameter], starts: FloatArray, limit_ratios: Sequence[float]) -> FloatArray:
    """The initial points (k, n) of an effect's parameters without those whose fits end at the same minimum.

    Points of an effect with one number differ in size alone, so the best of them is sufficient for each choice. But a
    strong limit can lead to a local minimum, because the other parameters are those of the model without the limit, so
    weaker limits follow.
    """
    if len(own) == 1 and own[0].logarithmic:
        return np.array([[own[0].coordinate(ratio * float(own[0].value(starts[0, 0])))] for ratio in limit_ratios])
    choices = np.array([f.choice for f in own], bool)
    if len(own) - choices.sum() > 1:
        return starts
    _, first = np.unique(starts[:, choices], axis=0, return_index=True)
    return starts[np.sort(first)]


def fit_with_scale(
    problem: SearchProblem, effects: tuple[str, ...], start: FloatArray, free: tuple[FitParameter, ...] | None = None
) -> Model:
    """Alternate fits with ``effects`` and estimates of the error scale until the scale converges.

    The fits begin at coordinates ``start`` (n,) of the parameters ``free``, by default those of the problem.
    """
    settings, config = problem.settings.selection, problem.config_with(effects)
    free = problem.free_parameters(effects) if free is None else free
    scale = problem.scale_of(config, values_at(free, start))
    for _ in range(settings.scale_iterations):
        fit = problem.fitter(scale).fit(config, free, start)
        start = fit.z
        before, scale = scale, problem.scale_of(fit.config)
        if np.abs(scale.sigma / before.sigma - 1.0).max() < settings.scale_change_max:
            return Model(effects, fit, before)
    return Model(effects, problem.fitter(scale).fit(config, free, start), scale)


def fit_base(problem: SearchProblem) -> Model:
    """Fit the base parameters alone."""
    return fit_with_scale(problem, (), coordinates_in(problem.nominal, problem.free_parameters(())))
