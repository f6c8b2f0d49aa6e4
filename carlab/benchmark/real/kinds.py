"""Kinds of effects that a real recording can appear to have, each with three sizes and its true parameters.

A command column u becomes u' such that the effect maps u' to u: a model with the effect, driven by u', receives what
the real car received. Observation columns are computed as an additional sensor error would have changed them.
Commands (N,) are shares of full command; row k holds from its stamp to the next one.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy.interpolate import CubicSpline

from carlab.benchmark.effects.data_faults import Table
from carlab.benchmark.effects.observation_forms import ramp_filter
from carlab.benchmark.world.measurement import local_fit, wrapped
from carlab.benchmark.world.simulation import FloatArray
from carlab.core.planar import to_world

ZERO_COMMAND = 0.002
"""Share of full command below which a command counts as zero."""
SPIKE_RADPS = 1.0
"""A yaw rate this far from the slope of the yaw is a spike of its estimator."""
OBSERVED = ("x", "y", "yaw", "vx", "vy", "yaw_rate")
FULL_LOCK = 0.7
"""Full steering lock in the files of a proof; room for transformations that enlarge commands."""
MAX_INEXACT_SHARE = 0.1
"""Largest error of a transformation, as a share of the effect itself (root mean square); clipping causes it."""
Channel = Literal["steering", "throttle", "both", "observation"]


@dataclass(frozen=True)
class Truth:
    """The size of one parameter as a change against the car of the untouched recordings.

    ``size`` is added to the parameter, multiplies it, or is its value. With ``per_lock`` it is a steering command,
    which ``steering.max_angle`` of a car file converts to an angle.
    """

    parameter: str
    size: float
    composes: Literal["adds", "multiplies", "replaces"] = "adds"
    per_lock: bool = False


@dataclass(frozen=True)
class TransformedRecording:
    """A recording with one more effect, and what is true about it.

    ``inexact`` is the root mean square error of the transformation as a share of the effect.
    """

    table: Table
    truth: tuple[Truth, ...]
    inexact: float = 0.0


@dataclass(frozen=True)
class Kind:
    """A kind of effect.

    ``names`` are the ids that are correct answers; several where the transformed recordings are identical. The
    function gets the recording, the size and a random sign or angle in [0, 1). ``identity`` is the value of the
    parameter at which the effect does nothing.
    """

    id: str
    names: tuple[str, ...]
    channel: Channel
    sizes: tuple[float, float, float]
    change: Callable[[Table, float, float], TransformedRecording]
    identity: float = 0.0

    def as_dict(self, change: TransformedRecording, size: float) -> dict[str, Any]:
        """The answer, as JSON."""
        return {
            "id": self.id, "names": list(self.names), "size": size, "inexact": change.inexact,
            "truth": [vars(truth) for truth in change.truth],
        }  # fmt: skip


def _sign(draw: float) -> float:
    return 1.0 if draw < 0.5 else -1.0


def _delay(parameter: str, *channels: str) -> Callable[[Table, float, float], TransformedRecording]:
    def change(table: Table, size: float, draw: float) -> TransformedRecording:
        period_s = float(np.median(np.diff(table["t"])))
        rows = max(1, round(size / period_s))
        # The commands appear to act later; the last rows repeat the last command.
        moved = {name: np.append(table[name][rows:], np.full(rows, table[name][-1])) for name in channels}
        return TransformedRecording({**table, **moved}, (Truth(parameter, rows * period_s),))

    return change


def _before_lag(t_s: FloatArray, command: FloatArray, time_constant_s: float) -> tuple[FloatArray, FloatArray]:
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


def _lag(channel: str) -> Callable[[Table, float, float], TransformedRecording]:
    def change(table: Table, size: float, draw: float) -> TransformedRecording:
        earlier, lagged = _before_lag(table["t"], table[channel], size)
        mean = 0.5 * (table[channel] + np.concatenate([table[channel][:1], table[channel][:-1]]))
        untransformed = ramp_filter(table["t"], mean[:, None], size)[:, 0]
        inexact = float(np.std(lagged - mean) / max(np.std(untransformed - mean), 1e-9))
        return TransformedRecording({**table, channel: earlier}, (Truth("time_constant", size),), inexact)

    return change


def _gain(table: Table, size: float, draw: float) -> TransformedRecording:
    gain = (1.0 + size) ** _sign(draw)
    changed = {**table, "steering": table["steering"] / gain}
    return TransformedRecording(changed, (Truth("value", gain, "multiplies"),))


def _offset(table: Table, size: float, draw: float) -> TransformedRecording:
    shift = _sign(draw) * size * FULL_LOCK
    changed = {**table, "steering": table["steering"] - shift}
    return TransformedRecording(changed, (Truth("angle", shift, per_lock=True),))


def _asymmetry(table: Table, size: float, draw: float) -> TransformedRecording:
    gain = _sign(draw) * size
    changed = {**table, "steering": table["steering"] / (1.0 + gain * np.sign(table["steering"]))}
    return TransformedRecording(changed, (Truth("gain", gain),))


def _before_dead_band(command: FloatArray, half_width: float) -> FloatArray:
    """Command (N,) before a dead band that subtracts ``half_width``; commands of zero stay zero."""
    return command + half_width * np.clip(command / ZERO_COMMAND, -1.0, 1.0)


def _steering_dead_band(table: Table, size: float, draw: float) -> TransformedRecording:
    width = size * FULL_LOCK
    changed = {**table, "steering": _before_dead_band(table["steering"], 0.5 * width)}
    return TransformedRecording(changed, (Truth("width", width, per_lock=True),))


def _play(table: Table, size: float, draw: float) -> TransformedRecording:
    play = size * FULL_LOCK
    changed = {**table, "steering": table["steering"] + 0.5 * play * _direction(table["steering"])}
    return TransformedRecording(changed, (Truth("play", play, per_lock=True),))


def _direction(command: FloatArray) -> FloatArray:
    """Sign (N,) of the last change of a command (N,); 0 before the first one."""
    step = np.sign(np.diff(command, prepend=command[0]))
    last = np.maximum.accumulate(np.where(step != 0.0, np.arange(len(step)), 0))
    return np.asarray(step[last])


def _saturation(table: Table, size: float, draw: float) -> TransformedRecording:
    """``size``: the share by which the angle at full lock is smaller than a linear one."""
    x = float(np.interp(size, 1.0 - np.tanh(_ARGUMENTS) / _ARGUMENTS, _ARGUMENTS))  # tanh(x) = (1 - size) x
    saturation = FULL_LOCK / math.tanh(x)
    changed = {**table, "steering": saturation * np.arctanh(table["steering"] / saturation)}
    return TransformedRecording(changed, (Truth("saturation", saturation, "replaces", per_lock=True),))


_ARGUMENTS = np.linspace(0.01, 2.0, 400)


def _throttle_dead_band(table: Table, size: float, draw: float) -> TransformedRecording:
    changed = {**table, "throttle": _before_dead_band(table["throttle"] * (1.0 - size), size)}
    return TransformedRecording(changed, (Truth("width", size),))


def _exponent(table: Table, size: float, draw: float) -> TransformedRecording:
    exponent = (1.0 + size) ** _sign(draw)
    changed = {**table, "throttle": np.sign(table["throttle"]) * np.abs(table["throttle"]) ** (1.0 / exponent)}
    return TransformedRecording(changed, (Truth("exponent", exponent, "multiplies"),))


def _marker(table: Table, size: float, draw: float) -> TransformedRecording:
    """Track another point of the body: p + R(yaw) [ahead, left], with the velocity of that point."""
    ahead, left = size * math.cos(2.0 * math.pi * draw), size * math.sin(2.0 * math.pi * draw)
    rate = _yaw_rate_without_spikes(table)
    x, y = to_world(ahead, left, table["yaw"])
    moved = {
        "x": table["x"] + x,
        "y": table["y"] + y,
        "vx": table["vx"] - left * rate,
        "vy": table["vy"] + ahead * rate,
    }
    return TransformedRecording({**table, **moved}, (Truth("ahead", ahead), Truth("left", left)))


def _yaw_rate_without_spikes(table: Table) -> FloatArray:
    """The column (N,) [rad/s], with the slope of the yaw over five rows where the column is far from it."""
    yaw, period_s = np.unwrap(table["yaw"]), float(np.median(np.diff(table["t"])))
    slope = local_fit(yaw[:, None], 5, 2, period_s)[1][:, 0]
    return np.where(np.abs(table["yaw_rate"] - slope) > SPIKE_RADPS, slope, table["yaw_rate"])


def _misalignment(table: Table, size: float, draw: float) -> TransformedRecording:
    """Rotate the tracked body's axes against the car's."""
    angle = _sign(draw) * size
    cos, sin = np.cos(angle), np.sin(angle)
    vx, vy = cos * table["vx"] + sin * table["vy"], cos * table["vy"] - sin * table["vx"]
    rotated = {"yaw": wrapped(table["yaw"] + angle), "vx": vx, "vy": vy}
    return TransformedRecording({**table, **rotated}, (Truth("angle", angle),))


def _latency(table: Table, size: float, draw: float) -> TransformedRecording:
    """All observed columns are old, by cubic splines between rows; the first rows repeat the first."""
    t, out = table["t"], dict(table)
    for name in OBSERVED:
        values = np.unwrap(table[name]) if name == "yaw" else table[name]
        out[name] = CubicSpline(t, values)(np.maximum(t - size, t[0]))
    out["yaw"] = wrapped(out["yaw"])
    return TransformedRecording(out, (Truth("latency", size),))


def _filter(table: Table, size: float, draw: float) -> TransformedRecording:
    filtered = ramp_filter(table["t"], np.stack([table[name] for name in OBSERVED[3:]], axis=1), size)
    velocities = dict(zip(OBSERVED[3:], filtered.T, strict=True))
    return TransformedRecording({**table, **velocities}, (Truth("time_constant", size),))


_LATE = ("command_delay", "mocap_latency")  # all commands later and all measurements later are the same recording
DELAYS_S = (0.033, 0.067, 0.1)
KINDS = (
    Kind("command_delay", _LATE, "both", DELAYS_S, _delay("extra_delay", "steering", "throttle")),
    Kind("mocap_latency", (_LATE[1], _LATE[0]), "both", (0.02, 0.045, 0.08), _latency),
    Kind("steering_delay", ("steering_delay",), "steering", DELAYS_S, _delay("delay", "steering")),
    Kind("throttle_delay", ("throttle_delay",), "throttle", (0.067, 0.1, 0.2), _delay("delay", "throttle")),
    Kind("steering_lag", ("steering_lag",), "steering", (0.03, 0.05, 0.08), _lag("steering")),
    Kind("motor_lag", ("motor_lag",), "throttle", (0.03, 0.05, 0.1), _lag("throttle")),
    Kind("steering_gain", ("steering.max_angle",), "steering", (0.05, 0.1, 0.2), _gain),
    Kind("steering_offset", ("steering_offset",), "steering", (0.03, 0.06, 0.12), _offset),
    Kind("steering_asymmetry", ("steering_asymmetry",), "steering", (0.05, 0.1, 0.2), _asymmetry),
    Kind("steering_deadband", ("steering_deadband",), "steering", (0.08, 0.16, 0.3), _steering_dead_band),
    Kind("steering_backlash", ("steering_backlash",), "steering", (0.08, 0.16, 0.3), _play),
    Kind("steering_nonlinearity", ("steering_nonlinearity",), "steering", (0.06, 0.12, 0.24), _saturation, math.inf),
    Kind("throttle_deadband", ("throttle_deadband",), "throttle", (0.03, 0.06, 0.12), _throttle_dead_band),
    Kind("throttle_nonlinearity", ("throttle_nonlinearity",), "throttle", (0.1, 0.25, 0.5), _exponent, 1.0),
    Kind("marker_offset", ("marker_offset",), "observation", (0.01, 0.02, 0.04), _marker),
    Kind("mocap_yaw_misalignment", ("mocap_yaw_misalignment",), "observation", (0.01, 0.02, 0.04), _misalignment),
    Kind("velocity_filter_lag", ("velocity_filter_lag",), "observation", (0.03, 0.06, 0.12), _filter),
)
