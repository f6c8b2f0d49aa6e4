"""Commands that the log or the radio limits: at the limit, the motion is that of a larger command.

The motion is fitted by the command in rows far from the limit. In rows at the limit the motion exceeds this fit if the
car executes a larger command than the log has. A driver who keeps to the limit causes no excess.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from carlab.core.quantities import FloatArray
from carlab.recording.faults.commands import (
    LAGS_S,
    CommandRegression,
    CommandResponse,
    GridMotion,
    averaged_as_motion,
    command_response,
)
from carlab.recording.faults.fault import Fault
from carlab.recording.faults.robust import first_order_lag
from carlab.recording.faults.settings import LIMITS
from carlab.recording.pose_velocity import BoolArray

BEFORE_S, AFTER_S = 0.1, 0.6
"""[s] Rows this much before and after a limited command are not fitted; delay, servo and tyres respond within 0.6 s."""
AT_LIMIT_SHARE = 0.8
"""Share of the averaged and delayed command that is at the limit in the rows that are compared."""
COVERED_SPEEDS = 0.05
"""Share of the fitted rows on either side whose speeds do not count as covered."""
CLOSE_LIMIT_SHARE, MIN_CLOSE_ROWS = 0.65, 10
"""The limit is covered if at least this number of fitted rows has a command above this share of the limit."""


def limited_command(motion: GridMotion, t_s: FloatArray, command: FloatArray, channel: str) -> Fault | None:
    """The fault of a limited command (N,), held from each of ``t_s`` (N,) on; its rows are those at the limit."""
    is_limited, limits = _rows_at_limits(command)
    if not is_limited.any():
        return None
    limited = averaged_as_motion(motion, t_s, is_limited.astype(np.float64), channel)
    free = replace(motion, rows=motion.rows & ~_is_near(limited > 1e-6, motion.period_s))
    response = command_response(free, t_s, command, channel)
    if response is None or response.best < LIMITS.limited_explained:
        return None
    smooth = averaged_as_motion(motion, t_s, command, channel)
    excess = _excess(motion, free.rows, smooth, limited, response, channel)
    if excess is None or excess[0] < LIMITS.limited_excess or excess[1] < LIMITS.limited_excess_sigmas:
        return None
    what = "turns" if channel == "steering" else "accelerates"
    observation = (
        f"the {channel} is at its limit of {' and '.join(f'{limit:.3g}' for limit in limits)} in "
        f"{is_limited.mean():.0%} of the rows, and there the car {what} {excess[0]:.0%} more than by this command: the "
        "log or the radio limits the command"
    )
    evidence = {"excess": excess[0], "excess_sigmas": excess[1], "share": float(is_limited.mean())}
    return Fault("limited_commands", channel, observation, evidence, rows=np.flatnonzero(is_limited))


def _rows_at_limits(command: FloatArray) -> tuple[BoolArray, list[float]]:
    """Rows (N,) at a limit below full command, and the limits; many rows have exactly this largest command."""
    found, limits = np.zeros(len(command), dtype=bool), []
    for limit in (float(command.max()), float(command.min())):
        is_at = np.abs(command - limit) < LIMITS.limit_tolerance
        if LIMITS.min_limit < abs(limit) < LIMITS.max_limit and is_at.mean() >= LIMITS.limited_share:
            found |= is_at
            limits.append(limit)
    return found, limits


def _is_near(rows: BoolArray, period_s: float) -> BoolArray:
    """Rows (n,) of the grid that are within ``BEFORE_S`` before or ``AFTER_S`` after one of ``rows`` (n,)."""
    before, after = round(BEFORE_S / period_s), round(AFTER_S / period_s)
    window = np.zeros(2 * max(before, after) + 1)
    window[max(before, after) - before : max(before, after) + after + 1] = 1.0
    return np.asarray(np.convolve(rows, window, mode="full")[max(before, after) :][: len(rows)] > 0.5)


def _excess(
    motion: GridMotion,
    free: BoolArray,
    smooth: FloatArray,
    limited: FloatArray,
    response: CommandResponse,
    channel: str,
) -> tuple[float, float] | None:
    """Excess of the motion at the limit over the fit of the rows ``free`` (n,); None with too few rows.

    Returns:
        The excess as a share of what the command causes, and as a multiple of the standard deviation of the fit.
    """
    lag = int(np.argmin(np.abs(LAGS_S - response.lag_s)))
    rows = np.flatnonzero(motion.rows)
    regression, is_free = CommandRegression.of(motion, channel, rows), free[rows]
    delayed, at_limit = (
        regression.delayed(first_order_lag(values, motion.period_s, response.time_constant_s), lag)
        for values in (smooth, limited)
    )
    is_compared = (at_limit > AT_LIMIT_SHARE) & _is_covered(delayed, motion.vx[rows], is_free)
    if is_compared.sum() < LIMITS.min_limited_rows:
        return None
    terms = regression.terms(delayed).T
    design = np.column_stack([regression.base, terms])
    values = motion.yaw_rate[rows] if channel == "steering" else motion.acceleration[rows]
    coefficients = np.linalg.lstsq(design[is_free], values[is_free], rcond=None)[0]
    residual = values - design @ coefficients
    caused = terms @ coefficients[-terms.shape[1] :]
    excess = np.sign(caused[is_compared]) * residual[is_compared]
    share = float(excess.sum() / (np.abs(caused[is_compared]).sum() + 1e-18))
    return share, float(excess.mean() / (residual[is_free].std() + 1e-18))


def _is_covered(command: FloatArray, vx: FloatArray, is_free: BoolArray) -> BoolArray:
    """Rows (n,) whose command and speed the rows ``is_free`` (n,) cover, so that their fit is valid there.

    Commands of a log that is limited go up to the limit. A driver with a few fixed commands has a gap below it.
    """
    slowest, fastest = np.quantile(vx[is_free], [COVERED_SPEEDS, 1.0 - COVERED_SPEEDS])
    found = (vx >= slowest) & (vx <= fastest)
    for side in (1.0, -1.0):
        size = side * command
        is_close = is_free & (size > CLOSE_LIMIT_SHARE * size.max())
        if is_close.sum() < MIN_CLOSE_ROWS:
            found &= size <= 0.0
    return np.asarray(found)
