"""Vibration at the rotation of the wheels: a spectral line of the local cubic's residual over the distance travelled.

An unbalanced or bent wheel excites the car once per revolution, with an amplitude that grows with speed. Its frequency
in time varies with speed; over the distance travelled it is one line (order tracking of rotating machines). The line
must be stronger than any line in time, because a vibration of fixed frequency does not come from a wheel. The power
spectra of blocks of a few seconds are added, because the distance error over a whole recording exceeds a revolution.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import gamma

from carlab.core.quantities import STATE_NAMES, FloatArray
from carlab.core.robust import STD_OVER_MAD
from carlab.diagnosis.settings import UNEXPLAINED
from carlab.prediction.windows import RecordingSegment

PERIODS_PER_M = np.arange(1.0, 12.0, 0.05)
"""Lines over the distance travelled [1/m]: wheels of 13 to 160 mm radius."""
FREQUENCIES_HZ = np.arange(1.0, 25.0, 0.1)
"""Lines in time [Hz] that a wheel's line must exceed, up to half the sampling rate."""


@dataclass(frozen=True, slots=True)
class Vibration:
    """A spectral line in x, y, yaw, vx, vy, yaw rate.

    periods_per_m     spatial frequency [1/m]
    amplitude   (6,)  at the median speed, in the channel's SI unit; a lower bound
    ratio       (6,)  power over the mean power of all lines
    """

    periods_per_m: float
    amplitude: FloatArray
    ratio: FloatArray

    def class_statement(self) -> str:
        """Class of the physics."""
        radius_mm = 1e3 / (2.0 * np.pi * self.periods_per_m)
        channels = [STATE_NAMES[k] for k in (5, 4, 3, 2) if self.ratio[k] > UNEXPLAINED.vibration_ratio_min]
        return (
            f"vibration in {', '.join(channels)}: {self.periods_per_m:.3g} periods per metre travelled, with an "
            f"amplitude that grows with speed, as of an unbalanced or bent wheel of {radius_mm:.0f} mm radius"
        )

    def formula(self) -> str:
        """The strongest line in SI units; s is the distance travelled."""
        k = 3 + int(np.argmax(self.ratio[3:]))
        return f"{STATE_NAMES[k]} += {self.amplitude[k]:.2g} sin(2 pi s / {1.0 / self.periods_per_m:.3g} m)"


def find_vibration(segments: Sequence[RecordingSegment]) -> Vibration | None:
    """The strongest significant line in yaw, vx, vy or yaw rate, or None.

    Velocities that are differentiated poses are not searched: the differentiation makes a band of their white noise.
    """
    power, strength, by_time = (np.zeros((6, n)) for n in (len(PERIODS_PER_M), len(PERIODS_PER_M), len(FREQUENCIES_HZ)))
    blocks = 0
    for segment in segments:
        spread = STD_OVER_MAD * np.median(np.abs(segment.residual), axis=0)
        residual = np.clip(
            segment.residual, -UNEXPLAINED.vibration_max_z * spread, UNEXPLAINED.vibration_max_z * spread
        )
        distance_m = np.cumsum(segment.speed) * segment.sampled_s
        length = max(round(UNEXPLAINED.vibration_block_s / segment.sampled_s), 2)
        in_time = _lines(
            np.where(0.5 / segment.sampled_s > FREQUENCIES_HZ, FREQUENCIES_HZ, 0.0),
            segment.sampled_s * np.arange(float(length)),
        )
        for first in range(0, len(distance_m) - length + 1, length):
            block = slice(first, first + length)
            if segment.speed[block].mean() < UNEXPLAINED.vibration_speed_min_mps:
                continue
            weighted = residual[block] * segment.speed[block, None]
            energy = np.maximum(np.sum(weighted**2, axis=0), 1e-30)[:, None]
            of_line = np.abs(_lines(PERIODS_PER_M, distance_m[block]) @ weighted).T ** 2
            power += of_line / energy
            strength += of_line / np.sum(segment.speed[block] ** 2) ** 2
            by_time += np.abs(in_time @ weighted).T ** 2 / energy
            blocks += 1
    if blocks == 0:
        return None
    channels = slice(2, 6 if all(segment.has_velocity_columns for segment in segments) else 3)
    channel = 2 + int(np.argmax(power[channels].max(axis=1)))
    line = int(np.argmax(power[channel]))
    highest = float(power[channel, line])
    if highest < UNEXPLAINED.vibration_ratio_min * blocks or highest < by_time[channel].max():
        return None
    if gamma.sf(highest, blocks) > UNEXPLAINED.vibration_p_max:
        return None
    median_mps = float(np.median(np.concatenate([segment.speed for segment in segments])))
    amplitude = 2.0 * np.sqrt(strength[:, line] / blocks) * median_mps
    return Vibration(float(PERIODS_PER_M[line]), amplitude, power[:, line] / blocks)


def _lines(frequencies: FloatArray, at: FloatArray) -> NDArray[np.complex128]:
    """Complex exponentials (F, n) of ``frequencies`` (F,) at ``at`` (n,)."""
    waves: NDArray[np.complex128] = np.exp(2j * np.pi * np.outer(frequencies, at))
    return waves
