"""How noisy a recording and the estimated starts of its shots are, from the recording alone.

Noise is what a local cubic leaves of a channel. The cubic takes slow noise along and sharpens some that is faster, so
that its spectrum is divided by the filter's own; below its edge, where motion hides the noise, it is continued:
flat for poses, falling to nothing with the square of the frequency for velocities, which are differentiated poses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import freqz, savgol_coeffs, welch

from carlab.core.quantities import FloatArray
from carlab.diagnosis.shots import QUINTIC_WIDTH, Track, start_width

LEAST = (1e-5, 1e-5, 1e-5, 1e-4, 1e-4, 1e-4)
_EDGE = 0.5
"""Share of noise power that the residual of the cubic must keep for its spectrum to be used."""
_WINSORISED = 3.0
"""Standard deviations beyond which a residual is taken for motion faster than the cubic."""
_SEGMENT = 64
_SLOWEST = 0.3
"""Share of the rows, the slowest, that a car that shakes with its speed is judged by."""
_CERTAIN = 0.99


@dataclass(frozen=True, slots=True)
class Noise:
    """Standard deviations of what was measured, by channel x, y, yaw, vx, vy, yaw rate (6,), and of shot starts."""

    measured: FloatArray
    start: FloatArray


def estimate_noise(tracks: Sequence[Track], bent: FloatArray, *, slowest: bool = False) -> Noise:
    """Noise of each channel and of shot starts.

    An estimate: whatever in the recording is faster than the cubic counts as noise, hard manoeuvres only a little
    (medians). The error of a start is the noise that its cubic lets through and its bias where the motion bends more
    than a cubic does, by what a quintic finds beyond its own noise.

    Args:
        tracks: the recordings.
        bent: (S, 6) what a quintic makes of shot starts, less what they are.
        slowest: whether the slowest rows alone tell the noise of the channels.
    """
    period_s = tracks[0].sampled_s
    width = start_width(period_s)
    residual = np.concatenate([t.residual for t in tracks])
    if slowest:
        speed = np.concatenate([t.speed for t in tracks])
        residual = residual[speed <= np.quantile(speed, _SLOWEST)]
    measured = np.array([_deviation(residual[:, k], period_s, width, velocity=k > 2) for k in range(6)])
    measured[:2] = np.sqrt(np.mean(measured[:2] ** 2))
    measured = np.maximum(measured, LEAST)

    wide = max(width, QUINTIC_WIDTH)

    def weights(order: int, width: int) -> FloatArray:
        pair = [savgol_coeffs(width, order), savgol_coeffs(width, order, deriv=1, delta=period_s)]
        return np.pad(pair, ((0, 0), ((wide - width) // 2,) * 2))

    cubic, quintic = weights(3, width), weights(5, wide)
    let_through = np.concatenate([np.linalg.norm(w) * measured[:3] for w in cubic])
    of_quintic = np.concatenate([np.linalg.norm(w) * measured[:3] for w in cubic - quintic])
    squared = bent**2
    bias = np.mean(np.minimum(squared, np.quantile(squared, _CERTAIN, axis=0)), axis=0) - of_quintic**2
    return Noise(measured, np.sqrt(let_through**2 + np.maximum(bias, 0.0)))


def _deviation(residual: FloatArray, period_s: float, width: int, *, velocity: bool) -> float:
    """Standard deviation of the noise that leaves ``residual`` (n,) of a local cubic over ``width`` samples."""
    spread = 1.4826 * float(np.median(np.abs(residual)))
    if spread == 0.0:
        return 0.0
    left = np.clip(residual, -_WINSORISED * spread, _WINSORISED * spread)
    frequency, power = welch(left, 1.0 / period_s, nperseg=min(_SEGMENT, len(left)), detrend=False)
    taken = -savgol_coeffs(width, 3)
    taken[width // 2] += 1.0
    kept = np.abs(freqz(taken, worN=2.0 * np.pi * frequency * period_s)[1]) ** 2
    edge = int(np.argmax(kept > _EDGE))
    noise = power / np.maximum(kept, _EDGE)
    noise[:edge] = np.mean(noise[edge : edge + 3])
    if velocity:
        noise[:edge] *= (frequency[:edge] / frequency[edge]) ** 2
    total = float(np.sum(noise[1:-1]) + 0.5 * (noise[0] + noise[-1])) * (frequency[1] - frequency[0])
    return spread * float(np.sqrt(total / np.mean(left**2)))
