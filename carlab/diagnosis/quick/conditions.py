"""Conditions in which a simulator has large errors: speed, commands, place and time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from carlab.core.quantities import FloatArray
from carlab.diagnosis.settings import QUICK
from carlab.prediction.windows import PredictionWindows

BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class ErrorCondition:
    """A condition.

    text               such as ``speed > 2 m/s``
    inside, outside    root mean square error of the worst channel in and outside the condition, in noise floors
    windows            number of windows in it
    """

    text: str
    inside: float
    outside: float
    windows: int


def find_conditions(windows: PredictionWindows, size: FloatArray) -> tuple[ErrorCondition, ...]:
    """Conditions in which errors ``size`` (S,) are significantly larger than elsewhere, the most significant first.

    Of conditions of one kind (thresholds of a feature, places) only the most significant is returned.
    """
    best: dict[str, tuple[float, ErrorCondition]] = {}
    for kind, text, inside in _candidates(windows):
        if min(inside.sum(), (~inside).sum()) < QUICK.condition_windows_min:
            continue
        squared = size**2
        within, outside = squared[inside], squared[~inside]
        error = np.sqrt(within.var() / len(within) + outside.var() / len(outside))
        z = float(within.mean() - outside.mean()) / max(float(error), 1e-9)
        found = ErrorCondition(text, float(np.sqrt(within.mean())), float(np.sqrt(outside.mean())), int(inside.sum()))
        if found.inside < QUICK.condition_ratio_min * found.outside or z < QUICK.condition_z_min:
            continue
        if kind not in best or z > best[kind][0]:
            best[kind] = (z, found)
    return tuple(c for _, c in sorted(best.values(), key=lambda b: -b[0]))[: QUICK.max_conditions]


def _candidates(windows: PredictionWindows) -> Iterator[tuple[str, str, BoolArray]]:
    commands = windows.commands
    steering, throttle = commands[:, :, 0], commands[:, :, 1]
    ahead = windows.measured[:, :, 3]
    turning = windows.measured[:, :, 5]
    rates = np.abs(np.diff(commands, axis=1)) / windows.period_s
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
    late = windows.t0_s > np.median(windows.t0_s)
    yield "time", f"later than {np.median(windows.t0_s):.1f} s of an episode", late
    yield "time", f"before {np.median(windows.t0_s):.1f} s of an episode", ~late
    yield from _places(windows)


def _places(windows: PredictionWindows) -> Iterator[tuple[str, str, BoolArray]]:
    paths = windows.measured[:, :, :2]
    cells = (
        np.unique(np.round(paths.reshape(-1, 2) / QUICK.place_spacing_m).astype(np.int64), axis=0)
        * QUICK.place_spacing_m
    )
    for x, y in cells:
        near = (np.hypot(paths[..., 0] - x, paths[..., 1] - y) < QUICK.place_radius_m).any(axis=1)
        yield "place", f"within {QUICK.place_radius_m:.1f} m of ({x:.1f}, {y:.1f})", near
