"""Transformations of the columns of a recording after which the car appears to have one additional effect.

A command column u becomes u' such that the effect maps u' to u: a model with the effect, driven by u', receives what
the real car received. Observation columns are computed as an additional sensor error would have changed them.
Commands (N,) are shares of full command; row k holds from its stamp to the next one.
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline

from carlab.benchmark.effects.data_faults import Table
from carlab.benchmark.effects.observation_forms import ramp_filter
from carlab.benchmark.world.measurement import local_fit, wrapped
from carlab.benchmark.world.simulation import FloatArray
from carlab.core.planar import to_world

ZERO_COMMAND = 0.002  # share of full command below which a command counts as zero
SPIKE_RADPS = 1.0  # a yaw rate this far from the slope of the yaw is a spike of its estimator
OBSERVED = ("x", "y", "yaw", "vx", "vy", "yaw_rate")


def issued_earlier(command: FloatArray, rows: int) -> FloatArray:
    """Command (N,) that appears to act ``rows`` rows later; the last rows repeat the last command."""
    return np.concatenate([command[rows:], np.full(rows, command[-1])])


def before_lag(t_s: FloatArray, command: FloatArray, time_constant_s: float) -> tuple[FloatArray, FloatArray]:
    """Command u' whose first-order lag passes through the mean of successive commands at each row's stamp.

    The output of a lag is continuous, so steps of the command become exponential pieces within two rows, without a
    delay. A value of u' outside [-1, 1] is clipped; the following rows make up for it.

    Returns:
        u' (N,), and the output of the lag at each row's stamp (N,).
    """
    keep = np.exp(-np.diff(t_s) / time_constant_s)
    mean = 0.5 * (command[1:] + command[:-1])
    lagged, earlier = command.copy(), command.copy()
    for k, a in enumerate(keep):
        earlier[k] = min(max((mean[k] - a * lagged[k]) / (1.0 - a), -1.0), 1.0)
        lagged[k + 1] = a * lagged[k] + (1.0 - a) * earlier[k]
    return earlier, lagged


def before_dead_band(command: FloatArray, half_width: float) -> FloatArray:
    """Command (N,) before a dead band that subtracts ``half_width``; commands of zero stay zero."""
    return command + half_width * np.clip(command / ZERO_COMMAND, -1.0, 1.0)


def before_play(command: FloatArray, play: float) -> FloatArray:
    """Command (N,) before a play operator of total width ``play``: half of it ahead in the direction of motion."""
    step = np.sign(np.diff(command, prepend=command[0]))
    moving = np.flatnonzero(step)
    if not moving.size:
        return command.copy()
    last = np.maximum.accumulate(np.where(step != 0.0, np.arange(len(step)), moving[0]))
    direction = np.where(np.arange(len(step)) < moving[0], 0.0, step[last])
    return command + 0.5 * play * direction


def before_saturation(command: FloatArray, saturation: float) -> FloatArray:
    """Command (N,) before ``saturation * tanh(u / saturation)``."""
    return saturation * np.arctanh(command / saturation)


def moved_point(table: Table, ahead_m: float, left_m: float) -> Table:
    """Track another point of the body: p + R(yaw) [ahead, left], with the velocity of that point."""
    rate = yaw_rate_without_spikes(table)
    x, y = to_world(ahead_m, left_m, table["yaw"])
    return {
        **table,
        "x": table["x"] + x,
        "y": table["y"] + y,
        "vx": table["vx"] - left_m * rate,
        "vy": table["vy"] + ahead_m * rate,
    }


def yaw_rate_without_spikes(table: Table) -> FloatArray:
    """The column (N,) [rad/s], with the slope of the yaw over five rows where the column is far from it."""
    yaw, period_s = np.unwrap(table["yaw"]), float(np.median(np.diff(table["t"])))
    slope = local_fit(yaw[:, None], 5, 2, period_s)[1][:, 0]
    return np.where(np.abs(table["yaw_rate"] - slope) > SPIKE_RADPS, slope, table["yaw_rate"])


def turned_frame(table: Table, angle_rad: float) -> Table:
    """Turn the tracked body's axes by ``angle_rad`` against the car's."""
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    return {
        **table,
        "yaw": wrapped(table["yaw"] + angle_rad),
        "vx": cos * table["vx"] + sin * table["vy"],
        "vy": cos * table["vy"] - sin * table["vx"],
    }


def delayed_observation(table: Table, latency_s: float) -> Table:
    """All observed columns are ``latency_s`` old, by cubic splines between rows; the first rows repeat the first."""
    t, out = table["t"], dict(table)
    for name in OBSERVED:
        values = np.unwrap(table[name]) if name == "yaw" else table[name]
        out[name] = CubicSpline(t, values)(np.maximum(t - latency_s, t[0]))
    out["yaw"] = wrapped(out["yaw"])
    return out


def filtered_velocity(table: Table, time_constant_s: float) -> Table:
    """Velocity columns after a first-order low-pass filter."""
    velocity = np.stack([table["vx"], table["vy"], table["yaw_rate"]], axis=1)
    filtered = ramp_filter(table["t"], velocity, time_constant_s)
    return {**table, **dict(zip(("vx", "vy", "yaw_rate"), filtered.T, strict=True))}
