"""Commands and states before a prediction window.

Play in the steering remembers the last reversal of the command. If the steering was held during the rows before a
window, the first of these rows has the value of the last turning point instead: its influence on lags decays until the
window, but the play has the side that it has in the car.
"""

from __future__ import annotations

import numpy as np

from carlab.core.quantities import FloatArray

MIN_REVERSAL = 0.02
"""Smallest change of the steering that counts as a motion (full command = 1); noise of a gamepad is smaller."""


def rows_before(values: FloatArray, row: int, count: int) -> FloatArray:
    """The ``count`` rows before ``row``, with the first one where there are too few."""
    return values[np.maximum(np.arange(row - count, row), 0)]


def past_commands(commands: FloatArray, row: int, count: int) -> FloatArray:
    """The ``count`` commands (H, 2) before ``row`` of steering and throttle (n, 2), with the last turning point."""
    past = rows_before(commands, row, count)
    if np.ptp(past[:, 0]) > MIN_REVERSAL:
        return past
    turning_point = last_turning_point(commands[:row, 0])
    if turning_point is not None:
        past[0, 0] = turning_point
    return past


def last_turning_point(command: FloatArray) -> float | None:
    """Value at which a command (n,) began its last motion to its last value; None if it never moved.

    A motion in one direction may have pauses, and steps back that are smaller than ``MIN_REVERSAL``.
    """
    offset = command[::-1] - command[-1]
    moved = np.flatnonzero(np.abs(offset) > MIN_REVERSAL)
    if not len(moved):
        return None
    distance = np.sign(offset[moved[0]]) * offset[moved[0] :]
    farthest = np.maximum.accumulate(distance)
    reversed_rows = np.flatnonzero(farthest - distance > MIN_REVERSAL)
    last = reversed_rows[0] if len(reversed_rows) else len(distance) - 1
    return float(command[-1] + np.sign(offset[moved[0]]) * farthest[last])
