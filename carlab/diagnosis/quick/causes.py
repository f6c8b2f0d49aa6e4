"""Likely causes of a simulator's errors: one effect or one parameter at a time, tested by cross-validation.

Each effect of the catalogue and each parameter of the car file is screened alone, and those with the best scores are
fitted. If none of them explains most of the excess, all parameters are refitted together, and effects are added to the
refit. The causes are ranked by two-fold cross-validation over alternate blocks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from carlab.core.quantities import FloatArray
from carlab.diagnosis.identification.block_jackknife import clustered_gain
from carlab.diagnosis.identification.error_scale import Scale
from carlab.diagnosis.identification.fit import Fit, Fitter
from carlab.diagnosis.identification.fit_parameters import (
    FitParameter,
    base_parameters,
    coordinates_in,
    effect_parameters,
    stated_effects,
    stated_parameters,
    with_effect,
)
from carlab.diagnosis.selection.problem import is_applicable
from carlab.diagnosis.selection.screening import Screen
from carlab.diagnosis.settings import QUICK
from carlab.prediction.windows import PredictionWindows
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.effects import CATALOGUE
from sim_backends.registry import REGISTRY

SCREENED_COORDINATES = ((-3.0, -1.0, 1.0, 3.0), (-3.0, -1.0, -0.3, 0.3, 1.0, 3.0))
"""Coordinate steps at which a parameter is screened: of its logarithm, or of its value."""
ALL_PARAMETERS = "numbers"
"""Id of the cause "all parameters refitted"."""
GRIP, GRIP_PARAMETERS = "tyre.mu", ("tyre.front.mu", "tyre.rear.mu")
"""Id of the cause "grip of both axles": another floor or other tyres change both."""


@dataclass(frozen=True, slots=True)
class FittedParameterValue:
    """A fitted parameter in ``unit``: by all windows, by each half of them, and in the simulator before the fit."""

    value: float
    halves: tuple[float, float]
    before: float | None
    unit: str


@dataclass(frozen=True, slots=True)
class Cause:
    """A candidate cause.

    Attributes:
        id: an effect of the catalogue, a parameter by its dotted name, ``tyre.mu``: the friction of both axles, or
            ``numbers``: all parameters together.
        share: share of the excess loss that it explains on windows that were not fitted, in [0, 1].
        own_share: of an effect added to a refit, its share of the excess loss that the refit leaves.
        with_refit: whether all parameters were refitted with it; ``share`` is that of both.
        ties_with_first: whether the windows do not distinguish it from the first cause (two standard errors).
        parameters: fitted values; of ``numbers``, those with the largest change.
    """

    id: str
    share: float
    own_share: float
    with_refit: bool
    ties_with_first: bool
    parameters: dict[str, FittedParameterValue] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class _Candidate:
    id: str
    config: SimulatorConfig
    free: tuple[FitParameter, ...]
    fit: Fit
    with_refit: bool = False


@dataclass(frozen=True, slots=True)
class _Tested:
    """A candidate, the loss of every window (S,) by a fit to the other half, and the two fits."""

    candidate: _Candidate
    loss: FloatArray
    halves: tuple[Fit, Fit]


def find_causes(windows: PredictionWindows, floor: FloatArray, simulator: SimulatorConfig) -> tuple[Cause, ...]:
    """The most likely causes, the best first.

    Args:
        windows: windows of recordings that the simulator does not explain.
        floor: noise floor along a window (K + 1, 6).
        simulator: the simulator without the causes.
    """
    fitter = Fitter(windows, Scale.of_floor(floor))
    reference = fitter.loss(simulator, max_error=QUICK.max_left_out_error)
    perfect = 0.5 * len(fitter.scale.steps) * 6 * len(windows)
    excess = max(float(reference.sum()) - perfect, 1e-9)
    halves = _halves(windows)
    singles = _fit_singles(fitter, simulator)
    best = sorted(singles, key=lambda c: c.fit.cost)[: QUICK.max_tested]
    tested = [_test(fitter, c, halves) for c in best]
    before = reference
    largest = max((float((reference - t.loss).sum()) for t in tested), default=-math.inf)
    if largest < QUICK.single_cause_share * excess:
        refit, added = _fit_with_refit(fitter, simulator)
        refitted = _test(fitter, refit, halves)
        before = refitted.loss
        tested += [refitted, *(_test(fitter, c, halves) for c in added)]
    tested.sort(key=lambda t: float(t.loss.sum()))
    causes, seen = list[Cause](), set[str]()
    for t in tested:
        share = own_share = min(float((reference - t.loss).sum()) / excess, 1.0)
        if t.candidate.with_refit:
            own_share = _own_share(before, t.loss, perfect, windows)
        min_own_share = QUICK.min_additional_share if t.candidate.with_refit else QUICK.min_share
        relevant = share >= QUICK.min_share and own_share >= min_own_share
        if t.candidate.id in seen or not relevant or len(causes) == QUICK.max_causes:
            continue
        difference, error = clustered_gain(t.loss, tested[0].loss, windows)
        ties = bool(causes) and difference < QUICK.tie_z * error
        seen.add(t.candidate.id)
        values = _reported_values(t, simulator)
        causes.append(Cause(t.candidate.id, share, own_share, t.candidate.with_refit, ties, values))
    return tuple(causes)


def _own_share(before: FloatArray, after: FloatArray, perfect: float, windows: PredictionWindows) -> float:
    """Share that an effect explains of the excess after a refit; 0 if it is not significant."""
    gain, error = clustered_gain(before, after, windows)
    excess = float(before.sum()) - perfect
    significant = gain > QUICK.min_additional_z * error
    return min(gain / excess, 1.0) if excess > 0.0 and significant else 0.0


def _fit_singles(fitter: Fitter, simulator: SimulatorConfig) -> list[_Candidate]:
    """Single causes with the best screening scores, each fitted alone."""
    screen = Screen(fitter, simulator, fitter.fit(simulator, ()), QUICK.screened_windows)
    screened: list[tuple[float, str, SimulatorConfig, tuple[FitParameter, ...], FloatArray]] = []
    for name in _new_effects(simulator):
        free, result = effect_parameters(name, simulator), screen.score(name)
        screened.append((result.score, name, with_effect(simulator, name), free, result.starts))
    for name, free in _simulator_parameters(simulator):
        score, start = _screen_parameters(screen, simulator, free)
        screened.append((score, name, simulator, free, start[None]))
    screened.sort(key=lambda entry: -entry[0])
    found = []
    for _, name, config, free, starts in screened[: QUICK.max_single_fits]:
        start = fitter.best_point(config, free, starts)
        fit = fitter.fit(config, free, start, iterations=QUICK.fit_iterations)
        found.append(_Candidate(name, config, free, fit))
    return found


def _screen_parameters(
    screen: Screen, simulator: SimulatorConfig, free: tuple[FitParameter, ...]
) -> tuple[float, FloatArray]:
    """Screening score of parameters of the simulator, and the initial point (n,) of their fit."""
    at = coordinates_in(simulator, free)
    sizes = SCREENED_COORDINATES[not free[0].logarithmic]
    axes = np.eye(len(free)) if free[0].name not in GRIP_PARAMETERS else np.ones((1, len(free)))
    points = np.array([at + z * axis for axis in axes for z in sizes])
    gains = [screen.gain(whites) for whites in screen.fitter.white(simulator, free, points)]
    best = int(np.argmax([gain for gain, _ in gains]))
    low, high = screen.settings.step_range
    return gains[best][0] / screen.share, at + (points[best] - at) * min(max(gains[best][1], low), high)


def _fit_with_refit(fitter: Fitter, simulator: SimulatorConfig) -> tuple[_Candidate, list[_Candidate]]:
    """Refit all parameters, and add the effects with the best screening scores to the refit."""
    free = stated_parameters(simulator)
    refit = fitter.fit(simulator, free, coordinates_in(simulator, free), iterations=QUICK.fit_iterations)
    screen = Screen(fitter, simulator, refit, QUICK.screened_windows)
    screened = [screen.score(name) for name in _new_effects(simulator)]
    screened.sort(key=lambda result: -result.score)
    found = []
    for result in screened[: QUICK.max_additional_fits]:
        config = with_effect(simulator, result.effect)
        all_free = (*free, *effect_parameters(result.effect, simulator))
        start = np.concatenate([refit.z, result.starts[0]])
        fit = fitter.fit(config, all_free, start, iterations=QUICK.fit_iterations)
        found.append(_Candidate(result.effect, config, all_free, fit, with_refit=True))
    return _Candidate(ALL_PARAMETERS, simulator, free, refit), found


def _test(fitter: Fitter, candidate: _Candidate, halves: tuple[np.ndarray, np.ndarray]) -> _Tested:
    """Two-fold cross-validation of a candidate."""
    loss = np.zeros(len(fitter.windows))
    fits = []
    start, iterations = candidate.fit.z, QUICK.half_fit_iterations
    for mine, others in (halves, halves[::-1]):
        own = Fitter(fitter.windows.take(mine), fitter.scale)
        fits.append(own.fit(candidate.config, candidate.free, start, iterations=iterations))
        left_out = Fitter(fitter.windows.take(others), fitter.scale)
        loss[others] = left_out.loss(candidate.config, candidate.free, fits[-1].z, max_error=QUICK.max_left_out_error)
    return _Tested(candidate, loss, (fits[0], fits[1]))


def _halves(windows: PredictionWindows) -> tuple[np.ndarray, np.ndarray]:
    """Indices of alternate blocks: episodes, where there are several."""
    _, index = np.unique(windows.block, return_inverse=True)
    odd = index % 2 == 1
    if not odd.any():
        odd = np.arange(len(windows)) >= len(windows) // 2
    return np.flatnonzero(~odd), np.flatnonzero(odd)


def _new_effects(simulator: SimulatorConfig) -> list[str]:
    return [name for name in CATALOGUE if name not in simulator.effects and is_applicable(simulator, name)]


def _simulator_parameters(simulator: SimulatorConfig) -> list[tuple[str, tuple[FitParameter, ...]]]:
    """Parameters of the simulator: those of the base model one by one, the grip of both axles, those of each effect."""
    base = base_parameters(simulator)
    single = [(f.name, (f,)) for f in base]
    grip = tuple(f for f in base if f.name in GRIP_PARAMETERS)
    both = [(GRIP, grip)] if len(grip) == len(GRIP_PARAMETERS) else []
    effects = [(f"effects.{name}", effect_parameters(name, simulator)) for name in stated_effects(simulator)]
    return [*single, *both, *effects]


def _reported_values(tested: _Tested, simulator: SimulatorConfig) -> dict[str, FittedParameterValue]:
    candidate = tested.candidate
    before = simulator.values()
    whole, (first, second) = candidate.fit.values(), (half.values() for half in tested.halves)
    if candidate.id == ALL_PARAMETERS:
        ordered = sorted(candidate.free, key=lambda f: -_change(whole[f.name], before[f.name]))
        names = [f.name for f in ordered[: QUICK.max_causes]]
    elif candidate.id == GRIP:
        names = list(GRIP_PARAMETERS)
    else:
        own = f"effects.{candidate.id.removeprefix('effects.')}."
        names = [name for name in whole if name == candidate.id or name.startswith(own)]
    return {
        name: FittedParameterValue(whole[name], (first[name], second[name]), before.get(name), REGISTRY[name].unit)
        for name in names
    }


def _change(value: float, before: float) -> float:
    return abs(math.log(value / before)) if value > 0.0 and before > 0.0 else abs(value - before)
