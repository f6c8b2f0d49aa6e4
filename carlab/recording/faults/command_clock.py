"""Commands stamped by another clock than the poses: their delay grows or shrinks evenly with time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from carlab.core.quantities import FloatArray
from carlab.core.robust import STD_OVER_MAD
from carlab.recording.faults.commands import LAGS_S, CommandResponse
from carlab.recording.faults.robust import parabola_minimum
from carlab.recording.faults.settings import LIMITS

WINDOW_S = 6.0
MIN_WINDOW_ROWS = 60
WINDOW_STD_S = 0.01
"""[s] Lower bound of a window's standard deviation, however well few windows lie on a line."""


@dataclass(frozen=True, slots=True)
class WindowLags:
    """Delays in windows: at t_s (w,) [s] and lag_s (w,) [s], both centred, by command channel (w,) 0 or 1."""

    t_s: FloatArray
    lag_s: FloatArray
    channel: FloatArray

    @classmethod
    def joined(cls, parts: Sequence[WindowLags]) -> WindowLags:
        """All windows of several recordings or channels."""
        return cls(*(np.concatenate([np.zeros(0), *(getattr(p, n) for p in parts)]) for n in cls.__slots__))


def window_lags(responses: Sequence[CommandResponse | None]) -> WindowLags:
    """Delays of steering and throttle in windows of a recording; ``responses`` are those of steering and throttle."""
    parts = []
    for channel, response in enumerate(responses):
        if response is None or response.best < LIMITS.command_explained[channel]:
            continue
        number = ((response.t_s - response.t_s[0]) / WINDOW_S).astype(np.int64)
        times, lags = [], []
        for k in np.unique(number):
            rows = number == k
            if rows.sum() < MIN_WINDOW_ROWS:
                continue
            target = response.target[rows] - response.target[rows].mean()
            predicted = response.predicted[:, rows]
            predicted = predicted - predicted.mean(axis=1, keepdims=True)
            product = np.maximum(predicted @ target, 0.0)
            power = np.einsum("lr,lr->l", predicted, predicted)
            explained = product**2 / np.maximum(power, 1e-12) / max(float(target @ target), 1e-12)
            if explained.max() >= 0.4 and 0 < np.argmax(explained) < len(explained) - 1:
                times.append(float(response.t_s[rows].mean()))
                lags.append(parabola_minimum(LAGS_S, -explained))
        if len(lags) >= 4:
            lag, when = np.array(lags), np.array(times)
            parts.append(WindowLags(when - when.mean(), lag - np.median(lag), np.full(len(lag), float(channel))))
    return WindowLags.joined(parts)


def clock_rate(lags: WindowLags) -> tuple[float, float] | None:
    """Growth of the delay [s/s] common to both channels, and its standard error. None where channels contradict."""
    slopes = [s for s in (_slope(lags, lags.channel == c) for c in (0.0, 1.0)) if s is not None]
    if not slopes:
        return None
    rates, errors = np.array(slopes).T
    weights = errors**-2.0
    if len(slopes) == 2 and abs(rates[0] - rates[1]) > 3.0 * math.hypot(*errors):
        return None
    return float(weights @ rates / weights.sum()), float(1.0 / math.sqrt(weights.sum()))


def _slope(lags: WindowLags, rows: np.ndarray) -> tuple[float, float] | None:
    """Slope of the delay over time and its standard error, by a line without outliers. None for under five windows."""
    t, lag = lags.t_s[rows], lags.lag_s[rows]
    keep = np.ones(len(t), dtype=bool)
    for _ in range(4):
        if keep.sum() < 5:
            return None
        slope, offset = np.polyfit(t[keep], lag[keep], 1)
        error = np.abs(lag - offset - slope * t)
        limit = max(3.0 * STD_OVER_MAD * float(np.median(error)), 0.004)
        if np.array_equal(keep, error <= limit):
            break
        keep = error <= limit
    if keep.sum() < 5:
        return None
    variance = max(float(np.sum(error[keep] ** 2)) / (keep.sum() - 2), WINDOW_STD_S**2)
    return float(slope), math.sqrt(variance / float(np.sum((t[keep] - t[keep].mean()) ** 2)))
