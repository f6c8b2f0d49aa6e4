"""Vibration that turns with the wheels: a line in what a local cubic leaves, at so many periods per metre travelled.

An unbalanced or bent wheel shakes the car once per turn, whatever the speed, and harder the faster it turns. Over time
its frequency wanders with the speed; over the distance travelled it is one line (order tracking, as for rotating
machines), and a wheel is only blamed where that line stands out more than any over time: what shakes at a frequency of
its own, whatever the speed, is no wheel. Blocks of a few seconds are summed without their phases, for the distance is
not known to a fraction of a turn over a whole recording.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import gamma

from carlab.core.quantities import STATE_NAMES, FloatArray
from carlab.diagnosis.shots import Track

PERIODS_PER_M = np.arange(1.0, 12.0, 0.05)
"""Lines that are looked at: wheels of 13 to 160 mm radius."""
LEAST_RATIO = 4.5
"""A line's power over the mean power; development recordings without one stay below 3.2."""
LEAST_P = 1e-15
"""Probability of such power by chance, which guards short recordings."""
HERTZ = np.arange(1.0, 25.0, 0.1)
"""Lines over time that a wheel must outdo, up to half the rate of the recording."""
_BLOCK_S = 4.0
_SLOWEST_MPS = 0.3
_WINSORISED = 4.0


@dataclass(frozen=True, slots=True)
class Vibration:
    """A line in x, y, yaw, vx, vy, yaw rate.

    periods_per_m     where it is
    amplitude   (6,)  at the median speed, in the channel's unit; a lower bound
    ratio       (6,)  power over the mean power of all lines
    """

    periods_per_m: float
    amplitude: FloatArray
    ratio: FloatArray

    def words(self) -> str:
        """The class statement."""
        radius_mm = 1e3 / (2.0 * np.pi * self.periods_per_m)
        channels = [STATE_NAMES[k] for k in (5, 4, 3, 2) if self.ratio[k] > LEAST_RATIO]
        return (
            f"vibration in {', '.join(channels)}: {self.periods_per_m:.3g} periods per metre travelled, and harder "
            f"at speed, as an unbalanced or bent wheel of {radius_mm:.0f} mm radius would shake the car"
        )

    def formula(self) -> str:
        """The strongest line in SI units; s is the distance travelled."""
        k = 3 + int(np.argmax(self.ratio[3:]))
        return f"{STATE_NAMES[k]} += {self.amplitude[k]:.2g} sin(2 pi s / {1.0 / self.periods_per_m:.3g} m)"


def find_vibration(tracks: Sequence[Track]) -> Vibration | None:
    """The strongest line in yaw, vx, vy or yaw rate, if there is one beyond doubt."""
    power, strength, by_time = (np.zeros((6, n)) for n in (len(PERIODS_PER_M), len(PERIODS_PER_M), len(HERTZ)))
    blocks = 0
    for track in tracks:
        spread = 1.4826 * np.median(np.abs(track.residual), axis=0)
        residual = np.clip(track.residual, -_WINSORISED * spread, _WINSORISED * spread)
        distance_m = np.cumsum(track.speed) * track.sampled_s
        length = max(round(_BLOCK_S / track.sampled_s), 2)
        in_time = _lines(
            np.where(0.5 / track.sampled_s > HERTZ, HERTZ, 0.0), track.sampled_s * np.arange(float(length))
        )
        for first in range(0, len(distance_m) - length + 1, length):
            block = slice(first, first + length)
            if track.speed[block].mean() < _SLOWEST_MPS:
                continue
            weighted = residual[block] * track.speed[block, None]
            own = np.maximum(np.sum(weighted**2, axis=0), 1e-30)[:, None]
            of_line = np.abs(_lines(PERIODS_PER_M, distance_m[block]) @ weighted).T ** 2
            power += of_line / own
            strength += of_line / np.sum(track.speed[block] ** 2) ** 2
            by_time += np.abs(in_time @ weighted).T ** 2 / own
            blocks += 1
    if blocks == 0:
        return None
    channel = 2 + int(np.argmax(power[2:].max(axis=1)))
    line = int(np.argmax(power[channel]))
    highest = float(power[channel, line])
    if highest < LEAST_RATIO * blocks or highest < by_time[channel].max() or gamma.sf(highest, blocks) > LEAST_P:
        return None
    median_mps = float(np.median(np.concatenate([track.speed for track in tracks])))
    amplitude = 2.0 * np.sqrt(strength[:, line] / blocks) * median_mps
    return Vibration(float(PERIODS_PER_M[line]), amplitude, power[:, line] / blocks)


def _lines(frequencies: FloatArray, at: FloatArray) -> NDArray[np.complex128]:
    """Waves (F, n) of so many periods per unit of ``at`` (n,)."""
    waves: NDArray[np.complex128] = np.exp(2j * np.pi * np.outer(frequencies, at))
    return waves
