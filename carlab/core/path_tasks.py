"""Tasks along a closed path: follow it, or drive laps of a track within its limits."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from array_api_compat import array_namespace

from carlab.core.geofence import rectangle
from carlab.core.keep_out import Corners
from carlab.core.quantities import CarState, FloatArray
from carlab.core.task import Task
from carlab.core.track import ClosedPath, Track, oval_track, wrap_length

RUN_OFF_M = 1.5
"""Distance of the arena of laps from the centre line, in which a car can stop that leaves the track."""


def figure_eight_path(radius_m: float, points: int = 128) -> Corners:
    """A lemniscate of Gerono, (r sin t, r sin t cos t), starting at the origin."""
    t = np.linspace(0.0, 2.0 * math.pi, points, endpoint=False)
    x, y = radius_m * np.sin(t), radius_m * np.sin(t) * np.cos(t)
    return tuple((float(a), float(b)) for a, b in zip(x, y, strict=True))


START_LINE_M = 0.1
"""Largest distance beyond the start line of a car that starts at it; the first lap of another car begins later, when it
passes the line."""
DEFAULT_PATH_M = figure_eight_path(1.2)
DEFAULT_TRACK = oval_track()


@dataclass(frozen=True, slots=True)
class _ClosedPathTask(Task):
    """A task along a closed path.

    reward = progress / (speed * period) - tick_weight (offset_weight (offset / limit)^2 + action_cost |a|^2), with the
    period of 30 Hz at each rate. The episode ends further than the limit from the path, which costs 1. Success is at
    least one lap without that.
    """

    speed_mps: float = 1.0
    offset_weight: float = 0.0
    period_s: float = 1.0 / 30.0
    action_cost: float = 0.005
    history_length: int = 3
    max_ticks: int = 300
    tick_weight: float = 1.0
    cost_weight: float = 10.0

    @property
    @abstractmethod
    def path(self) -> ClosedPath:
        """The path with the largest distance from it [m] at each point."""

    @property
    def path_m(self) -> Corners:
        """Points (x, y) of the path [m]."""
        return self.path.points_m

    @property
    def arena_m(self) -> Corners:
        """The rectangle around the path with a run-off."""
        (x_low, y_low), (x_high, y_high) = np.min(self.path_m, axis=0), np.max(self.path_m, axis=0)
        return rectangle(x_low - RUN_OFF_M, x_high + RUN_OFF_M, y_low - RUN_OFF_M, y_high + RUN_OFF_M)

    def sample_start(self, rng: np.random.Generator) -> CarState:
        """Draw an initial state at rest at the path's first point, along it, within 5 cm and 0.1 rad."""
        (x0, y0), (x1, y1) = self.path_m[:2]
        dx, dy, turn = rng.uniform(-1.0, 1.0, 3) * (0.05, 0.05, 0.1)
        return CarState(x0 + float(dx), y0 + float(dy), math.atan2(y1 - y0, x1 - x0) + float(turn))

    def sample_training_start(self, rng: np.random.Generator) -> CarState:
        """Draw a state anywhere on the path, at most half the limit from it, along it within 0.3 rad, up to 1.5 m/s."""
        at = int(rng.integers(len(self.path_m)))
        (x0, y0), (x1, y1) = self.path_m[at], self.path_m[(at + 1) % len(self.path_m)]
        course = math.atan2(y1 - y0, x1 - x0)
        left = float(rng.uniform(-0.5, 0.5)) * self.path.values_m[at]
        turn, speed_mps = float(rng.uniform(-0.3, 0.3)), float(rng.uniform(0.0, 1.5))
        return CarState(x0 - left * math.sin(course), y0 + left * math.cos(course), course + turn, speed_mps)

    def at_period(self, period_s: float) -> Self:
        """The task at a control period [s], with the same duration and sum of rewards."""
        return self._at_tick_weight(period_s)

    def reward(self, features: Any, action: Any, next_features: Any) -> Any:
        """Reward (...,) of transitions."""
        xp = array_namespace(next_features)
        arc_m = self.path.project(features[..., :2]).arc_m
        after = self.path.project(next_features[..., :2], arc_m)
        progress_m = wrap_length(after.arc_m - arc_m, self.path.length_m)
        return (
            progress_m / (self.speed_mps * self.period_s)
            - self.tick_weight * self.offset_weight * (after.distance_m / after.value_m) ** 2
            - self.tick_weight * self.action_cost * xp.sum(action**2, axis=-1)
        )

    def terminated(self, next_features: Any) -> Any:
        """Whether the car has left the path."""
        at = self.path.project(next_features[..., :2])
        return at.distance_m > at.value_m

    def cost(self, next_features: Any) -> Any:
        """1 outside the limits, else 0."""
        return 0.0 * next_features[..., 0] + 1.0 * self.terminated(next_features)

    def summary(self, times_s: FloatArray, states: FloatArray) -> dict[str, float]:
        """Laps, best lap time [s] (NaN without a lap), largest distance from the path [m], mean speed [m/s], success.

        The arguments are those of ``Task.summary``.
        """
        travelled_m = self.path.travelled_m(states[:, :2])
        lap_times_s = lap_times(times_s, travelled_m, self.path.length_m)
        at = self.path.project(states[:, :2])
        is_inside = bool((at.distance_m <= at.value_m).all())
        return {
            "laps": float(travelled_m[-1] / self.path.length_m),
            "best_lap_s": min(lap_times_s, default=math.nan),
            "max_offset_m": float(at.distance_m.max()),
            "mean_speed_mps": float(np.hypot(states[:, 3], states[:, 4]).mean()),
            "success": float(is_inside and len(lap_times_s) > 0),
        }

    def outcome(self, summary: Mapping[str, float]) -> str:
        """Laps and the best lap time."""
        best_s = summary["best_lap_s"]
        return f"{summary['laps']:.2f} laps" + ("" if math.isnan(best_s) else f", best {best_s:.2f} s")


