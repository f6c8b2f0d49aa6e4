"""Candidates of a comparison, and the changes of the prediction errors by each of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from carlab.core.quantities import FloatArray
from carlab.diagnosis.identification.fit import Fit, Fitter
from carlab.diagnosis.identification.fit_parameters import (
    FitParameter,
    base_parameters,
    coordinates_in,
    effect_parameters,
    with_effect,
)
from carlab.diagnosis.selection.problem import is_applicable
from carlab.diagnosis.selection.screening import Screen
from carlab.diagnosis.settings import COMPARISON, SCREENING
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.effects import CATALOGUE


@dataclass(frozen=True, slots=True)
class ChangeCandidate:
    """An effect or a base parameter that may differ between groups, with its free parameters."""

    id: str
    free: tuple[FitParameter, ...]


@dataclass(frozen=True, slots=True)
class CandidatePoints:
    """A candidate with the points at which its secants are computed.

    config  simulator with the candidate, at its value in the reference model
    z0      (n,) coordinates of that value
    points  (P, n) coordinates
    """

    candidate: ChangeCandidate
    config: SimulatorConfig
    z0: FloatArray
    points: FloatArray

    def secants(self, fitter: Fitter, errors: FloatArray) -> FloatArray:
        """Changes (P, S, D) of the whitened errors (S, D) from ``z0`` to each point."""
        moved = fitter.white(self.config, self.candidate.free, self.points)
        changes = moved.reshape(len(self.points), *errors.shape) - errors
        return np.asarray(changes.clip(-COMPARISON.max_secant, COMPARISON.max_secant))


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
    return with_effect(config, candidate.id) if candidate.id in CATALOGUE else config


def candidate_points(fitter: Fitter, config: SimulatorConfig, candidate: ChangeCandidate) -> CandidatePoints:
    """Points of a candidate: of an absent effect as in a screening, of a known parameter one step to both sides."""
    whole = with_candidate(config, candidate)
    z0 = coordinates_in(whole, candidate.free)
    if whole is config:
        steps = np.vstack([np.eye(len(z0)), -np.eye(len(z0))])
        return CandidatePoints(candidate, whole, z0, z0 + steps)
    screening = replace(
        SCREENING,
        error_rms_changes=COMPARISON.error_rms_changes,
        typical_size_ratios=COMPARISON.typical_size_ratios,
    )
    screen = Screen(fitter, config, Fit(config, (), np.zeros(0), 0.0, np.zeros(0)), settings=screening)
    points = screen.points(candidate.id, candidate.free)
    chosen = np.unique(np.linspace(0, len(points) - 1, COMPARISON.max_points).round().astype(int))
    return CandidatePoints(candidate, whole, z0, points[chosen])


def size_of(candidate: ChangeCandidate, z: FloatArray, z0: FloatArray) -> FloatArray:
    """Change of each parameter's value (n,) from coordinates ``z0`` to ``z``, both (n,), without bounds."""
    return np.array([
        f.origin * (math.exp(f.size * a) - math.exp(f.size * b)) if f.logarithmic else f.size * (a - b)
        for f, a, b in zip(candidate.free, z, z0, strict=True)
    ])  # fmt: skip
