"""Quantities at the interfaces between packages: immutable, in SI units, with the unit in every name.

Frames (REP-103, REP-105): world frame ``map`` and body frame ``base_link`` with its origin at the
centre of mass; x forward, y left, yaw counter-clockwise.
Commands are dimensionless in [-1, 1]; steering is positive to the left, throttle is positive forward.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Action:
    """A normalised command: ``steering`` and ``throttle`` in [-1, 1]."""

    steering: float = 0.0
    throttle: float = 0.0

    def to_array(self) -> FloatArray:
        """Return ``[steering, throttle]``, shape (2,)."""
        return np.array([self.steering, self.throttle], dtype=np.float64)

    @classmethod
    def from_array(cls, values: NDArray[np.floating]) -> Action:
        """Build an action from ``[steering, throttle]``, shape (2,)."""
        steering, throttle = (float(v) for v in np.asarray(values).reshape(2))
        return cls(steering, throttle)

    @property
    def is_neutral(self) -> bool:
        """True when both channels are exactly zero."""
        return self.steering == 0.0 and self.throttle == 0.0

    @property
    def is_finite(self) -> bool:
        """True when neither channel is NaN or infinite."""
        return math.isfinite(self.steering) and math.isfinite(self.throttle)


NEUTRAL = Action()
ACTION_NAMES = ("steering", "throttle")
STATE_NAMES = ("x", "y", "yaw", "vx", "vy", "yaw_rate")
STATE_UNITS = ("m", "m", "rad", "m/s", "m/s", "rad/s")


@dataclass(frozen=True, slots=True)
class CarState:
    """Pose of ``base_link`` in ``map`` and velocities in the body frame."""

    x_m: float = 0.0
    y_m: float = 0.0
    yaw_rad: float = 0.0
    vx_mps: float = 0.0
    vy_mps: float = 0.0
    yaw_rate_radps: float = 0.0

    def to_array(self) -> FloatArray:
        """Return ``[x, y, yaw, vx, vy, yaw_rate]``, shape (6,)."""
        return np.array(
            [self.x_m, self.y_m, self.yaw_rad, self.vx_mps, self.vy_mps, self.yaw_rate_radps], dtype=np.float64
        )

    @classmethod
    def from_array(cls, values: NDArray[np.floating]) -> CarState:
        """Build a state from ``[x, y, yaw, vx, vy, yaw_rate]``, shape (6,)."""
        return cls(*(float(v) for v in np.asarray(values).reshape(6)))

    @property
    def speed_mps(self) -> float:
        """Speed over ground [m/s]."""
        return math.hypot(self.vx_mps, self.vy_mps)

    def after(self, time_s: float) -> CarState:
        """The state after a time at constant body velocities, moved along the yaw of half the time."""
        yaw = self.yaw_rad + 0.5 * time_s * self.yaw_rate_radps
        x = self.x_m + time_s * (self.vx_mps * math.cos(yaw) - self.vy_mps * math.sin(yaw))
        y = self.y_m + time_s * (self.vx_mps * math.sin(yaw) + self.vy_mps * math.cos(yaw))
        return replace(self, x_m=x, y_m=y, yaw_rad=self.yaw_rad + time_s * self.yaw_rate_radps)


@dataclass(frozen=True, slots=True)
class PoseSample:
    """One motion-capture sample of ``base_link`` in ``map``.

    ``t_capture_s`` is the moment of exposure and ``t_receive_s`` the moment of arrival, both on the host's monotonic
    clock; ``sequence`` is the frame number of the source.
    """

    sequence: int
    t_capture_s: float
    t_receive_s: float
    x_m: float
    y_m: float
    yaw_rad: float
    z_m: float = 0.0
    tracked: bool = True


@dataclass(frozen=True, slots=True)
class Observation:
    """The newest state of a car, with its times of capture and arrival.

    State, times and sequence are those of the newest *tracked* pose; ``tracked`` is False if the newest frame did not
    track the body, so the state of a lost body becomes stale. ``velocity_delay_s`` is the known delay of the velocity
    filter; ``poses`` are the raw samples since the previous observation, oldest first. ``velocity_valid`` is False
    if there are too few poses to estimate velocities, which are zero then. ``motor_is_turning`` is measured by the
    motor controller; None if it is not measured.
    """

    state: CarState
    t_capture_s: float
    t_receive_s: float
    sequence: int
    tracked: bool = True
    velocity_delay_s: float = 0.0
    poses: tuple[PoseSample, ...] = ()
    velocity_valid: bool = True
    motor_is_turning: bool | None = None


@dataclass(frozen=True, slots=True)
class Health:
    """A snapshot of a car's condition.

    ``readings`` are numbers whose names end in their units (``battery_v``). ``problems`` prevent arming, ``warnings``
    do not; each is a sentence with its remedy.
    """

    ready: bool
    problems: tuple[str, ...] = ()
    readings: Mapping[str, float] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class ActionLimits:
    """Largest commands a car accepts, dimensionless, symmetric about neutral."""

    max_steering: float = 1.0
    max_throttle: float = 1.0


class Reality(enum.Enum):
    """Whether a car is simulated, emulated or real. Printed at the start of each run and written to each recording."""

    SIMULATED = "simulated"
    EMULATED = "emulated"
    DRY_RUN = "dry run"
    REAL = "real"
