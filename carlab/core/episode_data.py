"""One episode as arrays, for replay, learning and diagnosis, independent of the file format."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from carlab.core.errors import DataError
from carlab.core.quantities import FloatArray


@dataclass(frozen=True, slots=True, repr=False)
class EpisodeData:
    """An episode of T commands. Row k of ``sent`` was sent at ``times_s[k]`` and held until ``times_s[k + 1]``.

    Attributes:
        times_s: time of each observation on the recording's clock [s] (T + 1,).
        states: x, y [m], yaw [rad] of base_link in map; vx, vy [m/s], yaw rate [rad/s] in the body frame (T + 1, 6).
        requested: steering, throttle requested by the policy (T, 2); those of ``sent`` if it is unknown.
        sent: steering, throttle sent by the safety gate (T, 2), in [-1, 1].
        rewards: reward of each transition (T,); NaN if the recording has none.
        poses: raw motion capture: capture time [s], x, y [m], yaw [rad] (P, 4); P may be 0.
        metadata: texts: car, reality, policy, task, seed, end_reason, end_detail, units ...
        extra: further columns of a file by name, each (T + 1,).

    Raises:
        DataError: an array has another shape, or is no NumPy array.
    """

    times_s: FloatArray
    states: FloatArray
    requested: FloatArray
    sent: FloatArray
    rewards: FloatArray
    poses: FloatArray = field(default_factory=lambda: np.zeros((0, 4)))
    metadata: Mapping[str, str] = field(default_factory=dict)
    extra: Mapping[str, FloatArray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("times_s", "states", "requested", "sent", "rewards"):
            if not isinstance(given := getattr(self, name), np.ndarray):
                raise DataError(f"{name} has the type {type(given).__name__}; give a NumPy array.")
        ticks = self.sent.shape[0]
        shapes = {
            "times_s": (self.times_s.shape, (ticks + 1,)),
            "states": (self.states.shape, (ticks + 1, 6)),
            "requested": (self.requested.shape, (ticks, 2)),
            "sent": (self.sent.shape, (ticks, 2)),
            "rewards": (self.rewards.shape, (ticks,)),
        }
        for name, (found, wanted) in shapes.items():
            if found != wanted:
                raise DataError(f"{name} has shape {found}; {ticks} commands need {wanted}.")

    def __repr__(self) -> str:
        """Number of commands and duration; the arrays would fill pages."""
        return f"<EpisodeData: {self.ticks} commands in {self.times_s[-1] - self.times_s[0]:.1f} s>"

    @property
    def has_velocity_columns(self) -> bool:
        """Whether velocities were recorded, rather than differentiated from the poses of the rows."""
        return "column" in self.metadata.get("velocity_source", "column")

    @property
    def ticks(self) -> int:
        """Number of commands T."""
        return int(self.sent.shape[0])

    @property
    def period_s(self) -> float:
        """Median time between observations [s]; NaN for fewer than two."""
        return float(np.median(np.diff(self.times_s))) if self.ticks else float("nan")
