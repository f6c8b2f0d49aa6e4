"""Test whether a recording distinguishes two effects, by a refit of each with the base parameters by the generator.

The test covers effects of commands and latency, for which it is cheap. For other effects it returns None, and only the
table of confusable effects counts.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from scipy.optimize import minimize_scalar

from carlab.benchmark.cases.refit import (
    CommandChange,
    Windows,
    channel_scores,
    cut_windows,
    in_start_frame,
    refit,
    roll,
)
from carlab.benchmark.world.base_car import BaseCar
from carlab.benchmark.world.measurement import Recording
from carlab.benchmark.world.simulation import FloatArray

STANDARD_ERRORS = 2.0


# Change of (steering and throttle (n, 2), step lengths (n,) [s]) by the parameter of an effect, for a car.
SizedChange = Callable[[FloatArray, FloatArray, float, BaseCar], FloatArray]


def _lag(channel: int) -> SizedChange:
    def smooth(series: FloatArray, steps_s: FloatArray, value: float, car: BaseCar) -> FloatArray:
        out = series.copy()
        lag, state = max(value, 1e-4), 0.0
        for k, (wanted, step_s) in enumerate(zip(series[:, channel].tolist(), steps_s.tolist(), strict=True)):
            decay = np.exp(-step_s / lag)
            out[k, channel] = wanted + (state - wanted) * lag / step_s * (1.0 - decay)
            state = wanted + (state - wanted) * decay
        return out

    return smooth


def _map(channel: int, function: Callable[[FloatArray, float, BaseCar], FloatArray]) -> SizedChange:
    def apply(series: FloatArray, steps_s: FloatArray, value: float, car: BaseCar) -> FloatArray:
        out = series.copy()
        out[:, channel] = function(series[:, channel], value, car)
        return out

    return apply


def _late(channels: tuple[int, ...]) -> SizedChange:
    def shift(series: FloatArray, steps_s: FloatArray, value: float, car: BaseCar) -> FloatArray:
        edges = np.concatenate([[0.0], np.cumsum(steps_s)])
        out = series.copy()
        for k in channels:
            whole = np.concatenate([[0.0], np.cumsum(series[:, k] * steps_s)])
            out[:, k] = np.diff(np.interp(edges - value, edges, whole)) / steps_s
        return out

    return shift


def _deadband(u: FloatArray, width: float, car: BaseCar) -> FloatArray:
    half = 0.5 * width / car.max_angle
    return u - np.clip(u, -half, half)


# By effect: change of the acting commands, and range of its parameter.
CHEAP: dict[str, tuple[SizedChange, tuple[float, float]]] = {
    "command_delay": (_late((0, 1)), (-0.03, 0.15)),
    "mocap_latency": (_late((0, 1)), (-0.03, 0.15)),
    "steering_delay": (_late((0,)), (0.0, 0.2)),
    "throttle_delay": (_late((1,)), (0.0, 0.3)),
    "steering_lag": (_lag(0), (0.0, 0.3)),
    "motor_lag": (_lag(1), (0.0, 0.5)),
    "steering_deadband": (_map(0, _deadband), (0.0, 0.3)),
    "steering_offset": (_map(0, lambda u, v, car: u + v / car.max_angle), (-0.1, 0.1)),
    "steering_asymmetry": (_map(0, lambda u, v, car: u * (1.0 + v * np.sign(u))), (-0.5, 0.5)),
    "throttle_deadband": (_map(1, lambda u, v, car: np.sign(u) * np.maximum(np.abs(u) - v, 0) / (1 - v)), (0.0, 0.3)),
    "throttle_nonlinearity": (_map(1, lambda u, v, car: np.sign(u) * np.abs(u) ** v), (0.4, 2.5)),
}


def command_change(name: str, value: float, car: BaseCar) -> CommandChange:
    """The change of the acting commands by an effect of CHEAP with a value of its parameter."""
    change = CHEAP[name][0]
    return lambda series, steps_s: change(series, steps_s, value, car)


def indistinguishable(
    one: str,
    other: str,
    nominal: BaseCar,
    fit: Mapping[str, FloatArray],
    hold: Mapping[str, FloatArray],
    floor: FloatArray,
) -> bool | None:
    """Whether two effects, each refitted with the base parameters, are within two standard errors on held-out windows.

    Args:
        one: An effect's id.
        other: Another effect's id.
        nominal: The nominal car.
        fit: Columns (N,) of the recording to fit, evenly spaced.
        hold: Columns of the held-out recording.
        floor: Noise floors of the six channels (6,).

    Returns:
        None if one of the effects is not in CHEAP.
    """
    if one not in CHEAP or other not in CHEAP:
        return None
    recordings = [_recording(table) for table in (fit, hold)]
    gain = _window_losses(one, nominal, recordings, floor) - _window_losses(other, nominal, recordings, floor)
    error = float(gain.std(ddof=1) * np.sqrt(len(gain)))
    return abs(float(gain.sum())) <= STANDARD_ERRORS * max(error, 1e-12)


def _window_losses(name: str, nominal: BaseCar, recordings: list[Recording], floor: FloatArray) -> FloatArray:
    _, bounds = CHEAP[name]

    def cut(value: float) -> list[Windows]:
        changes = [command_change(name, value, nominal)]
        return [cut_windows(r, nominal, every_s=1.0, changes=changes).with_floor(floor) for r in recordings]

    def cost(value: float) -> float:
        windows = cut(value)
        fitted = refit(windows[0], windows[0], nominal, iterations=4)
        return float((channel_scores(windows[0], fitted.values) ** 2).sum())

    best = minimize_scalar(
        cost, bounds=bounds, method="bounded", options={"xatol": 0.01 * (bounds[1] - bounds[0]), "maxiter": 14}
    )
    windows = cut(float(best.x))
    values = refit(windows[0], windows[1], nominal).values
    ends = roll(nominal, values, windows[1].starts, windows[1].commands, windows[1].steps_s)
    errors = in_start_frame(ends - windows[1].recorded, windows[1].starts) / floor
    return np.asarray(0.5 * (errors**2).sum(axis=1), dtype=np.float64)


def _recording(table: Mapping[str, FloatArray]) -> Recording:
    pose = [table["x"], table["y"], np.unwrap(table["yaw"])]
    measured = np.stack([*pose, table["vx"], table["vy"], table["yaw_rate"]], axis=1)
    return Recording(
        table["t"], measured, np.stack([table["steering"], table["throttle"]], axis=1), np.zeros_like(measured)
    )