def lap_times(times_s: FloatArray, travelled_m: FloatArray, length_m: float) -> list[float]:
    """Durations of complete laps [s]; the first starts when the car first passes the start line, or starts at it.

    ``travelled_m`` (T,) are the distances along the path from the start line at the times (T,).
    """
    crossings_s = []
    for lap in range(int(travelled_m.max() // length_m) + 1):
        after = int(np.argmax(travelled_m >= lap * length_m))
        if travelled_m[after] < lap * length_m:
            break
        if after > 0:
            d, t = travelled_m[after - 1 : after + 1], times_s[after - 1 : after + 1]
            crossings_s.append(float(t[0] + (lap * length_m - d[0]) / (d[1] - d[0]) * (t[1] - t[0])))
        elif travelled_m[0] <= START_LINE_M:
            crossings_s.append(float(times_s[0]))
    return [float(d) for d in np.diff(crossings_s)]


@dataclass(frozen=True, slots=True)
class PathTask(_ClosedPathTask):
    """Follow a closed path; the squared distance from it lowers the reward."""

    points_m: Corners = DEFAULT_PATH_M
    max_offset_m: float = 0.5
    offset_weight: float = 1.0
    name: str = "path"

    @property
    def path(self) -> ClosedPath:
        """The path with the same limit everywhere."""
        return ClosedPath(self.points_m, (self.max_offset_m,) * len(self.points_m))


@dataclass(frozen=True, slots=True)
class LapTask(_ClosedPathTask):
    """Drive laps of a track as fast as possible: reward is progress; leaving the track ends the episode."""

    track: Track = DEFAULT_TRACK
    name: str = "laps"

    @property
    def path(self) -> ClosedPath:
        """The centre line with half the width."""
        return self.track.path

    @property
    def outlines_m(self) -> tuple[Corners, ...]:
        """The borders of the track."""
        return self.track.borders_m
