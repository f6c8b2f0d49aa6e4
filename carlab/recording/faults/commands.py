"""How the motion follows a command: a regression without a model of the car, over lags before and after.

Yaw rate follows steering, forward acceleration follows throttle. Both are fitted by products of the command, through a
first-order lag, with the speed, for every lag of a grid. The lag that fits best is the delay in the recording; servo,
motor and tyres add to the time constant.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
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
MAX_GAP_S = 5.0
"""Longest gap whose rows of the grid are a step apart. Two drives of one file may be days apart."""


@dataclass(frozen=True, slots=True)
class CommandResponse:
    """What a command explains of the motion.

    Attributes:
        explained: share of variance at each of LAGS_S (L,), the best over time constants.
        lag_s: the best lag, refined [s].
        time_constant_s: of the first-order lag there [s].
        gain: slope of the explained part over the command: [rad/m] for steering, [m/s^2] for throttle.
        t_s: stamps of the rows used (n,).
        target: yaw rate [rad/s] or acceleration [m/s2] there (n,), residual of its regression on the speed.
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
    """Velocities and forward acceleration on an even grid of n rows.

    ``t_s``, ``vx`` [m/s], ``yaw_rate`` [rad/s], ``acceleration`` [m/s2] and ``rows``, the rows to fit, are (n,).
    ``spans_s`` are the widths over which the velocities and, again, the acceleration were averaged.
    """

    t_s: FloatArray
    period_s: float
    vx: FloatArray
    yaw_rate: FloatArray
    acceleration: FloatArray
    rows: BoolArray
    spans_s: tuple[float, float]


def grid_motion(t_s: FloatArray, motion: PoseMotion, segment: FloatArray) -> GridMotion:
    """Velocities by the pose, and the forward acceleration dvx/dt - vy r, on a grid of 20 ms or the row period.

    ``motion`` and ``segment`` (N,), the number of the unbroken stretch, are those at the stamps (N,).
    """
    period = float(np.median(np.diff(t_s)))
    step = max(period, GRID_S)
    grid = _even_times(t_s, step)
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


def _even_times(t_s: FloatArray, step_s: float) -> FloatArray:
    """Times (n,) from the first to the last of ``t_s`` (N,), a step apart; further apart in gaps beyond MAX_GAP_S."""
    gaps_s = np.diff(t_s)
    if gaps_s.max() <= MAX_GAP_S:
        return np.arange(t_s[0], t_s[-1], step_s)
    shortened = np.concatenate([[0.0], np.cumsum(np.minimum(gaps_s, MAX_GAP_S))])
    return np.interp(np.arange(0.0, shortened[-1], step_s), shortened, t_s)


