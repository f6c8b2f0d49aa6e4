"""Noise of a recording and of the estimated initial states of its windows, from the recording alone.

The estimate uses the residual of a local cubic. The cubic follows slow noise and amplifies some faster noise, so the
spectrum of the residual is divided by that of the filter. Below the edge frequency, where motion dominates, it is
extrapolated: flat for poses, proportional to the square of the frequency for velocities (differentiated poses).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
from scipy.signal import freqz, savgol_coeffs, welch

from carlab.core.quantities import FloatArray
from carlab.core.recording_noise import RecordingNoise, StateStd
from carlab.core.robust import STD_OVER_MAD
from carlab.diagnosis.settings import IDENTIFICATION
from carlab.prediction.windows import MIN_QUINTIC_WIDTH, RecordingSegment, smoothing_width

MIN_SPREAD = 1e-12
"""A channel with a smaller spread, in its SI unit, is constant but for rounding."""


@dataclass(frozen=True, slots=True)
class Noise:
    """Standard deviations (6,) of ``measured`` channels, and (6,) of the estimated ``initial_state``.

    Both are in the order x, y [m], yaw [rad], vx, vy [m/s], yaw rate [rad/s].
    """

    measured: FloatArray
    initial_state: FloatArray

    @classmethod
    def of(cls, recorded: RecordingNoise) -> Noise:
        """The noise in a ``model.toml``."""
        return cls(np.array(recorded.measured_std), np.array(recorded.initial_state_std))

    def as_recorded(self, velocity_window_s2: float) -> RecordingNoise:
        """The noise as ``model.toml`` keeps it, with the variance of the velocity window [s2]."""
        measured, initial_state = tuple(self.measured.tolist()), tuple(self.initial_state.tolist())
        return RecordingNoise(cast(StateStd, measured), cast(StateStd, initial_state), velocity_window_s2)


def estimate_noise(
    segments: Sequence[RecordingSegment],
    curvature_bias: FloatArray,
    *,
    slowest: bool = False,
) -> Noise:
    """Estimate the noise of each channel and of initial states.

    Motion faster than the cubic counts as noise; medians limit the influence of hard manoeuvres. The variance of an
    initial state is the noise that passes the cubic, plus the squared difference of a quintic from the cubic minus the
    noise of that difference.

    Args:
        segments: the recordings.
        curvature_bias: (S, 6) of prediction windows: initial states by a local quintic minus those by the local cubic.
        slowest: whether to use only the slowest rows for the noise of the channels.
    """
    period_s = segments[0].sampled_s
    width = smoothing_width(period_s)
    residual = np.concatenate([t.residual for t in segments])
    if slowest:
        speed = np.concatenate([t.speed for t in segments])
        residual = residual[speed <= np.quantile(speed, IDENTIFICATION.slowest_share)]
    measured = np.array([_deviation(residual[:, k], period_s, width, velocity=k > 2) for k in range(6)])
    measured[:2] = np.sqrt(np.mean(measured[:2] ** 2))
    measured = np.maximum(measured, IDENTIFICATION.min_noise_std)

    wide = max(width, MIN_QUINTIC_WIDTH)

    def weights(order: int, width: int) -> FloatArray:
        pair = [savgol_coeffs(width, order), savgol_coeffs(width, order, deriv=1, delta=period_s)]
        return np.pad(pair, ((0, 0), ((wide - width) // 2,) * 2))

    cubic, quintic = weights(3, width), weights(5, wide)
    cubic_noise = np.concatenate([np.linalg.norm(w) * measured[:3] for w in cubic])
    difference_noise = np.concatenate([np.linalg.norm(w) * measured[:3] for w in cubic - quintic])
    squared = curvature_bias**2
    clipped = np.minimum(squared, np.quantile(squared, IDENTIFICATION.max_error_quantile, axis=0))
    bias = np.mean(clipped, axis=0) - difference_noise**2
    return Noise(measured, np.sqrt(cubic_noise**2 + np.maximum(bias, 0.0)))


def _deviation(residual: FloatArray, period_s: float, width: int, *, velocity: bool) -> float:
    """Standard deviation of the noise whose residual (n,) of a local cubic over ``width`` samples is ``residual``."""
    spread = STD_OVER_MAD * float(np.median(np.abs(residual)))
    if spread < MIN_SPREAD:
        return 0.0
    limit = IDENTIFICATION.noise_max_z * spread
    clipped = np.clip(residual, -limit, limit)
    segment_rows = max(IDENTIFICATION.noise_segment_rows, round(IDENTIFICATION.noise_segment_s / period_s))
    rows = min(segment_rows, len(clipped))
    frequency, power = welch(clipped, 1.0 / period_s, nperseg=rows, detrend=False)
    high_pass = -savgol_coeffs(width, 3)
    high_pass[width // 2] += 1.0
    power_gain = np.abs(freqz(high_pass, worN=2.0 * np.pi * frequency * period_s)[1]) ** 2
    edge = int(np.argmax(power_gain > IDENTIFICATION.min_power_share))
    noise = power / np.maximum(power_gain, IDENTIFICATION.min_power_share)
    noise[:edge] = np.mean(noise[edge : edge + 3])
    if velocity:
        noise[:edge] *= (frequency[:edge] / frequency[edge]) ** 2
    total = float(np.sum(noise[1:-1]) + 0.5 * (noise[0] + noise[-1])) * (frequency[1] - frequency[0])
    return spread * float(np.sqrt(total / np.mean(clipped**2)))
