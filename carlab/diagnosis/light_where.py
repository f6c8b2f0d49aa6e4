"""In what condition a simulator is wrong: how the car was driven, where it was, and when."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from carlab.core.quantities import FloatArray
from carlab.diagnosis.shots import Shots

BoolArray = NDArray[np.bool_]
LEAST_RATIO = 1.5
"""Errors must be so much larger in a condition than out of it to be told."""
LEAST_SHOTS = 4
MOST = 3
PLACE_RADIUS_M = 0.5
PLACE_SPACING_M = 0.5
LEAST_STANDARD_ERRORS = 2.5


@dataclass(frozen=True, slots=True)
class Condition:
    """A condition in words; root mean square error [noise floors] of the worst channel within and without; shots."""

    text: str
    inside: float
    outside: float
    shots: int


def conditions(shots: Shots, size: FloatArray) -> tuple[Condition, ...]:
    """Conditions in which errors ``size`` (S,) are clearly larger than elsewhere, the clearest first, at most three.

    Of conditions of one kind (thresholds of a feature, places) only the clearest is told.
    """
    best: dict[str, tuple[float, Condition]] = {}
    for kind, text, inside in _candidates(shots):
        if min(inside.sum(), (~inside).sum()) < LEAST_SHOTS:
            continue
        squared = size**2
        within, without = squared[inside], squared[~inside]
        error = np.sqrt(within.var() / len(within) + without.var() / len(without))
        certain = float(within.mean() - without.mean()) / max(float(error), 1e-9)
        found = Condition(text, float(np.sqrt(within.mean())), float(np.sqrt(without.mean())), int(inside.sum()))
        if found.inside < LEAST_RATIO * found.outside or certain < LEAST_STANDARD_ERRORS:
            continue
        if kind not in best or certain > best[kind][0]:
            best[kind] = (certain, found)
    return tuple(c for _, c in sorted(best.values(), key=lambda b: -b[0]))[:MOST]


def _candidates(shots: Shots) -> Iterator[tuple[str, str, BoolArray]]:
    acting = shots.commands
    steering, throttle = acting[:, :, 0], acting[:, :, 1]
    ahead = shots.measured[:, :, 3]
    turning = shots.measured[:, :, 5]
    rates = np.abs(np.diff(acting, axis=1)) / shots.period_s
    braking = np.mean(throttle * ahead[:, :-1] < 0.0, axis=1)
    features = (
        ("speed", "m/s", np.abs(ahead).mean(axis=1)),
        ("|steering|", "", np.abs(steering).mean(axis=1)),
        ("|steering rate|", "/s", rates[:, :, 0].mean(axis=1)),
        ("|throttle|", "", np.abs(throttle).mean(axis=1)),
        ("|throttle rate|", "/s", rates[:, :, 1].mean(axis=1)),
        ("lateral acceleration", "m/s2", np.abs(ahead * turning).mean(axis=1)),
        ("share of braking", "", braking),
    )
    for name, unit, value in features:
        for share in (0.5, 2 / 3):
            limit = float(np.quantile(value, share))
            yield name, f"{name} > {limit:.2g} {unit}".strip(), value > limit
        limit = float(np.quantile(value, 1 / 3))
        yield name, f"{name} < {limit:.2g} {unit}".strip(), value < limit
    left, forward = steering.mean(axis=1) > 0.0, ahead.mean(axis=1) > 0.0
    yield "side", "steering to the left", left
    yield "side", "steering to the right", ~left
    yield "direction", "driving forwards", forward
    yield "direction", "driving backwards", ~forward
    late = shots.t0_s > np.median(shots.t0_s)
    yield "time", f"later than {np.median(shots.t0_s):.1f} s of an episode", late
    yield "time", f"before {np.median(shots.t0_s):.1f} s of an episode", ~late
    yield from _places(shots)


def _places(shots: Shots) -> Iterator[tuple[str, str, BoolArray]]:
    paths = shots.measured[:, :, :2]
    cells = np.unique(np.round(paths.reshape(-1, 2) / PLACE_SPACING_M).astype(np.int64), axis=0) * PLACE_SPACING_M
    for x, y in cells:
        near = (np.hypot(paths[..., 0] - x, paths[..., 1] - y) < PLACE_RADIUS_M).any(axis=1)
        yield "place", f"within {PLACE_RADIUS_M:.1f} m of ({x:.1f}, {y:.1f})", near


__all__ = ["Condition", "conditions"]
