"""Held-out errors after a horizon, in units and in noise floors, and how effects are told by them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from carlab.core.quantities import STATE_NAMES, FloatArray
from carlab.diagnosis.findings import FitErrors
from carlab.diagnosis.fit import clustered_gain, huber
from carlab.diagnosis.measurement_noise import Noise
from carlab.diagnosis.prediction import Predictor, errors
from carlab.diagnosis.shots import Shots
from sim_backends.car_parameters import SimulatorConfig

CERTAIN = 0.99
"""Quantile beyond which a start's error does not count: a shot at the edge of a spin says nothing of noise."""


@dataclass(frozen=True, slots=True)
class HeldOut:
    """Held-out shots with their noise floor (6,), the error that a perfect simulator would leave after the horizon.

    The floor is what was measured at the end plus what the uncertain start grows to; an estimate, from the recording.
    """

    shots: Shots
    floor: FloatArray

    @classmethod
    def of(cls, shots: Shots, noise: Noise, config: SimulatorConfig) -> HeldOut:
        """With the floor of a simulator that is near enough for how starts grow."""
        return cls(shots, noise_floor(shots, noise, config)[-1])

    def final_error(self, config: SimulatorConfig) -> FloatArray:
        """Errors (S, 6) after the horizon."""
        error = errors(Predictor(self.shots, config)(), self.shots)[0, :, -1]
        return np.nan_to_num(error, nan=1e3, posinf=1e3, neginf=-1e3).clip(-1e3, 1e3)

    def score(self, error: FloatArray) -> float:
        """Root mean square over shots and channels of errors (S, 6) in floors."""
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
        return self.summary(np.tile(self.floor, (2, 1)))

    def gain(self, without: FloatArray, with_it: FloatArray) -> tuple[float, float]:
        """Held-out gain in Huber log-likelihood from errors (S, 6) to errors (S, 6), and its clustered error."""
        scale = np.maximum(1.4826 * np.median(np.abs(with_it), axis=0), self.floor)
        before, after = (huber(e / scale).sum(axis=1) for e in (without, with_it))
        return clustered_gain(before, after, self.shots)

    @staticmethod
    def fingerprint(without: FloatArray, with_it: FloatArray) -> dict[str, float]:
        """Relative rise of each channel's rms error when an effect is taken out."""
        before, after = (np.sqrt(np.mean(e**2, axis=0)) for e in (without, with_it))
        return {name: float(b / max(a, 1e-12) - 1.0) for name, a, b in zip(STATE_NAMES, after, before, strict=True)}


def noise_floor(shots: Shots, noise: Noise, config: SimulatorConfig) -> FloatArray:
    """Error (K + 1, 6) that noise alone causes along a shot: measurement, and the start's own error as it grows."""
    reference = Predictor(shots, config)()
    variance = np.tile(noise.measured**2, (shots.steps + 1, 1))
    for k in range(6):
        start = shots.start.copy()
        start[:, k] += noise.start[k]
        moved = Predictor(replace(shots, start=start), config)()
        grown = errors(moved - reference + shots.measured[None], shots)[0]
        squared = grown**2
        variance += np.mean(np.minimum(squared, np.quantile(squared, CERTAIN, axis=0)), axis=0)
    return np.sqrt(variance)
