"""Motion capture of a simulated car: exposures at a rate, noise, lost frames, latency."""

from __future__ import annotations

import math
from collections import deque
from typing import Protocol

import numpy as np

from carlab.core.angles import wrap
from carlab.core.quantities import PoseSample
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.plant import Pose

CLOCK_TOLERANCE = 1e-4
"""Relative difference between a control period and a number of frames that counts as rounding in the car file."""


def frame_rate_hz(config: SimulatorConfig) -> float:
    """Frames a second; a control period that is a whole number of frames but for rounding is exactly that number.

    Otherwise a control period of 0.0333333333 s would begin 33 ps earlier relative to the frames at each tick.
    """
    frames = config.control_period_s * config.mocap.rate_hz
    whole = round(frames)
    if whole and abs(frames - whole) <= CLOCK_TOLERANCE * whole:
        return whole / config.control_period_s
    return config.mocap.rate_hz


class PoseProvider(Protocol):
    """Source of true poses for a sensor, for example a plant."""

    def measured_pose(self, t_s: float) -> Pose:
        """Pose of the tracked point at ``t_s``, without noise."""


class MocapSensor:
    """Samples a plant at the rate of the car file. The caller supplies the time, simulated or real.

    Exposure ``k`` after ``reset`` is at ``start + k / frame_rate_hz`` and has its own random numbers, so measurements
    depend on the seed and the exposure only, not on the times of the calls.

    Args:
        config: Rate, noise, latency and share of lost frames; effects that change the latency.
        seed: Seed of the noise.
    """

    def __init__(self, config: SimulatorConfig, seed: int = 0) -> None:
        self._mocap = config.mocap
        self._frame_rate_hz = frame_rate_hz(config)
        self.latency_s = config.latency_s()
        self.lost = 0
        self.seed(seed)
        self._start_s = 0.0
        self._next = 0
        self._sequence = 0
        self._in_flight: deque[PoseSample] = deque()

    @property
    def rate_hz(self) -> float:
        """Exposures a second."""
        return self._mocap.rate_hz

    def seed(self, seed: int) -> None:
        """Restart the random numbers of noise and lost frames."""
        self._rng = np.random.default_rng(seed)

    def reset(self, t_s: float) -> None:
        """Restart with the first exposure at ``t_s`` and no samples in flight; sequence numbers and noise continue."""
        self._start_s = t_s
        self._next = 0
        self._in_flight.clear()

    def next_exposure_s(self) -> float:
        """Time of the next exposure [s]."""
        return self._start_s + self._next / self._frame_rate_hz

    def expose(self, t_s: float, plant: PoseProvider) -> PoseSample | None:
        """Make one exposure at ``t_s``; None if the frame is lost. Does not change the schedule."""
        x_noise, y_noise, yaw_noise = self._rng.standard_normal(3)
        lost = self._rng.random() < self._mocap.dropout
        sequence = self._sequence
        self._sequence += 1
        if lost:
            self.lost += 1
            return None
        pose = plant.measured_pose(t_s)
        return PoseSample(
            sequence=sequence,
            t_capture_s=t_s,
            t_receive_s=t_s + self.latency_s,
            x_m=pose.x_m + self._mocap.position_std_m * float(x_noise),
            y_m=pose.y_m + self._mocap.position_std_m * float(y_noise),
            yaw_rad=wrap(pose.yaw_rad + self._mocap.yaw_std_rad * float(yaw_noise)),
        )

    def samples_until(self, t_s: float, plant: PoseProvider) -> list[PoseSample]:
        """Make the exposures due up to ``t_s`` and return the samples that have arrived by then, oldest first."""
        # A nanosecond of tolerance, so that rounding does not delay an exposure that is due now.
        while self.next_exposure_s() <= t_s + 1e-9:
            due_s = self.next_exposure_s()
            self._next += 1
            if (sample := self.expose(due_s, plant)) is not None:
                self._in_flight.append(sample)
        arrived = []
        while self._in_flight and self._in_flight[0].t_receive_s <= t_s + 1e-9:
            arrived.append(self._in_flight.popleft())
        return arrived

    def settling_time_s(self, window_s: float) -> float:
        """Time until a velocity window of ``window_s`` is filled with arrived samples [s]."""
        periods = math.ceil(window_s * self._mocap.rate_hz) + 2
        return periods / self._frame_rate_hz + self.latency_s
