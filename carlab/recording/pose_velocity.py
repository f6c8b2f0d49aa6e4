"""Velocities from poses with irregular stamps by a centred local quadratic fit, separately between breaks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from carlab.core.angles import wrap
from carlab.core.planar import to_body
from carlab.core.quantities import FloatArray

BoolArray = NDArray[np.bool_]
IndexArray = NDArray[np.intp]

HALF_WINDOW_S = 0.05
"""Half the span of the fit [s]: eleven samples at 100 Hz, the minimum of five at 30 Hz."""
MIN_HALF_ROWS = 2
STATE_HALF_WINDOW_S = 0.035
"""Maximum half span for velocities of states: seven rows at 100 Hz, five at 60 Hz, three at 20 to 57 Hz. A longer
window has less noise, but filters the motion of a car more than the measurement model predicts
(``sim_backends.measurement``)."""
_BLOCK_SAMPLES = 500_000
"""Samples of windows that are in memory at once."""
_MIN_PARABOLA_SQUARE = 1e-28
"""A smaller value is rounding: but for it, the times are only two, which determine a line."""

# A break is a step beyond the motion of the neighbouring rows plus accelerations of 100 m/s^2 (twice those of a hard
# collision) and 500 rad/s^2, plus 5 cm and 0.3 rad for jitter of the stamps.
_JUMP_M, _JUMP_ACCELERATION = 0.05, 100.0
_JUMP_RAD, _JUMP_ANGULAR = 0.3, 500.0


@dataclass(frozen=True, slots=True)
class PoseMotion:
    """Motion of the pose itself; arrays are (N,).

    Attributes:
        yaw_unwrapped: yaw without jumps of 2 pi [rad].
        vx_world, vy_world: velocities in the world frame [m/s].
        vx, vy: velocities in the body frame [m/s].
        yaw_rate: derivative of the yaw [rad/s].
        half_rows: rows on either side of a row in the local quadratic.
    """

    yaw_unwrapped: FloatArray
    vx_world: FloatArray
    vy_world: FloatArray
    vx: FloatArray
    vy: FloatArray
    yaw_rate: FloatArray
    half_rows: int

    def method(self) -> str:
        """Description of the method for the metadata."""
        return (
            f"local quadratic through {2 * self.half_rows + 1} unwrapped poses about each row, centred: no delay "
            "(one-sided at the ends and at breaks)"
        )


def pose_jumps(t_s: FloatArray, x_m: FloatArray, y_m: FloatArray, yaw_rad: FloatArray) -> IndexArray:
    """Row indices k, shape (J,), at which the step from row k - 1 to k exceeds a car's motion; arguments (N,)."""
    dt = np.diff(t_s)
    safe = np.where(dt > 0, dt, np.nan)
    steps = np.stack([np.diff(x_m), np.diff(y_m), wrap(np.diff(yaw_rad))])
    around = _median_of_neighbours(steps / safe)
    miss = np.abs(steps - around * dt)
    far = np.hypot(miss[0], miss[1]) > _JUMP_M + 0.5 * _JUMP_ACCELERATION * dt**2
    turned = miss[2] > _JUMP_RAD + 0.5 * _JUMP_ANGULAR * dt**2
    return np.flatnonzero(far | turned) + 1


def pose_motion(
    t_s: FloatArray,
    x_m: FloatArray,
    y_m: FloatArray,
    yaw_rad: FloatArray,
    segment: FloatArray,
    *,
    for_states: bool = False,
) -> PoseMotion:
    """Differentiate a pose.

    Args:
        t_s: stamps (N,).
        x_m: position (N,).
        y_m: position (N,).
        yaw_rad: yaw (N,).
        segment: numbers (N,); rows of different numbers are fitted separately.
        for_states: use the shorter window of states; by default the longer one with less noise, for checks of columns.
    """
    dt = np.diff(t_s)
    period = float(np.median(dt[dt > 0])) if np.any(dt > 0) else 1.0
    half = max(MIN_HALF_ROWS, round(HALF_WINDOW_S / period))
    if for_states:
        half = max(1, int(STATE_HALF_WINDOW_S / period))
    yaw = yaw_rad.copy()
    rates = np.zeros((3, len(t_s)))
    for number in np.unique(segment):
        rows = segment == number
        yaw[rows] = np.unwrap(yaw_rad[rows])
        rates[:, rows] = _local_slopes(t_s[rows], np.stack([x_m[rows], y_m[rows], yaw[rows]]), half)
    vx_world, vy_world, yaw_rate = rates
    return PoseMotion(yaw, vx_world, vy_world, *to_body(vx_world, vy_world, yaw), yaw_rate, half)


def _local_slopes(t_s: FloatArray, values: FloatArray, half: int) -> FloatArray:
    """Slopes (C, n) at each stamp of the local quadratic through up to 2 half + 1 rows of ``values`` (C, n)."""
    n = len(t_s)
    width = min(2 * half + 1, n)
    if n < 2:
        return np.zeros_like(values)
    if width < 3:
        return np.repeat(np.diff(values, axis=1) / np.diff(t_s), 2, axis=1)
    start = np.clip(np.arange(n) - half, 0, n - width)
    all_times, all_values = sliding_window_view(t_s, width), sliding_window_view(values, width, axis=1)
    slopes = np.empty_like(values)
    block_rows = max(1, _BLOCK_SAMPLES // width)
    for first in range(0, n, block_rows):
        rows = slice(first, first + block_rows)
        times = all_times[start[rows]] - t_s[rows, None]
        offsets = all_values[:, start[rows]] - values[:, rows, None]
        slopes[:, rows] = np.einsum("nw,cnw->cn", _slope_weights(times), offsets)
    return slopes


def _slope_weights(times: FloatArray) -> FloatArray:
    """Weights (n, w) of the values at ``times`` (n, w) in the slope at 0 of the quadratic that fits them best.

    The quadratic is a sum of a constant, a line and a parabola that are orthogonal on the times of a row.
    """
    scale = np.abs(times).max(axis=1, keepdims=True)
    u = times / scale
    line = u - u.mean(axis=1, keepdims=True)
    line_square = np.sum(line * line, axis=1, keepdims=True)
    tilt = np.sum(u * u * line, axis=1, keepdims=True) / line_square
    parabola = u * u - np.mean(u * u, axis=1, keepdims=True) - tilt * line
    parabola_square = np.sum(parabola * parabola, axis=1, keepdims=True)
    has_parabola = parabola_square > _MIN_PARABOLA_SQUARE
    bend = np.divide(tilt * parabola, parabola_square, out=np.zeros_like(u), where=has_parabola)
    weights: FloatArray = (line / line_square - bend) / scale
    return weights


def _median_of_neighbours(rates: FloatArray) -> FloatArray:
    """Median of each row's four neighbours on either side, without the row. ``rates`` (C, n)."""
    reach = 4
    if rates.shape[1] < 2 * reach + 1:
        return np.repeat(np.nan_to_num(np.nanmedian(rates, axis=1, keepdims=True)), rates.shape[1], axis=1)
    padded = np.pad(np.nan_to_num(rates), ((0, 0), (reach, reach)), mode="reflect")
    windows = sliding_window_view(padded, 2 * reach + 1, axis=1)
    return np.median(np.delete(windows, reach, axis=2), axis=2)
