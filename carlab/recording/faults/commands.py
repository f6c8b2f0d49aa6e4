"""How the motion follows a command: a regression without a model of the car, over lags before and after.

Yaw rate follows steering, forward acceleration follows throttle. Both are fitted by products of the command, through a
first-order lag, with the speed, for every lag of a grid. The lag that fits best is the delay in the recording; servo,
motor and tyres add to the time constant.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.signal import savgol_filter

from carlab.core.quantities import FloatArray
from carlab.recording.column_mapping import COMMAND_CHANNELS
from carlab.recording.faults.fault import Fault
from carlab.recording.faults.robust import first_order_lag, held_means, parabola_minimum
from carlab.recording.faults.settings import LIMITS
from carlab.recording.pose_velocity import BoolArray, PoseMotion

LAGS_S = np.arange(-0.6, 0.8001, 0.02)
TIME_CONSTANTS_S = (0.0, 0.02, 0.04, 0.06, 0.09, 0.13, 0.18, 0.25)
MIN_MPS, MIN_ROWS = 0.4, 250
GRID_S, SLOPE_WINDOW_S = 0.02, 0.2
UNKNOWN_BEFORE_S, UNKNOWN_AFTER_S = 0.2, 0.6


@dataclass(frozen=True, slots=True)
class CommandResponse:
    """What a command explains of the motion.

    Attributes:
        explained: share of variance at each of LAGS_S (L,), the best over time constants.
        lag_s: the best lag, refined [s].
        time_constant_s: of the first-order lag there [s].
        gain: slope of the explained part over the command: [rad/m] for steering, [m/s^2] for throttle.
        t_s: stamps of the rows used (n,).
        target: yaw rate or acceleration there (n,), residual of its regression on the speed.
        predicted: the same by the command at each lag (L, n), with the coefficients of the best lag.
    """

    explained: FloatArray
    lag_s: float
    time_constant_s: float
    gain: float
    t_s: FloatArray
    target: FloatArray
    predicted: FloatArray

    @property
    def best(self) -> float:
        """The largest share explained."""
        return float(self.explained.max())

    @property
    def is_lag_inside(self) -> bool:
        """Whether the best lag lies inside the grid; at its edge, the motion does not show the lag."""
        return bool(LAGS_S[0] < self.lag_s < LAGS_S[-1])


@dataclass(frozen=True, slots=True)
class GridMotion:
    """Velocities and forward acceleration on an even grid (n,); ``rows`` (n,) are those to fit.

    spans_s are the widths over which the velocities and, again, the acceleration were averaged.
    """

    t_s: FloatArray
    period_s: float
    vx: FloatArray
    yaw_rate: FloatArray
    acceleration: FloatArray
    rows: BoolArray
    spans_s: tuple[float, float]


def grid_motion(t_s: FloatArray, motion: PoseMotion, segment: FloatArray) -> GridMotion:
    """Velocities by the pose, and the forward acceleration dvx/dt - vy r, on a grid of 20 ms or the row period."""
    period = float(np.median(np.diff(t_s)))
    step = max(period, GRID_S)
    grid = np.arange(t_s[0], t_s[-1], step)
    vx, vy, rate = (np.interp(grid, t_s, c) for c in (motion.vx, motion.vy, motion.yaw_rate))
    width = max(2 * round(0.5 * SLOPE_WINDOW_S / step) + 1, 5)
    spans = ((2 * motion.half_rows + 1) * period, width * step)
    if len(grid) < width:
        return GridMotion(grid, step, vx, rate, np.zeros_like(vx), np.zeros(len(grid), dtype=bool), spans)
    slope = savgol_filter(vx, width, 2, deriv=1, delta=step)
    rows = (np.abs(vx) > MIN_MPS) & (np.abs(vy) < 0.6 * np.abs(vx)) & (np.abs(rate) < 15.0)
    rows &= (np.abs(slope) < 30.0) & (grid > t_s[0] + UNKNOWN_AFTER_S) & (grid < t_s[-1] - UNKNOWN_AFTER_S)
    for row in np.flatnonzero(np.diff(segment) != 0):  # the command across a gap is not known
        rows &= (grid < t_s[row] - UNKNOWN_BEFORE_S) | (grid > t_s[row + 1] + UNKNOWN_AFTER_S)
    return GridMotion(grid, step, vx, rate, slope - vy * rate, rows, spans)


@dataclass(frozen=True, slots=True)
class _Regression:
    """Regression of the motion on functions of a delayed command; ``base`` (n, b) are functions of the speed."""

    motion: GridMotion
    channel: str
    rows: np.ndarray
    base: FloatArray

    def without_base(self, values: FloatArray) -> FloatArray:
        """Residuals of values (n,) or (n, k) in the regression on ``base``."""
        result: FloatArray = values - self.base @ (self.base.T @ values)
        return result

    def delayed(self, filtered: FloatArray, lag_s: float) -> FloatArray:
        """The command at the rows (n,), ``lag_s`` before."""
        return np.asarray(np.interp(self.motion.t_s[self.rows] - lag_s, self.motion.t_s, filtered))

    def terms(self, command: FloatArray) -> FloatArray:
        """Functions (n, k) of the command (n,), as residuals of the regression on ``base``."""
        size = np.abs(command)
        if self.channel == "throttle":
            return self.without_base(np.column_stack([command, command * size, command * size * size]))
        vx = self.motion.vx[self.rows]
        product = command * vx
        terms = [product, product * size * size, product * np.abs(vx), product * size]
        return self.without_base(np.column_stack(terms))


def command_response(motion: GridMotion, t_s: FloatArray, command: FloatArray, channel: str) -> CommandResponse | None:
    """Fit the motion by a command (N,) held from each of ``t_s`` (N,) on. None where the motion is too short."""
    rows = np.flatnonzero(motion.rows)
    if len(rows) < MIN_ROWS or np.std(command) < LIMITS.constant_command:
        return None
    rows = rows[:: max(1, len(rows) // 6000)]
    vx, rate = motion.vx[rows], motion.yaw_rate[rows]
    columns = [np.ones_like(vx), vx, vx * np.abs(vx)]
    if channel == "throttle":
        columns += [rate**2, np.abs(rate), np.abs(rate * vx)]
    fit = _Regression(motion, channel, rows, np.linalg.qr(np.column_stack(columns))[0])
    target = fit.without_base(rate if channel == "steering" else motion.acceleration[rows])
    total = float(target @ target)
    if total < 1e-9:
        return None
    smooth = held_means(t_s, command, motion.t_s - 0.5 * motion.period_s, motion.period_s)
    for span_s in motion.spans_s[: 1 + COMMAND_CHANNELS.index(channel)]:
        smooth = _slope_average(smooth, round(span_s / motion.period_s))
    explained = np.zeros(len(LAGS_S))
    best_share, time_constant, lag, coefficients = -np.inf, 0.0, 0.0, np.zeros(0)
    for time_constant_s in TIME_CONSTANTS_S:
        filtered = first_order_lag(smooth, motion.period_s, time_constant_s)
        for k, lag_s in enumerate(LAGS_S):
            terms = fit.terms(fit.delayed(filtered, lag_s))
            normal = terms.T @ terms + 1e-9 * np.eye(terms.shape[1])
            solved = np.asarray(np.linalg.lstsq(normal, terms.T @ target, rcond=None)[0], dtype=np.float64)
            residual = target - terms @ solved
            share = 1.0 - float(residual @ residual) / total
            explained[k] = max(explained[k], share)
            if share > best_share:
                best_share, time_constant, lag, coefficients = share, time_constant_s, float(lag_s), solved
    filtered = first_order_lag(smooth, motion.period_s, time_constant)
    predicted = np.stack([fit.terms(fit.delayed(filtered, lag_s)) @ coefficients for lag_s in LAGS_S])
    command_there = fit.delayed(filtered, lag)
    lever = fit.without_base(command_there * vx if channel == "steering" else command_there)
    gain = float(predicted[int(np.argmin(np.abs(LAGS_S - lag)))] @ lever) / (float(lever @ lever) + 1e-18)
    lag_s = parabola_minimum(LAGS_S, -explained)
    return CommandResponse(explained, lag_s, time_constant, gain, motion.t_s[rows], target, predicted)


def wrong_command_sign(channel: str, response: CommandResponse, evidence: Mapping[str, float] | None = None) -> Fault:
    """The fault of a command that the motion follows the other way round."""
    effect = "turns right" if channel == "steering" else "is driven backward"
    observation = f"with positive {channel} the car {effect} (this explains {response.best:.0%} of the motion)"
    return Fault("wrong_sign", channel, observation, evidence or {}, f"--{channel}-sign -1")


def _slope_average(values: FloatArray, width: int) -> FloatArray:
    """Average (n,) as the slope of a line through ``width`` rows averages the derivative: parabolic weights."""
    edges = np.arange(1.0, width)
    weights: FloatArray = edges * (width - edges)
    if len(weights) < 2:
        return values
    if len(weights) % 2 == 0:
        weights = np.convolve(weights, [0.5, 0.5])
    half = len(weights) // 2
    padded = np.concatenate([np.full(half, values[0]), values, np.full(half, values[-1])])
    return np.convolve(padded, weights / weights.sum(), mode="valid")
