"""The largest cross-correlation between errors and commands, both prewhitened (Box and Jenkins, 1970).

Errors that correlate with past commands indicate that a command acts later (or earlier) than in the model. The
differentiation of the pose spreads a command step over neighbouring rows with a sum of zero. Single lags therefore
correlate on null cases too, and the statistic is the sum of correlations over the affected lags. A lag has the same sum
as a delay; the delay is named for both.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import solve_toeplitz
from scipy.signal import lfilter

from carlab.benchmark.baselines.data import SLOW_MPS, Prepared, Steps
from carlab.benchmark.world.simulation import FloatArray

AR_ORDER = 8
STEP_S = 0.1
# Range of lags before and after zero, and number of summed lags, all in rows of 1/30 s.
ROWS_BEFORE, ROWS_AFTER, SUMMED_LAGS = 7, 10, 12
# Threshold in standard errors of a sum of correlations, without false alarms on the development set.
MIN_Z = 1.8
CLIP_MEDIANS = 6.0


def largest_correlation(data: Prepared) -> str | None:
    """The delay with the largest cross-correlation, or None if all are small."""
    steering, throttle = _strongest(data, 0, (1, 2)), _strongest(data, 1, (0,))
    if max(steering, throttle) < MIN_Z:
        return None
    if min(steering, throttle) >= MIN_Z:
        return "command_delay"
    return "steering_delay" if steering > throttle else "throttle_delay"


def _strongest(data: Prepared, command: int, channels: tuple[int, ...]) -> float:
    """The largest summed correlation of a command with the errors of some channels, in standard errors."""
    fit, car = data.fit, data.car
    count = max(1, round(STEP_S / car.control_period))
    rows = np.arange(AR_ORDER + ROWS_AFTER, len(fit.t_s) - count - ROWS_BEFORE, dtype=np.int64)
    steps = Steps(car, fit.measured[rows], rows, fit.t_s[rows], data.steps.fine, data.steps.parts, count)
    errors = fit.measured[rows + count, 3:] - steps.ends[:, 3:]
    whitener = _whitener(fit.commands[:, command])
    whitened_commands = lfilter(whitener, [1.0], fit.commands[:, command] - fit.commands[:, command].mean())
    fast = (fit.measured[rows, 3] > 2.0 * SLOW_MPS)[AR_ORDER:]
    weight = fit.measured[rows, 3] if command == 0 else 1.0  # the influence of steering grows with speed
    best = 0.0
    for channel in channels:
        whitened_errors = lfilter(whitener, [1.0], errors[:, channel] * weight)[AR_ORDER:]
        clip_at = CLIP_MEDIANS * float(np.median(np.abs(whitened_errors)))
        whitened_errors = np.clip(whitened_errors, -clip_at, clip_at) * fast
        correlations = [
            _correlation(whitened_commands[rows[AR_ORDER:] - lag], whitened_errors)
            for lag in range(-ROWS_BEFORE, ROWS_AFTER)
        ]
        sums = np.convolve(correlations, np.ones(SUMMED_LAGS), "valid") * np.sqrt(len(whitened_errors) / SUMMED_LAGS)
        best = max(best, float(np.abs(sums).max()))
    return best


def _whitener(series: FloatArray) -> FloatArray:
    """Coefficients of the prediction error of an autoregression (Yule and Walker)."""
    centred = series - series.mean()
    moments = np.array([centred[: len(centred) - k] @ centred[k:] for k in range(AR_ORDER + 1)]) / len(centred)
    moments[0] = 1.001 * moments[0] + 1e-12
    return np.concatenate([[1.0], -solve_toeplitz(moments[:-1], moments[1:])])


def _correlation(a: FloatArray, b: FloatArray) -> float:
    return float(np.mean((a - a.mean()) * (b - b.mean())) / max(float(a.std() * b.std()), 1e-12))
