"""Estimator of car states from motion-capture poses: velocities with a known delay, from unwrapped angles.

The velocity is the slope of a least-squares line through the poses of a short window. For stamps one ``dt`` apart its
standard deviation is ``sigma sqrt(12 / (n (n^2 - 1))) / dt`` (Savitzky-Golay filter of order one). It is the velocity
at the window's mean time; ``velocity_delay_s`` is the age of that time.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from carlab.core.angles import wrap
from carlab.core.quantities import CarState, FloatArray, PoseSample

MIN_SAMPLES = 3
MAX_SPAN_WINDOWS = 4.0
RESTART_AFTER_SAMPLES = 10


@dataclass(frozen=True, slots=True)
class VelocityFit:
    """Body velocities at ``t_s``, the mean time of the fitted poses."""

    t_s: float
    vx_mps: float
    vy_mps: float
    yaw_rate_radps: float


def fit_velocity(poses: FloatArray) -> VelocityFit:
    """Fit lines through poses, shape (n, 4) with columns t [s], x [m], y [m], unwrapped yaw [rad] and n >= 2.

    The stamps may be irregular but not all equal. The world velocity is rotated into the body frame by the yaw of
    the fit at the mean time.
    """
    mean = poses.mean(axis=0)
    centred = poses - mean
    t = centred[:, 0]
    velocity_x, velocity_y, yaw_rate = (float(v) for v in (t @ centred[:, 1:]) / (t @ t))
    sin, cos = math.sin(mean[3]), math.cos(mean[3])
    return VelocityFit(
        float(mean[0]), cos * velocity_x + sin * velocity_y, cos * velocity_y - sin * velocity_x, yaw_rate
    )


class StateEstimator:
    """Estimates the state of a car from its pose samples, with one ``update`` per sample.

    Args:
        window_s: Length of the window of the fit [s]. If it holds fewer than three samples (slow or lossy motion
            capture), the three newest samples are used if they lie within four windows.

    Attributes:
        velocity_valid: False while there are too few samples; the velocities of ``estimate`` are zero then.
        dropped: Count of ignored samples: repeated, backward in time or not finite.
    """

    def __init__(self, window_s: float = 0.05) -> None:
        self.window_s = window_s
        self.dropped = 0
        self._poses: deque[tuple[float, float, float, float]] = deque()
        self._newest: PoseSample | None = None
        self._backward_run = 0

    def reset(self) -> None:
        """Discard all samples (after the car was moved by hand); the counts stay."""
        self._poses.clear()
        self._newest = None
        self._backward_run = 0

    @property
    def velocity_valid(self) -> bool:
        """Whether there are enough samples for velocities."""
        return len(self._poses) >= MIN_SAMPLES

    @property
    def newest(self) -> PoseSample | None:
        """The newest accepted sample; None before the first."""
        return self._newest

    def update(self, sample: PoseSample) -> None:
        """Add one sample. Untracked samples are ignored; repeated, backward and non-finite ones are also counted.

        After a backward step of the source's clock (ten consecutive samples are older than the newest) the window
        restarts.
        """
        if not sample.tracked:
            return
        pose = (sample.t_capture_s, sample.x_m, sample.y_m, sample.yaw_rad)
        if not all(map(math.isfinite, pose)):
            self.dropped += 1
            return
        if self._newest is not None and sample.t_capture_s <= self._newest.t_capture_s:
            self.dropped += 1
            repeated = sample.t_capture_s == self._newest.t_capture_s
            self._backward_run = 0 if repeated else self._backward_run + 1
            if self._backward_run < RESTART_AFTER_SAMPLES:
                return
            self.reset()
        self._backward_run = 0
        yaw_rad = sample.yaw_rad
        if self._poses:
            before = self._poses[-1][3]
            yaw_rad = before + wrap(yaw_rad - before)
        self._poses.append((sample.t_capture_s, sample.x_m, sample.y_m, yaw_rad))
        self._newest = sample
        # Half a microsecond of tolerance keeps a sample that is exactly one window old despite rounding.
        while (span_s := sample.t_capture_s - self._poses[0][0]) > self.window_s + 5e-7 and (
            len(self._poses) > MIN_SAMPLES or span_s > MAX_SPAN_WINDOWS * self.window_s
        ):
            self._poses.popleft()

    def estimate(self) -> tuple[CarState, float] | None:
        """State with the newest pose, and the delay of its velocities relative to that pose [s].

        None before the first tracked sample. With too few samples for a fit (``velocity_valid`` is False) the
        velocities and the delay are zero. The yaw is wrapped to [-pi, pi).
        """
        if self._newest is None:
            return None
        newest = self._newest
        x_m, y_m, yaw_rad = newest.x_m, newest.y_m, wrap(newest.yaw_rad)
        if not self.velocity_valid:
            return CarState(x_m, y_m, yaw_rad), 0.0
        fit = fit_velocity(np.array(self._poses))
        state = CarState(x_m, y_m, yaw_rad, fit.vx_mps, fit.vy_mps, fit.yaw_rate_radps)
        return state, newest.t_capture_s - fit.t_s
