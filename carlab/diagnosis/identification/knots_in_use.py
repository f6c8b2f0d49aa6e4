"""Knots of measured curves that influence a prediction window.

A curve is interpolated between its knots, so a window depends on the knots next to the states and commands that it
passes through, and on no other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from carlab.core.quantities import FloatArray
from carlab.prediction.predict import longest_step_s, simulate_windows
from carlab.prediction.windows import PredictionWindows
from sim_backends.array_ops import ARRAYS, Value
from sim_backends.batch.rollout import CARS_AT_ONCE
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.effects import EFFECTS, MeasuredCurve
from sim_backends.effects.curves import free_knots, report_evaluations, weights

BoolArray = NDArray[np.bool_]


def influencing_parameters(
    windows: PredictionWindows, config: SimulatorConfig, values: Mapping[str, FloatArray]
) -> BoolArray:
    """Whether each parameter may change the prediction of each window.

    Args:
        windows: S windows.
        config: the simulator.
        values: n parameters by dotted name, each (1,).

    Returns:
        (n, S). It is false for the deviation of a measured curve at a knot that the window does not use.
    """
    influences = np.ones((len(values), len(windows)), dtype=bool)
    row = {name: k for k, name in enumerate(values)}
    names = {name.split(".")[1] for name in values if name.startswith("effects.")}
    curves = [e for e in (EFFECTS[n] for n in sorted(names)) if isinstance(e, MeasuredCurve)]
    if not curves:
        return influences
    for first in range(0, len(windows), CARS_AT_ONCE):
        part = np.arange(first, min(first + CARS_AT_ONCE, len(windows)))
        used = knots_in_use(windows.take(part), config, values, curves)
        for curve in curves:
            for parameter, place in zip(curve.parameters, free_knots(curve.axes), strict=True):
                if (k := row.get(f"effects.{curve.id}.{parameter.name}")) is not None:
                    influences[k, part] = used[curve.id][place]
    return influences


def knots_in_use(
    windows: PredictionWindows,
    config: SimulatorConfig,
    values: Mapping[str, FloatArray],
    curves: Sequence[MeasuredCurve],
) -> dict[str, BoolArray]:
    """For each curve, whether each of its knots has a weight in each of at most ``CARS_AT_ONCE`` windows.

    Returns:
        By id of the curve, (knots of the first axis, knots of the second axis if any, S).
    """
    count = len(windows)
    used = {curve.id: np.zeros((*(len(axis.knots) for axis in curve.axes), count), dtype=bool) for curve in curves}

    def mark(curve: MeasuredCurve, coordinates: Sequence[Value]) -> None:
        if curve.id not in used:  # a curve of the car file, which is not fitted
            return
        used[curve.id] |= knot_weights(curve, coordinates, count) > 0.0

    step_s = longest_step_s(windows, config, values)
    ignored = np.errstate(over="ignore", invalid="ignore", divide="ignore")  # a diverged simulation
    with ignored, report_evaluations(mark):
        simulate_windows(windows, config, values, max_step_s=step_s, engine="operators")
    return used


def knot_weights(curve: MeasuredCurve, coordinates: Sequence[Value], count: int) -> FloatArray:
    """Interpolation weights (A, n) or (A, B, n) of the knots of one or two axes at ``count`` = n points.

    ``coordinates`` are those of the points on each axis, each (n,) or a number.
    """
    by_axis = [
        np.stack(np.broadcast_arrays(*weights(ARRAYS, np.broadcast_to(np.asarray(x), count), axis.knots)))
        for x, axis in zip(coordinates, curve.axes, strict=True)
    ]
    return by_axis[0] if len(by_axis) == 1 else by_axis[0][:, None] * by_axis[1][None]
