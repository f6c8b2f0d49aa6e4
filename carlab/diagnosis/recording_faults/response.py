"""How the motion follows a command: a regression without a model of the car, over lags before and after.

Yaw rate follows steering, forward acceleration follows throttle. Both are fitted by a few products of the command,
through a first-order lag, with the speed, for every lag of a grid. The lag that fits best is the delay, as the
recording has it; a mean of thousands of rows, it is good to a few milliseconds, and what servo, motor and tyres add
goes into the time constant.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import savgol_filter

from carlab.core.quantities import FloatArray
from carlab.diagnosis.recording_faults.episode_motion import BoolArray, Patient, held_means, lagged

CHANNELS = ("steering", "throttle")
LAGS_S = np.arange(-0.6, 0.8001, 0.02)
TIME_CONSTANTS_S = (0.0, 0.02, 0.04, 0.06, 0.09, 0.13, 0.18, 0.25)
_LEAST_MPS = 0.4
_LEAST_ROWS = 250
_GRID_S = 0.02
_SMOOTH_S = 0.2


@dataclass(frozen=True, slots=True)
class Response:
    """What a command explains of the motion.

    explained (L,) is its best share of variance over time constants at each of LAGS_S; lag_s the best lag, refined;
    sign that of the effect there; t_s (n,), target (n,) and predicted (L, n) are at the rows used, by the coefficients
    of the best lag and time constant.
    """

    explained: FloatArray
    lag_s: float
    time_constant_s: float
    sign: float
    t_s: FloatArray
    target: FloatArray
    predicted: FloatArray

    @property
    def best(self) -> float:
        """The largest share explained."""
        return float(self.explained.max())


@dataclass(frozen=True, slots=True)
class Motion:
    """The motion on an even grid (n,) with the rows that say something (n,).

    spans_s are the widths over which velocities and, again, the acceleration were averaged.
    """

    t_s: FloatArray
    period_s: float
    vx: FloatArray
    vy: FloatArray
    yaw_rate: FloatArray
    acceleration: FloatArray
    rows: BoolArray
    spans_s: tuple[float, float]


def motion_of(patient: Patient) -> Motion:
    """Velocities by the pose, and the forward acceleration dvx/dt - vy r, on a grid of 20 ms or the row period."""
    by_pose = patient.motion()
    times = patient.times_s
    step = max(patient.period_s, _GRID_S)
    grid = np.arange(times[0], times[-1], step)
    vx, vy, rate = (np.interp(grid, times, c) for c in (by_pose.vx, by_pose.vy, by_pose.yaw_rate))
    width = max(2 * round(0.5 * _SMOOTH_S / step) + 1, 5)
    slope = savgol_filter(vx, width, 2, deriv=1, delta=step)
    rows = (np.abs(vx) > _LEAST_MPS) & (np.abs(vy) < 0.6 * np.abs(vx)) & (np.abs(rate) < 15.0)
    rows &= (np.abs(slope) < 30.0) & (grid > times[0] + 0.6) & (grid < times[-1] - 0.6)
    for row in np.flatnonzero(np.diff(patient.segment) != 0):  # what was held across a gap is not known
        rows &= (grid < times[row] - 0.2) | (grid > times[row + 1] + 0.6)
    spans = ((2 * by_pose.half_rows + 1) * patient.period_s, width * step)
    return Motion(grid, step, vx, vy, rate, slope - vy * rate, rows, spans)


def response(motion: Motion, t_s: FloatArray, command: FloatArray, channel: str) -> Response | None:
    """Fit the motion by a command (N,) held from each of ``t_s`` (N,) on. None where there is too little to see."""
    rows = np.flatnonzero(motion.rows)
    if len(rows) < _LEAST_ROWS or np.std(command) < 0.02:
        return None
    rows = rows[:: max(1, len(rows) // 6000)]
    vx, rate = motion.vx[rows], motion.yaw_rate[rows]
    target = rate if channel == "steering" else motion.acceleration[rows]
    beside = [np.ones_like(vx), vx, vx * np.abs(vx)]
    if channel == "throttle":
        beside += [rate**2, np.abs(rate), np.abs(rate * vx)]
    base, _ = np.linalg.qr(np.column_stack(beside))
    wanted = target - base @ (base.T @ target)
    total = float(wanted @ wanted)
    if total < 1e-9:
        return None
    smooth = held_means(t_s, command, motion.t_s - 0.5 * motion.period_s, motion.period_s)
    for span_s in motion.spans_s[: 1 if channel == "steering" else 2]:
        smooth = _as_a_slope_sees_it(smooth, round(span_s / motion.period_s))
    explained = np.zeros(len(LAGS_S))
    best: tuple[float, float, FloatArray, FloatArray, FloatArray] | None = None
    for time_constant_s in TIME_CONSTANTS_S:
        filtered = lagged(smooth, motion.period_s, time_constant_s)
        for k, lag_s in enumerate(LAGS_S):
            u = np.interp(motion.t_s[rows] - lag_s, motion.t_s, filtered)
            terms = _terms(u, vx, channel)
            rest = terms - base @ (base.T @ terms)
            normal = rest.T @ rest + 1e-9 * np.eye(terms.shape[1])
            solved = np.asarray(np.linalg.lstsq(normal, rest.T @ wanted, rcond=None)[0], dtype=np.float64)
            left = wanted - rest @ solved
            share = 1.0 - float(left @ left) / total
            explained[k] = max(explained[k], share)
            if best is None or share > best[0]:
                best = (share, time_constant_s, solved, rest, u)
    if best is None:
        return None
    _, time_constant_s, solved, rest, u = best
    part = rest @ solved
    lever = u * vx if channel == "steering" else u
    lever = lever - base @ (base.T @ lever)
    filtered = lagged(smooth, motion.period_s, time_constant_s)
    predicted = np.empty((len(LAGS_S), len(rows)))
    for index, lag_s in enumerate(LAGS_S):
        terms = _terms(np.interp(motion.t_s[rows] - lag_s, motion.t_s, filtered), vx, channel)
        predicted[index] = (terms - base @ (base.T @ terms)) @ solved
    return Response(
        explained,
        refined(LAGS_S, -explained),
        time_constant_s,
        float(np.sign(part @ lever)),
        motion.t_s[rows],
        wanted,
        predicted,
    )


def refined(lags_s: FloatArray, cost: FloatArray) -> float:
    """The lag of the least cost, by a parabola through it and its neighbours."""
    k = int(np.argmin(cost))
    if not 0 < k < len(cost) - 1:
        return float(lags_s[k])
    before, here, after = cost[k - 1 : k + 2]
    bend = before - 2.0 * here + after
    return float(lags_s[k] + (0.5 * (before - after) / bend if bend > 0 else 0.0) * (lags_s[1] - lags_s[0]))


def _as_a_slope_sees_it(values: FloatArray, width: int) -> FloatArray:
    """Average (n,) as the slope of a line through ``width`` rows averages the derivative: a parabola of weights."""
    edges = np.arange(1.0, width)
    weights: FloatArray = edges * (width - edges)
    if len(weights) < 2:
        return values
    if len(weights) % 2 == 0:
        weights = np.convolve(weights, [0.5, 0.5])
    half = len(weights) // 2
    padded = np.concatenate([np.full(half, values[0]), values, np.full(half, values[-1])])
    return np.convolve(padded, weights / weights.sum(), mode="valid")


def _terms(u: FloatArray, vx: FloatArray, channel: str) -> FloatArray:
    if channel == "steering":
        return np.column_stack([u * vx, u**3 * vx, u * vx * np.abs(vx), u * np.abs(u) * vx])
    return np.column_stack([u, u * np.abs(u), u**3])
