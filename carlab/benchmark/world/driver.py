"""Human driver: follows a track, changes speed, makes command steps, coasts, stands, reverses, makes small errors."""

from __future__ import annotations

import math

import numpy as np

from carlab.benchmark.world.base_car import GRAVITY_MPS2, BaseCar
from carlab.benchmark.world.simulation import FloatArray

MODES = ("follow", "steps", "coast", "stand", "reverse", "slow")


class Track:
    """A smooth closed curve of a few harmonics, sampled every few centimetres."""

    def __init__(self, rng: np.random.Generator) -> None:
        phase = np.linspace(0.0, 2 * math.pi, 600, endpoint=False)
        radius = rng.uniform(1.5, 2.3)
        x, y = 1.25 * radius * np.cos(phase), radius * np.sin(phase)
        for order in (2, 3, 4):
            size, shift = rng.uniform(0.0, 0.8 / order, 2), rng.uniform(0.0, 2 * math.pi, 2)
            x += size[0] * np.cos(order * phase + shift[0])
            y += size[1] * np.cos(order * phase + shift[1])
        self.points = np.stack([x, y], axis=1)
        step = np.roll(self.points, -1, axis=0) - self.points
        self.heading = np.arctan2(step[:, 1], step[:, 0])
        self.spacing_m = float(np.hypot(*step.T).mean())

    def nearest(self, x: float, y: float) -> int:
        """Index of the nearest point."""
        return int(np.argmin((self.points[:, 0] - x) ** 2 + (self.points[:, 1] - y) ** 2))


class HumanDriver:
    """Closed-loop driver with human errors: pure pursuit, proportional speed control, slow noise, changing modes.

    Called with time and newest state; returns commands in [-1, 1], as issued. With ``feedback_only`` it always follows
    the track without errors: commands are a function of the state, the path and a target speed that changes every few
    seconds.
    """

    def __init__(self, car: BaseCar, track: Track, rng: np.random.Generator, *, feedback_only: bool = False) -> None:
        self._car, self._track, self._rng = car, track, rng
        self._feedback_only = feedback_only
        self._grip = min(car.mu_front, car.mu_rear) * GRAVITY_MPS2
        if car.kind == "linear_tyre":
            self._grip = min(self._grip, 6.0)
        self._direction = 1 if rng.random() < 0.5 else -1
        self._mode, self._mode_end_s, self._speed, self._steering = "stand", float(rng.uniform(0.5, 1.2)), 1.0, 0.0
        self._throttle = 0.0
        self._noise = np.zeros(2)
        self._grip_share = float(rng.uniform(0.75, 1.05))

    def start(self) -> tuple[float, ...]:
        """Initial pose on the track, at standstill."""
        i = int(self._rng.integers(len(self._track.points)))
        heading = self._track.heading[i] + (0.0 if self._direction > 0 else math.pi)
        return (float(self._track.points[i, 0]), float(self._track.points[i, 1]), float(heading), 0.0, 0.0, 0.0)

    def __call__(self, t: float, state: FloatArray) -> tuple[float, float]:
        """Steering and throttle in [-1, 1] for the tick at t [s]; the state (6,) is that of the newest capture."""
        period = self._car.control_period
        x, y, psi, vx = (float(v) for v in state[:4])
        i = self._track.nearest(x, y)
        off = math.hypot(*(self._track.points[i] - (x, y)))
        if t >= self._mode_end_s or (off > 1.5 and self._mode in ("steps", "reverse", "coast")):
            self._choose_mode(t, off)
        decay = math.exp(-period / 0.35)
        if not self._feedback_only:
            self._noise = decay * self._noise + math.sqrt(1 - decay**2) * self._rng.normal(0.0, (0.08, 0.05))
        steering = self._pure_pursuit(i, x, y, psi, vx)
        if self._mode == "steps":
            steering = self._steering
        elif self._mode == "reverse":
            steering = self._steering * 0.7
        throttle = self._throttle_for(vx, abs(steering))
        steering += float(self._noise[0]) * (self._mode != "stand")
        return min(max(steering, -1.0), 1.0), min(max(throttle, -1.0), 1.0)

    def _choose_mode(self, t: float, off: float) -> None:
        rng = self._rng
        follow_only = self._feedback_only or off >= 1.0
        shares = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0) if follow_only else (0.46, 0.25, 0.07, 0.04, 0.08, 0.10)
        self._mode = str(rng.choice(MODES, p=shares))
        length = {"follow": (1.5, 5.0), "steps": (0.25, 0.9), "coast": (0.6, 1.5), "stand": (0.5, 1.2)}
        self._mode_end_s = t + float(rng.uniform(*length.get(self._mode, (1.5, 3.0))))
        self._speed = float(rng.uniform(0.7, 3.2))
        self._steering = float(rng.choice((-1.0, 1.0)) * rng.choice((0.12, 0.3, 0.5, 0.8, 1.0)) * rng.uniform(0.8, 1.0))
        self._throttle = float(rng.uniform(-0.25, 0.75))
        if self._mode == "follow" and rng.random() < 0.25:
            self._direction = -self._direction

    def _pure_pursuit(self, i: int, x: float, y: float, psi: float, vx: float) -> float:
        ahead_m = 0.45 + 0.3 * abs(vx)
        j = (i + self._direction * round(ahead_m / self._track.spacing_m)) % len(self._track.points)
        dx, dy = self._track.points[j] - (x, y)
        bearing = math.remainder(math.atan2(dy, dx) - psi, 2 * math.pi)
        if abs(bearing) > 2.0:  # the target is behind the car
            return math.copysign(1.0, bearing)
        distance = max(math.hypot(dx, dy), 0.2)
        angle = math.atan(2 * self._car.wheelbase * math.sin(bearing) / distance)
        return angle / self._car.max_angle

    def _throttle_for(self, vx: float, turn: float) -> float:
        if self._mode == "coast":
            return 0.0
        if self._mode == "stand":
            return -0.3 * min(max(vx, -1.0), 1.0) if abs(vx) > 0.1 else 0.0
        if self._mode == "steps":
            return self._throttle if abs(vx) < 3.0 else 0.0
        curvature = math.tan(min(turn, 1.0) * self._car.max_angle) / self._car.wheelbase
        wanted = min(self._speed, self._grip_share * math.sqrt(self._grip / max(curvature, 0.2)))
        if self._mode == "slow":
            wanted = 0.6
        if self._mode == "reverse":
            wanted = -0.8
        hold = self._car.damping * wanted / self._car.drive_gain
        return hold + 0.35 * (wanted - vx) + float(self._noise[1])
