"""Loss of prediction windows whose initial states are free.

The estimated initial state of a window has an error that grows along the window. It hides small differences between
models, and where the acceleration changes suddenly it is a bias that one model may fit better than the true one. Here
each model chooses the initial state of each window that suits it best (a profile likelihood, Murphy and van der Vaart
2000; the initial states of multiple shooting, Bock and Plitt 1984). Only measurement noise is left: it whitens the
errors of all steps. The errors are linear in the initial state, with derivatives by differences.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from carlab.core.quantities import FloatArray
from carlab.diagnosis.identification.error_scale import MAX_WHITE, huber, huber_weight
from carlab.diagnosis.identification.fit_parameters import FitParameter
from carlab.prediction.errors import bounded, prediction_errors
from carlab.prediction.predict import simulate_windows
from carlab.prediction.windows import PredictionWindows
from sim_backends.car_parameters import SimulatorConfig

_REWEIGHTINGS = 6
"""Iterations of reweighted least squares; the loss of windows of the proof changes by less than 1e-3 after four."""


def loss_of_free_initial_states(
    windows: PredictionWindows,
    config: SimulatorConfig,
    free: Sequence[FitParameter],
    z: FloatArray,
    measured_std: FloatArray,
    *,
    max_error: float,
) -> FloatArray:
    """Huber loss (S,) of each window at the initial state that minimises it.

    Args:
        windows: S windows of K steps.
        config: the simulator.
        free: n parameters.
        z: their coordinates for each window (S, n).
        measured_std: standard deviations (6,) of the measured channels.
        max_error: bound of the whitened errors in the loss.
    """
    white, jacobian = linearised_by_initial_states(windows, config, free, z, measured_std)
    _, error, _ = initial_state_correction(white, jacobian)
    return np.asarray(huber(error.clip(-max_error, max_error)).sum(axis=1))


def initial_state_correction(white: FloatArray, jacobian: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Initial states that minimise the Huber loss of each window, by reweighted least squares.

    Args:
        white: whitened errors (S, E).
        jacobian: their derivatives (S, E, 6) by the initial states.

    Returns:
        Change of the initial states (S, 6), the errors (S, E) with it, and the weights (S, E) of these errors.
    """
    shift = np.zeros((len(white), 6))
    for _ in range(_REWEIGHTINGS):
        weight = huber_weight(white + np.einsum("sek,sk->se", jacobian, shift))
        weighted = jacobian * weight[..., None]
        normal = np.swapaxes(weighted, 1, 2) @ jacobian + 1e-9 * np.eye(6)
        shift = -np.linalg.solve(normal, np.einsum("sek,se->sk", weighted, white)[..., None])[..., 0]
    error = white + np.einsum("sek,sk->se", jacobian, shift)
    return shift, error, huber_weight(error)


def linearised_by_initial_states(
    windows: PredictionWindows,
    config: SimulatorConfig,
    free: Sequence[FitParameter],
    z: FloatArray,
    measured_std: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Whitened errors (S, 6 K) and their derivatives by the initial state (S, 6 K, 6), in noise of the channels."""
    count = len(windows)
    moved = windows.initial_states[None] + np.concatenate([np.zeros((1, 6)), np.diag(measured_std)])[:, None]
    stacked = windows.take(np.tile(np.arange(count), 7))
    values = {f.name: np.tile(np.asarray(f.value(z[:, k])), 7)[None] for k, f in enumerate(free)}
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # a diverged simulation is clipped below
        predicted = simulate_windows(
            replace(stacked, initial_states=moved.reshape(-1, 6)), config, values, in_double=True
        )
        error = prediction_errors(predicted.reshape(7, count, -1, 6), windows)[:, :, 1:]
        white = bounded(error / measured_std, MAX_WHITE).reshape(7, count, -1)
    return white[0], np.moveaxis(white[1:] - white[0], 0, -1)
