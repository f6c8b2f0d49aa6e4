"""Detection of a simulation whose integration diverges."""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass

from carlab.core.errors import ConfigError
from carlab.core.quantities import CarState


@dataclass(frozen=True, slots=True)
class DivergenceLimits:
    """Limits beyond which a simulated state is not physical.

    Attributes:
        max_speed_mps: 100 m/s; the fastest remote-controlled cars reach about 90 m/s.
        max_yaw_rate_radps: 200 rad/s, or 32 turns a second; spinning model cars reach about 30 rad/s.
    """

    max_speed_mps: float = 100.0
    max_yaw_rate_radps: float = 200.0


def diverged(car: str) -> ConfigError:
    """The error for a car whose simulation diverged."""
    return ConfigError(
        f"The simulation of car '{car}' diverged: its motion changes faster than the integration step resolves. Check "
        "mass, yaw_inertia, damping and the tyres' B in the car file (SI units)."
    )


def is_physical(state: CarState, limits: DivergenceLimits) -> bool:
    """Whether a state is finite and within the limits."""
    return (
        all(map(math.isfinite, astuple(state)))
        and state.speed_mps <= limits.max_speed_mps
        and abs(state.yaw_rate_radps) <= limits.max_yaw_rate_radps
    )
