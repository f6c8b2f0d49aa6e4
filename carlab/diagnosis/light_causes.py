"""What may have taken reality out of the simulator: one effect or one number at a time, judged where it was not fitted.

First every effect of the catalogue and every number of the car file is screened by itself, the rest being as the file
says; the most promising are fitted. Where none of them explains the most of it, all numbers are refitted together, and
effects are tried beside them. Who comes first is decided on alternate stretches: fitted to one half, asked of the
other.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from carlab.core.quantities import FloatArray
from carlab.diagnosis.fit import (
    Fit,
    Fitter,
    Free,
    Scale,
    base_parameters,
    clustered_gain,
    effect_parameters,
    with_effect,
)
from carlab.diagnosis.screen import Screen, usable
from carlab.diagnosis.shots import Shots
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.effects import CATALOGUE
from sim_backends.registry import REGISTRY

SCREENED_SHOTS = 60
SINGLES, BESIDE, JUDGED = 8, 4, 6
"""Candidates that are fitted by themselves and beside the numbers, and those of both that are judged on other rows."""
STEPS, HALF_STEPS = 6, 4
"""Steps of a fit, and of one to half of the shots that begins where the whole fit ended."""
USED_STEPS = 6
ENOUGH = 0.8
"""Share of the excess that one cause must explain for the numbers to be left as they are."""
LEAST_SHARE = 0.1
"""A cause that explains less of the excess is no guess."""
LEAST_BESIDE = 0.25
SURE_STANDARD_ERRORS = 2.0
"""An effect beside the numbers must explain so much of what they leave, and so certainly."""
UNSEEN_AT_MOST = 25.0
EQUAL_STANDARD_ERRORS = 2.0
MOST = 3
_Z = ((-3.0, -1.0, 1.0, 3.0), (-3.0, -1.0, -0.3, 0.3, 1.0, 3.0))
NUMBERS = "numbers"


@dataclass(frozen=True, slots=True)
class FittedNumber:
    """A fitted number, what it came to on either half of the stretches, and what the simulator had, in ``unit``."""

    value: float
    halves: tuple[float, float]
    before: float | None
    unit: str


@dataclass(frozen=True, slots=True)
class Cause:
    """A guess.

    Attributes:
        id: an effect of the catalogue, a number by its dotted name, or ``numbers``, all of them together.
        share: of the excess loss that it explains on stretches that it was not fitted to, in [0, 1].
        beside_numbers: whether all numbers of the car file were refitted with it; ``share`` is that of both.
        own_share: of an effect beside refitted numbers, the share that it explains of what they leave.
        like_the_first: whether the stretches cannot tell it from the first guess (two standard errors).
        parameters: its numbers; of ``numbers`` those that moved most.
    """

    id: str
    share: float
    own_share: float
    beside_numbers: bool
    like_the_first: bool
    parameters: dict[str, FittedNumber] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class _Candidate:
    id: str
    config: SimulatorConfig
    free: tuple[Free, ...]
    fit: Fit
    beside: bool = False


def causes_of(shots: Shots, floor: FloatArray, simulator: SimulatorConfig) -> tuple[Cause, ...]:
    """The most likely causes, the best first.

    Args:
        shots: of recordings that the simulator does not explain.
        floor: noise floor along a shot (K + 1, 6).
        simulator: as it is.
    """
    steps = np.unique(np.linspace(shots.steps / USED_STEPS, shots.steps, USED_STEPS).round().astype(int))
    fitter = Fitter(shots, Scale(steps, floor[steps]))
    as_it_is = fitter.fit(simulator, ())
    found = _singles(fitter, simulator, as_it_is)
    halves = _halves(shots)
    reference = fitter.loss(simulator, most=UNSEEN_AT_MOST)
    perfect = 0.5 * len(steps) * 6 * len(shots)
    excess = max(float(reference.sum()) - perfect, 1e-9)
    judged = [_judged(fitter, c, halves) for c in sorted(found, key=lambda c: c.fit.cost)[:JUDGED]]
    before = reference
    if not judged or max(float((reference - loss).sum()) for _, loss, _ in judged) < ENOUGH * excess:
        refit, more = _beside(fitter, simulator)
        numbers = _judged(fitter, refit, halves)
        before = numbers[1]
        judged += [numbers, *(_judged(fitter, c, halves) for c in more)]
    judged.sort(key=lambda j: float(j[1].sum()))
    causes, seen = list[Cause](), set[str]()
    for candidate, loss, parts in judged:
        share = own = min(float((reference - loss).sum()) / excess, 1.0)
        if candidate.beside:
            own = _own_share(before, loss, perfect, shots)
        enough = share >= LEAST_SHARE and own >= (LEAST_BESIDE if candidate.beside else LEAST_SHARE)
        if candidate.id in seen or not enough or len(causes) == MOST:
            continue
        gap, error = clustered_gain(loss, judged[0][1], shots)
        alike = bool(causes) and gap < EQUAL_STANDARD_ERRORS * error
        seen.add(candidate.id)
        fitted = _numbers(candidate, parts, simulator)
        causes.append(Cause(candidate.id, share, own, candidate.beside, alike, fitted))
    return tuple(causes)


def _own_share(before: FloatArray, after: FloatArray, perfect: float, shots: Shots) -> float:
    """Share of what the numbers leave that an effect beside them explains; 0 where that is not certain."""
    gain, error = clustered_gain(before, after, shots)
    left = float(before.sum()) - perfect
    return min(gain / left, 1.0) if left > 0.0 and gain > SURE_STANDARD_ERRORS * error else 0.0


def _singles(fitter: Fitter, simulator: SimulatorConfig, as_it_is: Fit) -> list[_Candidate]:
    """Single causes that promise most, fitted while the rest is as it is."""
    screen = Screen(fitter, simulator, as_it_is, SCREENED_SHOTS)
    promised: list[tuple[float, str, SimulatorConfig, tuple[Free, ...], FloatArray]] = []
    for name in _new_effects(simulator):
        free = effect_parameters(name, simulator)
        promise = screen.promise(name, free)
        promised.append((promise.gain, name, with_effect(simulator, name), free, promise.starts))
    for name, free in _own_numbers(simulator):
        at = _coordinates(simulator, free)
        points = np.array([at + z * axis for axis in np.eye(len(free)) for z in _Z[not free[0].logarithmic]])
        gains = [screen.gain(moved) for moved in screen.fitter.white(simulator, free, points)]
        best = int(np.argmax([gain for gain, _ in gains]))
        start = at + (points[best] - at) * min(max(gains[best][1], 0.3), 1.5)
        promised.append((gains[best][0] / screen.share, name, simulator, free, start[None]))
    promised.sort(key=lambda p: -p[0])
    found = []
    for _, name, config, free, starts in promised[:SINGLES]:
        start = fitter.best_start(config, free, starts)
        found.append(_Candidate(name, config, free, fitter.fit(config, free, start, iterations=STEPS)))
    return found


def _beside(fitter: Fitter, simulator: SimulatorConfig) -> tuple[_Candidate, list[_Candidate]]:
    """All numbers refitted, and with that the effects that promise most beside them."""
    own = [f for name in simulator.effects for f in effect_parameters(name, simulator)]
    free = (*base_parameters(simulator), *own)
    refit = fitter.fit(simulator, free, _coordinates(simulator, free), iterations=STEPS)
    screen = Screen(fitter, simulator, refit, SCREENED_SHOTS)
    promises = [screen.promise(name, effect_parameters(name, simulator)) for name in _new_effects(simulator)]
    promises.sort(key=lambda p: -p.gain)
    found = []
    for promise in promises[:BESIDE]:
        config = with_effect(simulator, promise.effect)
        every = (*free, *effect_parameters(promise.effect, simulator))
        start = np.concatenate([refit.z, promise.starts[0]])
        fit = fitter.fit(config, every, start, iterations=STEPS)
        found.append(_Candidate(promise.effect, config, every, fit, beside=True))
    return _Candidate(NUMBERS, simulator, free, refit), found


def _judged(
    fitter: Fitter, candidate: _Candidate, halves: tuple[np.ndarray, np.ndarray]
) -> tuple[_Candidate, FloatArray, tuple[Fit, Fit]]:
    """Loss of every shot (S,) by a fit to the other half, and the two fits."""
    loss = np.zeros(len(fitter.shots))
    fits = []
    for mine, others in (halves, halves[::-1]):
        own = Fitter(fitter.shots.take(mine), fitter.scale)
        fits.append(own.fit(candidate.config, candidate.free, candidate.fit.z, iterations=HALF_STEPS))
        judge = Fitter(fitter.shots.take(others), fitter.scale)
        loss[others] = judge.loss(candidate.config, candidate.free, fits[-1].z, most=UNSEEN_AT_MOST)
    return candidate, loss, (fits[0], fits[1])


def _halves(shots: Shots) -> tuple[np.ndarray, np.ndarray]:
    """Indices of alternate blocks: episodes, where there are several."""
    _, index = np.unique(shots.block, return_inverse=True)
    odd = index % 2 == 1
    if not odd.any():
        odd = np.arange(len(shots)) >= len(shots) // 2
    return np.flatnonzero(~odd), np.flatnonzero(odd)


def _new_effects(simulator: SimulatorConfig) -> list[str]:
    return [name for name in CATALOGUE if name not in simulator.effects and usable(simulator, name)]


def _own_numbers(simulator: SimulatorConfig) -> list[tuple[str, tuple[Free, ...]]]:
    """Numbers that the simulator has: those of the base model one by one, those of each of its effects together."""
    single = [(f.name, (f,)) for f in base_parameters(simulator)]
    return [*single, *((f"effects.{name}", effect_parameters(name, simulator)) for name in simulator.effects)]


def _coordinates(simulator: SimulatorConfig, free: Sequence[Free]) -> FloatArray:
    values = simulator.values()
    return np.array([f.coordinate(values[f.name]) for f in free])


def _numbers(candidate: _Candidate, parts: tuple[Fit, Fit], simulator: SimulatorConfig) -> dict[str, FittedNumber]:
    before = simulator.values()
    whole, first, second = candidate.fit.values(), parts[0].values(), parts[1].values()
    if candidate.id == NUMBERS:
        moved = sorted(candidate.free, key=lambda f: -_moved(whole[f.name], before[f.name]))
        names = [f.name for f in moved[:MOST]]
    else:
        own = f"effects.{candidate.id.removeprefix('effects.')}."
        names = [name for name in whole if name == candidate.id or name.startswith(own)]
    return {
        name: FittedNumber(whole[name], (first[name], second[name]), before.get(name), REGISTRY[name].unit)
        for name in names
    }


def _moved(value: float, before: float) -> float:
    return abs(math.log(value / before)) if value > 0.0 and before > 0.0 else abs(value - before)


__all__ = ["NUMBERS", "Cause", "FittedNumber", "causes_of"]
