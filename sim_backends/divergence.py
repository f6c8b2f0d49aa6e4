"""Detection of a simulation whose integration diverges."""

from __future__ import annotations

import math
from dataclasses import astuple

from carlab.core.errors import ConfigError
from carlab.core.quantities import CarState

MAX_SPEED_MPS = 100.0
"""Speed beyond which a simulation has diverged; the fastest remote-controlled cars reach about 90 m/s."""
MAX_YAW_RATE_RADPS = 200.0
"""32 turns a second; spinning model cars reach about 30 rad/s."""


def diverged(car: str) -> ConfigError:
    """The error for a car whose simulation diverged."""
    return ConfigError(
        f"The simulation of car '{car}' diverged: its motion changes faster than the integration step resolves. Check "
        "mass, yaw_inertia, damping and the tyres' B in the car file (SI units)."
    )


def is_physical(state: CarState) -> bool:
    """Whether a state is finite and within the limits."""
    return (
        all(map(math.isfinite, astuple(state)))
        and state.speed_mps <= MAX_SPEED_MPS
        and abs(state.yaw_rate_radps) <= MAX_YAW_RATE_RADPS
    )
