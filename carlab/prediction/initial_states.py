"""Initial states of prediction windows: smoothed without the curvature bias of the local cubic, or as recorded.

At command steps the motion has higher derivatives than a cubic, so later motion biases the initial state. An
approximate simulator predicts this bias: a cubic through simulated poses minus the simulated state. The bias is
subtracted in proportion to its evidence in the recording: the difference of a quintic and a cubic through the measured
poses is regressed on the simulated difference.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

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
OTHER_DELAYS = (-2.0, -1.5, -1.0, -0.5, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0)
"""Changes of the command delay with which the bias is simulated, too [control periods]."""
MIN_POWER_RISE = 0.1
"""Another delay is used for a group of channels if it explains more of the measured differences by this share."""


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
    around = _around_the_start(windows, half)
    initial_states, remaining = windows.initial_states.copy(), windows.curvature_bias.copy()
    explained = dict.fromkeys(_GROUPS, -1.0)
    for delayed in _with_other_delays(config, windows.period_s):
        bias, difference = _bias_and_difference(simulate_windows(around, delayed)[0], windows, width)
        share, power = _evidence(difference, windows.curvature_bias)
        for group in _GROUPS:
            columns = [channel for channels in group for channel in channels]
            if (found := float(power[columns].sum())) > (1.0 + MIN_POWER_RISE) * explained[group]:
                explained[group] = found
                initial_states[:, columns] = (windows.initial_states - share * bias)[:, columns]
                remaining[:, columns] = (windows.curvature_bias - share * difference)[:, columns]
    return replace(windows, initial_states=initial_states, curvature_bias=remaining)


def _evidence(simulated: FloatArray, measured: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Evidence in measured differences (S, 6) for simulated ones (S, 6), for each channel.

    Returns:
        The share (6,) of the simulated difference that the measured one contains, in [0, 1], and the share (6,) of the
        measured squares that it explains. Both are common to x and y.
    """
    share, power = np.zeros(6), np.zeros(6)
    for channels in (channels for group in _GROUPS for channels in group):
        one, other = simulated[:, channels], measured[:, channels]
        common, simulated_squares = float(np.sum(one * other)), max(float(np.sum(one**2)), 1e-30)
        found = min(max(common / simulated_squares, 0.0), 1.0)
        share[list(channels)] = found
        explained = found * (2.0 * common - found * simulated_squares)
        power[list(channels)] = explained / max(float(np.sum(other**2)), 1e-30) / len(channels)
    return share, power


def _with_other_delays(config: SimulatorConfig, period_s: float) -> Iterator[SimulatorConfig]:
    """The simulator, then the same with other command delays."""
    yield config
    for periods in OTHER_DELAYS:
        delay_s = config.command_delay_s + periods * period_s
        if min(config.delays_s()) + periods * period_s >= 0.0:
            yield config.with_values({COMMAND_DELAY: delay_s})


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
