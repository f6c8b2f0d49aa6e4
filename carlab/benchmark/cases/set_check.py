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


def mapped(channel: int, function: Callable[[FloatArray], FloatArray]) -> CommandChange:
    """Change of a channel (0 steering, 1 throttle) by a function without memory, of the commands (n,)."""

    def change(series: FloatArray, steps_s: FloatArray) -> FloatArray:
        out = series.copy()
        out[:, channel] = function(series[:, channel])
        return out

    return change


def _lag(channel: int, time_constant_s: float) -> CommandChange:
    def smooth(series: FloatArray, steps_s: FloatArray) -> FloatArray:
        out = series.copy()
        lag_s, state = max(time_constant_s, 1e-4), 0.0
        for k, (wanted, step_s) in enumerate(zip(series[:, channel].tolist(), steps_s.tolist(), strict=True)):
            decay = np.exp(-step_s / lag_s)
            out[k, channel] = wanted + (state - wanted) * lag_s / step_s * (1.0 - decay)
            state = wanted + (state - wanted) * decay
        return out

    return smooth


def _delay(channels: tuple[int, ...], delay_s: float) -> CommandChange:
    def shift(series: FloatArray, steps_s: FloatArray) -> FloatArray:
        edges = np.concatenate([[0.0], np.cumsum(steps_s)])
        out = series.copy()
        for k in channels:
            integral = np.concatenate([[0.0], np.cumsum(series[:, k] * steps_s)])
            out[:, k] = np.diff(np.interp(edges - delay_s, edges, integral)) / steps_s
        return out

    return shift


def _dead_band(half: float) -> CommandChange:
    return mapped(0, lambda u: u - np.clip(u, -half, half))


# By effect: change of the acting commands by a value v of its parameter in a car, and the range of the parameter.
COMMAND_EFFECTS: dict[str, tuple[Callable[[float, BaseCar], CommandChange], tuple[float, float]]] = {
    "command_delay": (lambda v, car: _delay((0, 1), v), (-0.03, 0.15)),
    "mocap_latency": (lambda v, car: _delay((0, 1), v), (-0.03, 0.15)),
    "steering_delay": (lambda v, car: _delay((0,), v), (0.0, 0.2)),
    "throttle_delay": (lambda v, car: _delay((1,), v), (0.0, 0.3)),
    "steering_lag": (lambda v, car: _lag(0, v), (0.0, 0.3)),
    "motor_lag": (lambda v, car: _lag(1, v), (0.0, 0.5)),
    "steering_deadband": (lambda v, car: _dead_band(0.5 * v / car.max_angle), (0.0, 0.3)),
    "steering_offset": (lambda v, car: mapped(0, lambda u: u + v / car.max_angle), (-0.1, 0.1)),
    "steering_asymmetry": (lambda v, car: mapped(0, lambda u: u * (1.0 + v * np.sign(u))), (-0.5, 0.5)),
    "throttle_deadband": (
        lambda v, car: mapped(1, lambda u: np.sign(u) * np.maximum(np.abs(u) - v, 0) / (1 - v)),
        (0.0, 0.3),
    ),
    "throttle_nonlinearity": (lambda v, car: mapped(1, lambda u: np.sign(u) * np.abs(u) ** v), (0.4, 2.5)),
    "throttle_asymmetry": (lambda v, car: mapped(1, lambda u: np.where(u < 0.0, v * u, u)), (0.2, 4.0)),
}


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
        None if one of the effects is not in COMMAND_EFFECTS.
    """
    if one not in COMMAND_EFFECTS or other not in COMMAND_EFFECTS:
        return None
    recordings = [_recording(table) for table in (fit, hold)]
    gain = _window_losses(one, nominal, recordings, floor) - _window_losses(other, nominal, recordings, floor)
    error = float(gain.std(ddof=1) * np.sqrt(len(gain)))
    return abs(float(gain.sum())) <= STANDARD_ERRORS * max(error, 1e-12)


def _window_losses(name: str, nominal: BaseCar, recordings: list[Recording], floor: FloatArray) -> FloatArray:
    change_of, bounds = COMMAND_EFFECTS[name]

    def cut(value: float) -> list[Windows]:
        changes = [change_of(value, nominal)]
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
