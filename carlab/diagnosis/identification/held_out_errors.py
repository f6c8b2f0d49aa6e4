"""Held-out errors after a horizon, in units and in noise floors, and gains of effects."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from carlab.core.quantities import STATE_NAMES, FloatArray
from carlab.core.recording_noise import RecordingNoise, StateStd
from carlab.core.robust import STD_OVER_MAD
from carlab.diagnosis.findings import FitErrors
from carlab.diagnosis.identification.block_jackknife import clustered_gain
from carlab.diagnosis.identification.error_scale import huber
from carlab.diagnosis.identification.measurement_noise import Noise
from carlab.diagnosis.settings import IDENTIFICATION
from carlab.prediction.errors import final_errors, prediction_errors
from carlab.prediction.predict import PredictiveModel, SimulatorModel, simulate_windows
from carlab.prediction.windows import PredictionWindows
from sim_backends.car_parameters import SimulatorConfig


@dataclass(frozen=True, slots=True)
class HeldOut:
    """Held-out windows with their noise floor.

    Attributes:
        windows: S held-out prediction windows.
        floor: (6,) error of a perfect simulator after the horizon, estimated from the recording: measurement noise at
            the end, and the propagated error of the initial state; x, y [m], yaw [rad], vx, vy [m/s], yaw rate [rad/s].
        noise: noise of the recordings that were fitted.
    """

    windows: PredictionWindows
    floor: FloatArray
    noise: Noise

    @classmethod
    def of(cls, windows: PredictionWindows, noise: Noise, config: SimulatorConfig) -> HeldOut:
        """Compute the noise floor; the car file's simulator ``config`` propagates the errors of initial states."""
        return cls(windows, noise_floor(windows, noise, config)[-1], noise)

    @property
    def recording_noise(self) -> RecordingNoise:
        """Noise and velocity window, as ``model.toml`` keeps them."""
        noise = self.noise.as_recorded(self.windows.velocity_window_s2)
        floor = cast(StateStd, tuple(self.floor.tolist()))
        return replace(noise, floor_std=floor, floor_horizon_s=self.windows.horizon_s)

    def final_error(self, model: SimulatorConfig | PredictiveModel) -> FloatArray:
        """Errors (S, 6) of a model after the horizon, in SI units, as ``prediction_errors``."""
        return final_errors(SimulatorModel(model) if isinstance(model, SimulatorConfig) else model, self.windows)

    def score(self, error: FloatArray) -> float:
        """Root mean square over windows and channels of errors (S, 6) in floors."""
        return float(np.sqrt(np.mean((error / self.floor) ** 2)))

    def summary(self, error: FloatArray) -> FitErrors:
        """The report's figures of errors (S, 6)."""
        rms = np.sqrt(np.mean(error**2, axis=0))
        return FitErrors(
            position_m=float(np.hypot(rms[0], rms[1])),
            yaw_rad=float(rms[2]),
            vx=float(rms[3]),
            vy=float(rms[4]),
            yaw_rate=float(rms[5]),
            score=self.score(error),
        )

    def floor_summary(self) -> FitErrors:
        """The floor itself; its score is 1."""
        return self.summary(self.floor[None])

    def gain(self, without: FloatArray, with_it: FloatArray) -> tuple[float, float]:
        """Held-out gain in Huber log-likelihood from errors (S, 6) to errors (S, 6), and its clustered error."""
        scale = np.maximum(STD_OVER_MAD * np.median(np.abs(with_it), axis=0), self.floor)
        before, after = (huber(e / scale).sum(axis=1) for e in (without, with_it))
        return clustered_gain(before, after, self.windows)

    @staticmethod
    def fingerprint(without: FloatArray, with_it: FloatArray) -> dict[str, float]:
        """Relative increase of each channel's rms error when an effect is removed; both errors (S, 6)."""
        before, after = (np.sqrt(np.mean(e**2, axis=0)) for e in (without, with_it))
        return {name: float(b / max(a, 1e-12) - 1.0) for name, a, b in zip(STATE_NAMES, after, before, strict=True)}


def noise_floor(windows: PredictionWindows, noise: Noise, config: SimulatorConfig) -> FloatArray:
    """Error (K + 1, 6) that noise alone causes along a window: measurement noise and propagated initial error."""
    reference = simulate_windows(windows, config)
    variance = np.tile(noise.measured**2, (windows.steps + 1, 1))
    for k in range(6):
        initial_states = windows.initial_states.copy()
        initial_states[:, k] += noise.initial_state[k]
        moved = simulate_windows(replace(windows, initial_states=initial_states), config)
        grown = prediction_errors(moved - reference + windows.measured[None], windows)[0]
        squared = grown**2
        largest = np.quantile(squared, IDENTIFICATION.max_error_quantile, axis=0)
        variance += np.mean(np.minimum(squared, largest), axis=0)
    return np.sqrt(variance)


def mean_noise_floor(windows: PredictionWindows, noise: Noise, config: SimulatorConfig) -> FloatArray:
    """Root mean square (6,) of the noise floor over the steps of a window, without the initial state."""
    return np.asarray(np.sqrt(np.mean(noise_floor(windows, noise, config)[1:] ** 2, axis=0)))
