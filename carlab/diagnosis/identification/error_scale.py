"""Standard deviations that whiten prediction errors, and Huber's loss of whitened errors (Huber 1964)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from carlab.core.quantities import FloatArray
from carlab.core.robust import STD_OVER_MAD
from carlab.diagnosis.settings import IDENTIFICATION
from carlab.prediction.errors import bounded

MAX_WHITE = 1e4
"""Maximum size of a whitened error."""


@dataclass(frozen=True, slots=True)
class Scale:
    """Standard deviations that whiten errors: ``sigma`` (U, 6) by step and channel, and the ``steps`` (U,).

    ``sigma`` has the units of the errors: x, y [m], yaw [rad], vx, vy [m/s], yaw rate [rad/s]. ``root`` (6 U, 6 U)
    decorrelates the errors of a window in standard deviations; without it, they count as independent.
    """

    steps: np.ndarray
    sigma: FloatArray
    root: FloatArray | None = None

    @classmethod
    def of(cls, error: FloatArray, floor: FloatArray) -> Scale:
        """Robust spread of errors (S, K + 1, 6) of the best model so far, at least the floor (6,)."""
        steps = _loss_steps(error.shape[1] - 1)
        spread = STD_OVER_MAD * np.median(np.abs(error[:, steps]), axis=0)
        return cls(steps, np.maximum(spread, floor))

    @classmethod
    def of_floor(cls, floor: FloatArray) -> Scale:
        """The scale of a perfect simulator, by the noise floor (K + 1, 6) along a window."""
        steps = _loss_steps(len(floor) - 1)
        return cls(steps, floor[steps])

    def white(self, error: FloatArray) -> FloatArray:
        """Whitened errors (..., U, 6) of errors (..., K + 1, 6)."""
        return self.white_at_steps(error[..., self.steps, :])

    def white_at_steps(self, error: FloatArray) -> FloatArray:
        """Whitened errors (..., U, 6) of errors (..., U, 6) at the steps; none is infinite or NaN."""
        white = bounded(error / self.sigma, MAX_WHITE)
        if self.root is None:
            return white
        return bounded((white.reshape(*white.shape[:-2], -1) @ self.root).reshape(white.shape), MAX_WHITE)

    def as_bytes(self) -> tuple[bytes, ...]:
        """The content, to compare scales by."""
        return tuple(b"" if each is None else each.tobytes() for each in (self.steps, self.sigma, self.root))


def _loss_steps(last: int) -> NDArray[np.int64]:
    """Steps (U,) of a window of ``last`` steps whose errors enter the loss, at even spacing."""
    count = IDENTIFICATION.loss_steps
    return np.unique(np.linspace(last / count, last, count).round().astype(int))


def huber(white: FloatArray) -> FloatArray:
    """Huber's loss of whitened errors (...), element by element; it is linear from ``huber_delta`` on."""
    delta, size = IDENTIFICATION.huber_delta, np.abs(white)
    return np.where(size <= delta, 0.5 * white**2, delta * size - 0.5 * delta**2)


def huber_weight(white: FloatArray) -> FloatArray:
    """Weight of each whitened error (...) in least squares with the gradient of Huber's loss."""
    return np.minimum(1.0, IDENTIFICATION.huber_delta / np.maximum(np.abs(white), 1e-12))
