"""Local model of a simulator's errors: the expected error of a prediction from errors of the past in similar states.

A Gaussian process over the state of the car (body velocities and commands) with a squared exponential kernel predicts
the error along a window. Each prediction uses the nearest windows of the past only (local Gaussian process regression:
Nguyen-Tuong, Seeger and Peters 2009, Model learning with local Gaussian process regression). Far from all past states
the expected error is 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from carlab.core.errors import DataError
from carlab.core.quantities import FloatArray
from carlab.prediction.adaptation_settings import ADAPTATION
from carlab.prediction.errors import bounded, simulation_errors
from carlab.prediction.initial_states import with_rotated_positions
from carlab.prediction.windows import PredictionWindows, RecordingSegment, cut_windows
from sim_backends.car_parameters import SimulatorConfig

BATCH = 128
"""Windows whose Gaussian processes are solved at once; bounds the memory."""


@dataclass(frozen=True, slots=True)
class LocalErrorModel:
    """Simulator corrected by its errors in similar states of the past.

    Attributes:
        config: the simulator.
        segments: segments of the recordings that are predicted; only windows before a prediction are used.
        fitted: segments of earlier recordings, all of whose windows are used.
        state_std: (7,) standard deviations of ``state_features``, by which these are divided.
        guard_s: minimum time [s] between the end of a used window and the start of a prediction.
        velocity_window_s2: variance [s2] of the window over which the recorded velocities were differentiated.
    """

    config: SimulatorConfig
    segments: Sequence[RecordingSegment]
    fitted: Sequence[RecordingSegment]
    state_std: FloatArray
    guard_s: float
    velocity_window_s2: float

    def corrected(self, windows: PredictionWindows, predicted: FloatArray) -> FloatArray:
        """Predictions (S, K + 1, 6) of the simulator less their expected errors.

        Args:
            windows: S windows.
            predicted: predictions (S, K + 1, 6) of ``config``.
        """
        past = self._windows(self.segments, windows.horizon_s)
        earlier = self._windows(self.fitted, windows.horizon_s)
        if past is None and earlier is None:
            return predicted
        errors = np.concatenate([self._errors(w) for w in (past, earlier) if w is not None])
        past_states = np.concatenate([state_features(w) for w in (past, earlier) if w is not None]) / self.state_std
        states = state_features(windows) / self.state_std
        expected = np.zeros_like(predicted)
        for first in range(0, len(windows), BATCH):
            rows = slice(first, first + BATCH)
            known = np.ones((len(states[rows]), len(past_states)), dtype=bool)
            if past is not None:
                known[:, : len(past)] = self._is_known(windows, past, rows)
            weights = _weights(states[rows], past_states, known)
            expected[rows] = np.tensordot(weights, errors, axes=1)
        return predicted - with_rotated_positions(expected, windows.initial_states[:, 2, None])

    def _windows(self, segments: Sequence[RecordingSegment], horizon_s: float) -> PredictionWindows | None:
        """Windows of the segments; None if the car moves in none."""
        try:
            windows = cut_windows(segments, horizon_s, ADAPTATION.weight_stride_s)
        except DataError:
            return None
        return replace(windows, velocity_window_s2=self.velocity_window_s2)

    def _errors(self, windows: PredictionWindows) -> FloatArray:
        """Errors (S, K + 1, 6) of the simulator, finite and bounded."""
        return bounded(simulation_errors(windows, self.config), ADAPTATION.max_error)

    def _is_known(self, windows: PredictionWindows, past: PredictionWindows, rows: slice) -> NDArray[np.bool_]:
        """Which windows of the past (s, N) end before windows of a batch start."""
        same = windows.recording[rows, None] == past.recording
        end_s = past.t0_s + past.horizon_s + self.guard_s
        return np.asarray(same & (end_s <= windows.t0_s[rows, None] + 1e-6))


def state_features(windows: PredictionWindows) -> FloatArray:
    """Features (S, 7) of the state of the car: vx, vy [m/s], yaw rate [rad/s], and commands.

    The commands are steering and throttle in the last step before the window, and their means in the window.
    """
    return np.concatenate(
        [windows.initial_states[:, 3:], windows.past_commands[:, -1], windows.commands.mean(axis=1)], axis=1
    )


def _weights(states: FloatArray, past_states: FloatArray, known: NDArray[np.bool_]) -> FloatArray:
    """Weights (s, N) of past errors in the posterior mean at ``states`` (s, 7); 0 where they are not ``known``."""
    distance_sq = np.where(known, cdist(states, past_states, "sqeuclidean"), np.inf)
    count = min(ADAPTATION.local_neighbours, len(past_states))
    nearest = np.argpartition(distance_sq, count - 1, axis=1)[:, :count]
    kernel = np.exp(-0.5 * np.take_along_axis(distance_sq, nearest, axis=1) / ADAPTATION.local_length**2)
    chosen = past_states[nearest]
    between = np.sum((chosen[:, :, None] - chosen[:, None]) ** 2, axis=-1)
    covariance = np.exp(-0.5 * between / ADAPTATION.local_length**2) + ADAPTATION.local_noise * np.eye(count)
    weights = np.zeros(distance_sq.shape)
    used = np.isfinite(np.take_along_axis(distance_sq, nearest, axis=1))
    covariance = np.where(used[:, :, None] & used[:, None], covariance, (1.0 + ADAPTATION.local_noise) * np.eye(count))
    np.put_along_axis(weights, nearest, np.linalg.solve(covariance, kernel[..., None])[..., 0], axis=1)
    return weights
