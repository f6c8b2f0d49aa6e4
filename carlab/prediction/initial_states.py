"""Initial states of prediction windows: smoothed without the curvature bias of the local cubic, or as recorded.

At command steps the motion has higher derivatives than a cubic, so later motion biases the initial state. An
approximate simulator predicts this bias: a cubic through simulated poses minus the simulated state. The bias is
subtracted in proportion to its evidence in the recording: the difference of a quintic and a cubic through the measured
poses is regressed on the simulated difference.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.signal import savgol_coeffs

from carlab.core.planar import to_world
from carlab.core.quantities import FloatArray
from carlab.prediction.predict import simulate_windows
from carlab.prediction.windows import MIN_QUINTIC_WIDTH, PredictionWindows, body_states, smoothing_width
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.measurement import filters_velocities

_GROUPS = ((0, 1), (2,), (3,), (4,), (5,))


def as_recorded(windows: PredictionWindows) -> PredictionWindows:
    """The same windows with the recorded states as initial states."""
    zeros = np.zeros_like(windows.curvature_bias)
    return replace(windows, initial_states=windows.measured[:, 0], curvature_bias=zeros, velocities_from_poses=False)


def without_curvature_bias(windows: PredictionWindows, config: SimulatorConfig) -> PredictionWindows:
    """The same windows with the curvature bias of the initial states subtracted.

    Args:
        windows: windows of ``cut_windows``.
        config: an approximate simulator.

    Returns:
        Windows with the remaining ``curvature_bias``; the same windows if they are too short.
    """
    width = smoothing_width(windows.period_s)
    half = max(width, MIN_QUINTIC_WIDTH) // 2
    if windows.steps < half or windows.past_commands.shape[1] <= half:
        return windows
    config = replace(config, effects={n: v for n, v in config.effects.items() if not filters_velocities(n)})
    simulated = simulate_windows(_around_the_start(windows, half), config)[0]
    true = simulated[:, half]
    cubic = _local_polynomial(simulated[..., :3], width, 3, windows.period_s)
    quintic = _local_polynomial(simulated[..., :3], 2 * half + 1, 5, windows.period_s)
    angle = windows.initial_states[:, 2] - true[:, 2]
    bias, difference = (with_rotated_positions(d, angle) for d in (cubic - true, quintic - cubic))
    invalid = ~np.isfinite(np.concatenate([bias, difference], axis=1)).all(axis=1)
    bias[invalid], difference[invalid] = 0.0, 0.0
    measured_difference = windows.curvature_bias
    share = np.zeros(6)
    for group in _GROUPS:
        simulated_power = float(np.sum(difference[:, group] ** 2))
        common = float(np.sum(difference[:, group] * measured_difference[:, group]))
        share[list(group)] = np.clip(common / max(simulated_power, 1e-30), 0.0, 1.0)
    return replace(
        windows,
        initial_states=windows.initial_states - share * bias,
        curvature_bias=measured_difference - share * difference,
    )


def _around_the_start(windows: PredictionWindows, half: int) -> PredictionWindows:
    """Windows of ``2 * half`` steps with the starts of ``windows`` in their middle."""
    return replace(
        windows,
        initial_states=windows.past_states[:, -half],
        past_commands=windows.past_commands[:, :-half],
        commands=np.concatenate([windows.past_commands[:, -half:], windows.commands[:, :half]], axis=1),
        measured=np.concatenate([windows.past_states[:, -half:], windows.measured[:, : half + 1]], axis=1),
        past_states=windows.past_states[:, :-half],
        t0_s=windows.t0_s - half * windows.period_s,
        velocity_window_s2=0.0,
        command_deviations=windows.deviations_in(slice(windows.past_commands.shape[1] + half)),
    )


def _local_polynomial(pose: FloatArray, width: int, order: int, period_s: float) -> FloatArray:
    """States (S, 6) of a local polynomial through the middle ``width`` of poses (S, n, 3)."""
    margin = (pose.shape[1] - width) // 2
    middle = pose[:, margin : margin + width]
    value = savgol_coeffs(width, order, use="dot") @ middle
    slope = savgol_coeffs(width, order, deriv=1, delta=period_s, use="dot") @ middle
    return body_states(value, slope)


def with_rotated_positions(differences: FloatArray, angle: FloatArray) -> FloatArray:
    """Differences of states (..., 6) with x, y rotated by ``angle`` (...)."""
    out = differences.copy()
    out[..., 0], out[..., 1] = to_world(differences[..., 0], differences[..., 1], angle)
    return out
