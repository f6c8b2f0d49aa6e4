"""Candidates of a comparison, and their fits in one group with all other parameters fixed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from carlab.core.quantities import FloatArray
from carlab.diagnosis.identification.fit import (
    Fit,
    FitParameter,
    Fitter,
    base_parameters,
    effect_parameters,
    with_effect,
)
from carlab.diagnosis.selection.problem import is_applicable
from carlab.diagnosis.selection.screening import Screen
from carlab.diagnosis.settings import ComparisonSettings
from carlab.prediction.windows import IndexArray
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.effects import CATALOGUE

MAX_STEP = 8.0
"""Maximum step of a coordinate beyond a bound, as in a fit."""


@dataclass(frozen=True, slots=True)
class ChangeCandidate:
    """An effect or a base parameter that may differ between groups, with its free parameters."""

    id: str
    free: tuple[FitParameter, ...]


@dataclass(frozen=True, slots=True)
class Group:
    """Prediction windows of one group of recordings with their error scale, and the fold of each window (S,)."""

    fitter: Fitter
    folds: IndexArray


def change_candidates(config: SimulatorConfig, only: Sequence[str] | None = None) -> list[ChangeCandidate]:
    """Effects of the catalogue, present or not, and base parameters; ``only`` restricts them to these ids."""
    found = [
        ChangeCandidate(name, tuple(replace(f, prior_z=math.inf) for f in effect_parameters(name, config)))
        for name in CATALOGUE
        if name in config.effects or is_applicable(config, name)
    ]
    found += [ChangeCandidate(f.name, (replace(f, prior_z=math.inf),)) for f in base_parameters(config)]
    return [c for c in found if only is None or c.id in only]


def with_candidate(config: SimulatorConfig, candidate: ChangeCandidate) -> SimulatorConfig:
    """The simulator with an effect added at its identity value if it is not present."""
    is_new = candidate.id in CATALOGUE and candidate.id not in config.effects
    return with_effect(config, candidate.id) if is_new else config


def fit_in_group(
    group: Group, config: SimulatorConfig, candidate: ChangeCandidate, settings: ComparisonSettings
) -> Fit:
    """Fit the candidate's parameters to one group from several initial points; other parameters stay."""
    whole = with_candidate(config, candidate)
    fitter = group.fitter
    starts = [present(whole, candidate)]
    if candidate.id in CATALOGUE and candidate.id not in config.effects:
        empty = Fit(config, (), np.zeros(0), 0.0, np.zeros(0))
        starts += list(Screen(fitter, config, empty).score(candidate.id, candidate.free).starts)
    start = fitter.best_point(whole, candidate.free, np.array(starts))
    fit = fitter.fit(whole, candidate.free, start, iterations=settings.iterations)
    within_bounds = [f.coordinate(float(f.value(z))) for f, z in zip(fit.free, fit.z, strict=True)]
    return fitter.with_covariance(replace(fit, z=np.array(within_bounds)))


def unbounded_optimum(fitter: Fitter, fit: Fit) -> FloatArray:
    """Coordinates (n,) after one Gauss-Newton step without bounds.

    Missing physics may ask for a negative lag in both groups. A fit that stops at 0 in one group alone would bias the
    difference.
    """
    jacobian, white = fitter.linearised(fit)
    weight = np.minimum(1.0, fitter.settings.huber_delta / np.maximum(np.abs(white), 1e-12)).reshape(-1)
    flat = jacobian.reshape(len(fit.free), -1)
    step = -np.linalg.pinv((flat * weight) @ flat.T) @ (flat @ (weight * white.reshape(-1)))
    return np.asarray(fit.z + np.clip(step, -MAX_STEP, MAX_STEP))


def present(config: SimulatorConfig, candidate: ChangeCandidate) -> FloatArray:
    """Coordinates (n,) of the candidate's parameters in the simulator."""
    values = config.values()
    return np.array([f.coordinate(values[f.name]) for f in candidate.free])


__all__ = [
    "ChangeCandidate",
    "Group",
    "change_candidates",
    "fit_in_group",
    "present",
    "unbounded_optimum",
    "with_candidate",
]
