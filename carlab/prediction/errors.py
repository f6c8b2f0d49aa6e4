"""Prediction errors by channel and horizon."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from carlab.core.planar import to_body
from carlab.core.quantities import STATE_NAMES, STATE_UNITS, FloatArray
from carlab.prediction.predict import PredictiveModel, simulate_windows
from carlab.prediction.windows import IndexArray, PredictionWindows
from sim_backends.car_parameters import SimulatorConfig

MAX_ERROR = 1e3
"""Bound of a final error in SI units; it also replaces non-finite errors of a diverged simulator."""


@dataclass(frozen=True, slots=True)
class ChannelError:
    """Errors of one channel after the horizon over all windows, in ``unit``.

    Root mean square, median and 90th percentile of the absolute error, and mean (predicted minus measured).
    """

    channel: str
    unit: str
    rms: float
    median: float
    p90: float
    bias: float


def prediction_errors(predicted: FloatArray, windows: PredictionWindows, ticks: IndexArray | None = None) -> FloatArray:
    """Predicted minus measured (..., S, K + 1, 6).

    Args:
        predicted: measurements (..., S, K + 1, 6), or (..., S, U, 6) at ``ticks``.
        windows: the predicted windows.
        ticks: indices (U,) of the predicted ticks; all K + 1 by default.

    Returns:
        x and y [m] in the body frame of each window's initial state (ahead, left), the other channels unchanged.
    """
    error = predicted - (windows.measured if ticks is None else windows.measured[:, ticks])
    yaw = windows.initial_states[:, 2, None]
    error[..., 0], error[..., 1] = to_body(error[..., 0], error[..., 1], yaw)
    return error


def simulation_errors(
    windows: PredictionWindows, config: SimulatorConfig, values: Mapping[str, FloatArray] | None = None
) -> FloatArray:
    """Errors (S, K + 1, 6) of a simulator as ``prediction_errors``, with other ``values`` (1,) by dotted name."""
    return prediction_errors(simulate_windows(windows, config, values)[0], windows)


def final_errors(model: PredictiveModel, windows: PredictionWindows) -> FloatArray:
    """Errors (S, 6) of a model after the horizon, as ``prediction_errors``, finite and within ``MAX_ERROR``."""
    return bounded(prediction_errors(model.predict(windows), windows)[:, -1], MAX_ERROR)


def bounded(errors: FloatArray, limit: float) -> FloatArray:
    """Errors (...) within ``limit``; NaN, as a diverged simulation gives it, becomes ``limit``."""
    return np.fmax(np.fmin(errors, limit), -limit)  # of NaN and a number, these return the number


def channel_errors(errors: FloatArray) -> tuple[ChannelError, ...]:
    """Statistics by channel of errors (S, 6) of ``STATE_NAMES``, in ``STATE_UNITS``."""
    size = np.abs(errors)
    return tuple(
        ChannelError(
            name,
            unit,
            float(np.sqrt(np.mean(errors[:, k] ** 2))),
            float(np.median(size[:, k])),
            float(np.percentile(size[:, k], 90)),
            float(np.mean(errors[:, k])),
        )
        for k, (name, unit) in enumerate(zip(STATE_NAMES, STATE_UNITS, strict=True))
    )