@dataclass(frozen=True, slots=True)
class CommandRegression:
    """Regression of the motion on functions of a delayed command, at every lag of ``LAGS_S``.

    Attributes:
        channel: of the command.
        vx: speed at the rows (n,).
        base: orthonormal functions of the speed (n, b).
        target: residual of the motion in the regression on ``base`` (n,).
        rows_before: rows of the grid at or before the delayed times (L, n).
        next_row_weight: weight of the next row in the linear interpolation at the delayed times (L,).
    """

    channel: str
    vx: FloatArray
    base: FloatArray
    target: FloatArray
    rows_before: NDArray[np.intp]
    next_row_weight: FloatArray

    @classmethod
    def of(cls, motion: GridMotion, channel: str, rows: NDArray[np.intp]) -> CommandRegression:
        """The regression at rows of the grid."""
        vx, rate = motion.vx[rows], motion.yaw_rate[rows]
        columns = [np.ones_like(vx), vx, vx * np.abs(vx)]
        if channel == "throttle":
            columns += [rate**2, np.abs(rate), np.abs(rate * vx)]
        base = np.linalg.qr(np.column_stack(columns))[0]
        values = rate if channel == "steering" else motion.acceleration[rows]
        lags = LAGS_S / motion.period_s
        whole_lags = np.ceil(lags - 1e-9)
        rows_before = np.clip(rows - whole_lags[:, None].astype(np.intp), 0, len(motion.t_s) - 2)
        return cls(channel, vx, base, values - base @ (base.T @ values), rows_before, whole_lags - lags)

    def delayed(self, filtered: FloatArray, lag: int) -> FloatArray:
        """The command at the delayed times of a lag (n,), interpolated on the grid."""
        first, second = filtered[self.rows_before[lag]], filtered[self.rows_before[lag] + 1]
        return np.asarray(first + self.next_row_weight[lag] * (second - first))

    def terms(self, command: FloatArray) -> FloatArray:
        """Functions (k, n) of the delayed command (n,)."""
        size = np.abs(command)
        if self.channel == "throttle":
            return np.stack([command, command * size, command * size * size])
        product = command * self.vx
        return np.stack([product, product * size * size, product * np.abs(self.vx), product * size])

    def fit(self, filtered: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Shares of variance explained (L,) and coefficients (L, k), in addition to ``base``, at each lag."""
        base_and_target = np.column_stack([self.base, self.target])
        products = []
        for lag in range(len(LAGS_S)):
            terms = self.terms(self.delayed(filtered, lag))
            products.append((terms @ base_and_target, terms @ terms.T))
        projections, normal = (np.stack(part) for part in zip(*products, strict=True))
        by_base, by_target = projections[:, :, :-1], projections[:, :, -1]
        normal = normal - by_base @ by_base.transpose(0, 2, 1)
        ridge = 1e-9 * np.eye(normal.shape[1])
        coefficients = (np.linalg.pinv(normal + ridge, hermitian=True) @ by_target[:, :, None])[:, :, 0]
        quadratic = np.einsum("lk,lkj,lj->l", coefficients, normal, coefficients)
        explained_squares = 2.0 * np.einsum("lk,lk->l", coefficients, by_target) - quadratic
        return explained_squares / float(self.target @ self.target), coefficients

    def predicted(self, filtered: FloatArray, lag: int, coefficients: FloatArray) -> FloatArray:
        """What the terms explain (n,) at a lag, in addition to ``base``."""
        return self.without_base(coefficients @ self.terms(self.delayed(filtered, lag)))

    def without_base(self, values: FloatArray) -> FloatArray:
        """Residuals of values (n,) in the regression on ``base``."""
        return np.asarray(values - self.base @ (self.base.T @ values))


def command_response(motion: GridMotion, t_s: FloatArray, command: FloatArray, channel: str) -> CommandResponse | None:
    """Fit the motion by a command (N,) held from each of ``t_s`` (N,) on. None where the motion is too short."""
    rows = np.flatnonzero(motion.rows)
    if len(rows) < MIN_ROWS or np.std(command) < LIMITS.constant_command:
        return None
    rows = rows[:: max(1, len(rows) // 6000)]
    regression = CommandRegression.of(motion, channel, rows)
    if float(regression.target @ regression.target) < 1e-9:
        return None
    smooth = averaged_as_motion(motion, t_s, command, channel)
    explained = np.zeros(len(LAGS_S))
    best_share, time_constant, lag, coefficients = -np.inf, 0.0, 0, np.zeros(0)
    for time_constant_s in TIME_CONSTANTS_S:
        shares, by_lag = regression.fit(first_order_lag(smooth, motion.period_s, time_constant_s))
        explained = np.maximum(explained, shares)
        if shares.max() > best_share:
            lag = int(np.argmax(shares))
            best_share, time_constant, coefficients = float(shares[lag]), time_constant_s, by_lag[lag]
    filtered = first_order_lag(smooth, motion.period_s, time_constant)
    predicted = np.stack([regression.predicted(filtered, k, coefficients) for k in range(len(LAGS_S))])
    lever = regression.delayed(filtered, lag)
    lever = regression.without_base(lever * regression.vx if channel == "steering" else lever)
    gain = float(predicted[lag] @ lever) / (float(lever @ lever) + 1e-18)
    lag_s = parabola_minimum(LAGS_S, -explained)
    return CommandResponse(explained, lag_s, time_constant, gain, motion.t_s[rows], regression.target, predicted)


def wrong_command_sign(channel: str, response: CommandResponse, evidence: Mapping[str, float] | None = None) -> Fault:
    """The fault of a command that the motion follows the other way round."""
    effect = "turns right" if channel == "steering" else "is driven backward"
    observation = f"with positive {channel} the car {effect} (this explains {response.best:.0%} of the motion)"
    return Fault("wrong_sign", channel, observation, evidence or {}, f"--{channel}-sign -1")


def exchanged_commands(
    motion: GridMotion, t_s: FloatArray, commands: Sequence[FloatArray], responses: Sequence[CommandResponse | None]
) -> Fault | None:
    """The fault of exchanged columns: each command explains the motion of the other one, and not its own.

    Args:
        motion: motion on the grid.
        t_s: stamps (N,).
        commands: steering and throttle, (N,) each.
        responses: responses to these commands.
    """
    if not explain_too_little(responses):
        return None
    explained = []
    for channel, command, share in zip(COMMAND_CHANNELS, reversed(commands), LIMITS.command_explained, strict=True):
        response = command_response(motion, t_s, command, channel)
        if response is None or response.best < share:
            return None
        explained.append(response.best)
    observation = (
        f"steering and throttle are exchanged: the throttle explains {explained[0]:.0%} of the turns, and the steering "
        f"{explained[1]:.0%} of the acceleration"
    )
    return Fault("exchanged_columns", "steering, throttle", observation)


def explain_too_little(responses: Sequence[CommandResponse | None]) -> bool:
    """Whether both commands change and neither explains the motion of its own channel."""
    return all(r is not None and r.best < share for r, share in zip(responses, LIMITS.command_explained, strict=True))


def moves_backward(motion: PoseMotion) -> bool:
    """Whether the car moves backward by its yaw in most of the rows in which it moves."""
    moving = np.abs(motion.vx) > MIN_MPS
    return bool(moving.any() and np.mean(motion.vx[moving] < 0.0) > 0.5)


def reversed_yaw(responses: Sequence[CommandResponse | None]) -> Fault | None:
    """The fault of a yaw that points to the rear; ``responses`` to steering and throttle, of a car that moves backward.

    Both commands then act the wrong way round. A car that really drives backward follows both with the right sign.
    """
    for response, min_share in zip(responses, LIMITS.command_explained, strict=True):
        if response is None or response.best < min_share or response.gain > 0:
            return None
    observation = (
        "by its yaw the car mostly moves backward, and both steering and throttle act the wrong way round: yaw points "
        "to the rear"
    )
    return Fault("wrong_frame", "yaw", observation, {"offset_rad": np.pi}, f"--yaw-offset {np.pi:.4f}")


def averaged_as_motion(motion: GridMotion, t_s: FloatArray, values: FloatArray, channel: str) -> FloatArray:
    """Values (N,), held from each of ``t_s`` (N,) on, averaged on the grid (n,) as the motion of a channel is."""
    averaged = held_means(t_s, values, motion.t_s - 0.5 * motion.period_s, motion.period_s)
    for span_s in motion.spans_s[: 1 + COMMAND_CHANNELS.index(channel)]:
        averaged = _slope_average(averaged, round(span_s / motion.period_s))
    return averaged


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
