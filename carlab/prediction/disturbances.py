"""Predictions of a simulator with disturbances, and their Jacobian."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from carlab.core.quantities import FloatArray
from carlab.prediction.adaptation_filter import MeasuredWindows
from carlab.prediction.adaptation_settings import ADAPTATION
from carlab.prediction.errors import bounded, prediction_errors
from carlab.prediction.predict import simulate_windows
from carlab.prediction.windows import PredictionWindows
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.effects import BODY_FORCE_PARAMETERS, DRIFTING_PARAMETERS

DISTURBANCE_NAMES = (*DRIFTING_PARAMETERS, *BODY_FORCE_PARAMETERS)
"""Dotted names of the m disturbances; the first n of them drift."""


@dataclass(frozen=True, slots=True)
class DisturbedModel:
    """A simulator with constant disturbances (n,) as a predictive model, with the units of ``simulate_disturbed``."""

    config: SimulatorConfig
    disturbances: FloatArray

    def predict(self, windows: PredictionWindows) -> FloatArray:
        """As ``PredictiveModel``: (S, K + 1, 6)."""
        constant = np.broadcast_to(self.disturbances, (1, len(windows), len(self.disturbances)))
        return np.asarray(simulate_disturbed(windows, self.config, constant)[0])


def linearised(windows: PredictionWindows, config: SimulatorConfig, at: FloatArray) -> MeasuredWindows:
    """Errors after S windows with disturbances ``at`` (C, S, n), and their Jacobian by all m disturbances.

    The disturbances have the units of ``simulate_disturbed``.
    """
    candidates, count, size = at.shape
    total = len(DISTURBANCE_NAMES)
    full = np.zeros((candidates, count, total))
    full[..., :size] = np.clip(at, -np.array(ADAPTATION.limits[:size]), ADAPTATION.limits[:size])
    steps = np.array(ADAPTATION.steps)
    moved = full[:, None] + np.concatenate([np.zeros((1, total)), np.diag(steps)])[None, :, None, :]
    predicted = simulate_disturbed(windows, config, moved.reshape(-1, count, total))
    error = bounded_final_errors(windows, predicted).reshape(candidates, total + 1, count, 6)
    jacobian = (error[:, 1:] - error[:, :1]) / steps[None, :, None, None]
    end_s = windows.t0_s + windows.horizon_s
    return MeasuredWindows(windows.recording, end_s, error[:, 0], np.moveaxis(jacobian, 1, -1), full)


def simulate_disturbed(windows: PredictionWindows, config: SimulatorConfig, disturbances: FloatArray) -> FloatArray:
    """Predict S windows with C sets of disturbances (C, S, n or m) [1, rad, 1, m/s2, m/s2, rad/s2].

    Returns:
        (C, S, K + 1, 6) as ``simulate_windows``.
    """
    parameters, size = config.parameters, disturbances.shape[-1]
    mass_kg, inertia_kgm2 = parameters.mass_kg, parameters.yaw_inertia_kgm2
    unit = np.array([1.0, 1.0, 1.0, mass_kg, mass_kg, inertia_kgm2])[:size]
    limits = np.array(ADAPTATION.limits[:size])
    given = np.clip(disturbances, -limits, limits) * unit
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # a diverged simulation has bounded errors
        return simulate_windows(
            windows, config, {name: given[..., k] for k, name in enumerate(DISTURBANCE_NAMES[:size])}
        )


def bounded_final_errors(windows: PredictionWindows, predicted: FloatArray) -> FloatArray:
    """Errors (..., S, 6) of predictions (..., S, K + 1, 6) after the windows, finite and bounded.

    Errors are x, y in the body frame [m], yaw [rad], vx, vy [m/s], yaw rate [rad/s].
    """
    last = replace(windows, measured=windows.measured[:, -1:])
    return bounded(prediction_errors(predicted[..., -1:, :], last)[..., 0, :], ADAPTATION.max_error)
