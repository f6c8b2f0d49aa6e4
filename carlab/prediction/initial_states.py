"""Initial states of prediction windows: smoothed without the curvature bias of the local cubic, or as recorded.

At command steps the motion has higher derivatives than a cubic, so later motion biases the initial state. An
approximate simulator predicts this bias: a cubic through simulated poses minus the simulated state. The bias is
subtracted in proportion to its evidence in the recording: the difference of a quintic and a cubic through the measured
poses is regressed on the simulated difference.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import chain

import numpy as np
from scipy.signal import savgol_coeffs

from carlab.core.planar import to_world
from carlab.core.quantities import FloatArray
from carlab.prediction.predict import simulate_windows
from carlab.prediction.windows import MIN_QUINTIC_WIDTH, PredictionWindows, body_states, smoothing_width
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.measurement import COMMAND_DELAY, filters_velocities

_GROUPS = (((0, 1),), ((2,), (4,), (5,)), ((3,),))
"""Channels with a common delay: position, turning (by the steering), speed (by the throttle). Within a group, tuples of
channels with a common share of the bias."""
DELAY_CHANGES_PERIODS = (-2.0, -1.5, -1.0, -0.5, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0)
"""Changes of the command delay [periods of the recording] with which the bias is simulated in addition."""
MIN_RISE_OF_EXPLAINED_SHARE = 0.1
"""A changed delay is used for a group of channels if it explains more of the measured differences by this share."""
MIN_RISE_TIMES_WINDOWS = 10.0
"""Minimum rise of the explained share times the number of windows for a changed delay. By chance, with the commands of
other windows, the best of all delays reaches 4; recordings with a clearly different delay have 12 and more."""


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
    delays_s = _command_delays_s(config, windows.period_s)
    simulated = simulate_windows(_around_the_start(windows, half), config, {COMMAND_DELAY: delays_s})
    by_delay = [_bias_and_difference(poses, windows, width) for poses in simulated]
    evidence = [_evidence(difference, windows.curvature_bias) for _, difference in by_delay]
    initial_states, remaining = windows.initial_states.copy(), windows.curvature_bias.copy()
    for group in _GROUPS:
        columns = list(chain.from_iterable(group))
        delay = _best_delay([float(explained[columns].sum()) for _, explained in evidence], len(windows))
        (bias, difference), (share, _) = by_delay[delay], evidence[delay]
        initial_states[:, columns] -= (share * bias)[:, columns]
        remaining[:, columns] -= (share * difference)[:, columns]
    return replace(windows, initial_states=initial_states, curvature_bias=remaining)


def _command_delays_s(config: SimulatorConfig, period_s: float) -> FloatArray:
    """Command delay of the simulator [s], then the changed ones with which no command acts before it is sent.

    They may lie outside the range of the car file, because they only serve the initial states.
    """
    changes_s = np.array([0.0, *DELAY_CHANGES_PERIODS]) * period_s
    return config.command_delay_s + changes_s[min(config.delays_s()) + changes_s >= 0.0]


def _best_delay(explained: Sequence[float], count: int) -> int:
    """Index of the delay that explains most; 0, that of the simulator, unless another one explains clearly more.

    Args:
        explained: share that each delay explains, that of the simulator first.
        count: number of windows.
    """
    best = int(np.argmax(explained))
    rise = explained[best] - explained[0]
    is_clear = rise > MIN_RISE_OF_EXPLAINED_SHARE * explained[0] and rise * count >= MIN_RISE_TIMES_WINDOWS
    return best if is_clear else 0


def _evidence(simulated: FloatArray, measured: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Evidence in measured differences (S, 6) for simulated ones (S, 6), for each channel.

    Returns:
        The share (6,) of the simulated difference that the measured one contains, in [0, 1], and the share (6,) of the
        measured squares that it explains. Both are common to x and y.
    """
    share, explained = np.zeros(6), np.zeros(6)
    for channels in chain.from_iterable(_GROUPS):
        one, other = simulated[:, channels], measured[:, channels]
        common, simulated_squares = float(np.sum(one * other)), max(float(np.sum(one**2)), 1e-30)
        found = min(max(common / simulated_squares, 0.0), 1.0)
        share[list(channels)] = found
        squares = found * (2.0 * common - found * simulated_squares)
        explained[list(channels)] = squares / max(float(np.sum(other**2)), 1e-30) / len(channels)
    return share, explained


def _bias_and_difference(
    simulated: FloatArray, windows: PredictionWindows, width: int
) -> tuple[FloatArray, FloatArray]:
    """Bias (S, 6) of the cubic, and difference (S, 6) of quintic and cubic, through simulated poses."""
    half = simulated.shape[1] // 2
    true = simulated[:, half]
    cubic = _local_polynomial(simulated[..., :3], width, 3, windows.period_s)
    quintic = _local_polynomial(simulated[..., :3], 2 * half + 1, 5, windows.period_s)
    angle = windows.initial_states[:, 2] - true[:, 2]
    bias, difference = (with_rotated_positions(d, angle) for d in (cubic - true, quintic - cubic))
    invalid = ~np.isfinite(np.concatenate([bias, difference], axis=1)).all(axis=1)
    bias[invalid], difference[invalid] = 0.0, 0.0
    return bias, difference


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
