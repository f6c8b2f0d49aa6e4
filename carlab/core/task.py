"""Tasks: start, goal, reward and termination, shared by real, simulated and learned worlds.

Rewards and terminations are pure functions of features (see ``carlab.core.observation``) in the array library of their
inputs, NumPy or torch, batched over leading axes and differentiable where their inputs are.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from array_api_compat import array_namespace

from carlab.core.angles import wrap
from carlab.core.geofence import rectangle
from carlab.core.quantities import CarState

Corners = tuple[tuple[float, float], ...]

# The arena of the paper's laboratory: lasgroup/simulation_transfer, sim_transfer/hardware/car_env.py.
PAPER_ARENA_M: Corners = rectangle(-1.4, 2.8, -2.6, 1.5)


@runtime_checkable
class Task(Protocol):
    """Interface of a task."""

    @property
    def name(self) -> str:
        """Short name in the command line and in recordings."""

    @property
    def history_length(self) -> int:
        """H, the number of past actions in the features."""

    @property
    def max_ticks(self) -> int:
        """Number of ticks of an episode."""

    @property
    def arena_m(self) -> Corners:
        """Corners of the task's area [m]."""

    @property
    def goal(self) -> tuple[float, float, float] | None:
        """Goal pose (x [m], y [m], yaw [rad]); None without a goal."""

    @property
    def path_m(self) -> Corners:
        """Reference path [m]; empty without a path."""

    def sample_start(self, rng: np.random.Generator) -> CarState:
        """Draw an initial state."""

    def reward(self, features: Any, action: Any, next_features: Any) -> Any:
        """Reward (...,) of transitions; features (..., F), action (..., 2)."""

    def terminated(self, next_features: Any) -> Any:
        """Whether the task terminates, booleans (...,)."""

    def summary(self, final: CarState) -> dict[str, float]:
        """Figures of the final state, by name with unit."""


def long_tail_tolerance(distance: Any, bound: float, margin: float, value_at_margin: float = 0.1) -> Any:
    """1 up to ``bound``, then 1 / (1 + scale ((d - bound) / margin)^2), which is ``value_at_margin`` at the margin.

    The 'long_tail' sigmoid of dm_control.utils.rewards (Tassa et al., arXiv 1801.00690).
    """
    xp = array_namespace(distance)
    beyond = xp.clip(distance - bound, 0.0, None) / margin
    return 1.0 / ((1.0 / value_at_margin - 1.0) * beyond**2 + 1.0)


@dataclass(frozen=True, slots=True)
class ParkingTask:
    """Reverse parking of Rothfuss et al., arXiv 2403.16644: about 1.8 m away, turned by 180 degrees, 100 ticks.

    Reward: tolerance of d = sqrt(|position error|^2 + yaw error^2) [m and rad mixed, as the paper does] with bound 0.1
    and margin 2, minus 0.005 |a|^2. Start: pose (1.42, -1.04, pi) +- (0.1 m, 0.1 m, 0.1 pi), velocities with standard
    deviations (0.005, 0.005 m/s, 0.02 rad/s). The car counts as parked within 0.2 m and 0.35 rad, slower than 0.3 m/s.
    """

    goal_pose: tuple[float, float, float] = (0.0, 0.0, 0.0)
    start_pose: tuple[float, float, float] = (1.42, -1.04, math.pi)
    start_spread: tuple[float, float, float] = (0.1, 0.1, 0.1 * math.pi)
    start_velocity_std: tuple[float, float, float] = (0.005, 0.005, 0.02)
    bound: float = 0.1
    margin: float = 2.0
    action_cost: float = 0.005
    parked_position_m: float = 0.2
    parked_yaw_rad: float = 0.35
    parked_speed_mps: float = 0.3
    stop_when_parked: bool = False
    history_length: int = 3
    max_ticks: int = 100
    arena_m: Corners = PAPER_ARENA_M
    name: str = "parking"

    @property
    def goal(self) -> tuple[float, float, float] | None:
        """Goal pose (x [m], y [m], yaw [rad])."""
        return self.goal_pose

    @property
    def path_m(self) -> Corners:
        """No reference path."""
        return ()

    def sample_start(self, rng: np.random.Generator) -> CarState:
        """Draw a start state; position, yaw and velocities are independent."""
        pose = np.asarray(self.start_pose) + rng.uniform(-1.0, 1.0, 3) * np.asarray(self.start_spread)
        velocity = rng.normal(0.0, self.start_velocity_std)
        return CarState(float(pose[0]), float(pose[1]), float(wrap(pose[2])), *(float(v) for v in velocity))

    def errors(self, features: Any) -> tuple[Any, Any]:
        """Distance to the goal [m] and wrapped yaw error [rad], each (...,)."""
        xp = array_namespace(features)
        dx, dy = features[..., 0] - self.goal_pose[0], features[..., 1] - self.goal_pose[1]
        yaw = xp.atan2(features[..., 2], features[..., 3])
        return xp.sqrt(dx * dx + dy * dy + 1e-12), wrap(yaw - self.goal_pose[2])

    def reward(self, features: Any, action: Any, next_features: Any) -> Any:
        """Reward (...,) of arriving at ``next_features`` (..., F) by ``action`` (..., 2)."""
        xp = array_namespace(next_features)
        distance, yaw_error = self.errors(next_features)
        total = xp.sqrt(distance * distance + yaw_error * yaw_error + 1e-12)
        return long_tail_tolerance(total, self.bound, self.margin) - self.action_cost * xp.sum(action**2, axis=-1)

    def parked(self, features: Any) -> Any:
        """Whether the car is parked, booleans (...,)."""
        xp = array_namespace(features)
        distance, yaw_error = self.errors(features)
        speed = xp.sqrt(features[..., 4] ** 2 + features[..., 5] ** 2)
        return (
            (distance < self.parked_position_m)
            & (xp.abs(yaw_error) < self.parked_yaw_rad)
            & (speed < self.parked_speed_mps)
        )

    def terminated(self, next_features: Any) -> Any:
        """Terminate when parked, only if ``stop_when_parked``; the paper drives all ticks."""
        parked = self.parked(next_features)
        return parked if self.stop_when_parked else parked & False

    def summary(self, final: CarState) -> dict[str, float]:
        """Final distance, yaw error, speed, and 1.0 for parked."""
        distance = math.hypot(final.x_m - self.goal_pose[0], final.y_m - self.goal_pose[1])
        yaw_error = abs(float(wrap(final.yaw_rad - self.goal_pose[2])))
        parked = (
            distance < self.parked_position_m
            and yaw_error < self.parked_yaw_rad
            and final.speed_mps < self.parked_speed_mps
        )
        return {
            "distance_m": distance,
            "yaw_error_rad": yaw_error,
            "speed_mps": final.speed_mps,
            "parked": float(parked),
        }


def figure_eight_path(radius_m: float, points: int = 128) -> Corners:
    """A lemniscate of Gerono, (r sin t, r sin t cos t), starting at the origin."""
    t = np.linspace(0.0, 2.0 * math.pi, points, endpoint=False)
    x, y = radius_m * np.sin(t), radius_m * np.sin(t) * np.cos(t)
    return tuple((float(a), float(b)) for a, b in zip(x, y, strict=True))


PATH_ARENA_M: Corners = rectangle(-2.2, 2.2, -2.2, 2.2)
DEFAULT_PATH_M: Corners = figure_eight_path(1.2)


@dataclass(frozen=True, slots=True)
class PathTask:
    """Follow a closed path at a speed: reward is progress along the path less the squared distance from it.

    reward = progress / (speed * period) - (offset / width)^2 - action_cost |a|^2; ends further than ``width`` from it.
    """

    path_m: Corners = DEFAULT_PATH_M
    speed_mps: float = 1.0
    width_m: float = 0.5
    period_s: float = 1.0 / 30.0
    action_cost: float = 0.005
    history_length: int = 3
    max_ticks: int = 300
    arena_m: Corners = PATH_ARENA_M
    name: str = "path"

    @property
    def goal(self) -> tuple[float, float, float] | None:
        """A path has no goal pose."""
        return None

    def sample_start(self, rng: np.random.Generator) -> CarState:
        """Draw an initial state at rest at the path's first point, along it, within 5 cm and 0.1 rad."""
        (x0, y0), (x1, y1) = self.path_m[:2]
        dx, dy, turn = rng.uniform(-1.0, 1.0, 3) * (0.05, 0.05, 0.1)
        return CarState(x0 + float(dx), y0 + float(dy), math.atan2(y1 - y0, x1 - x0) + float(turn))

    def project(self, features: Any, near: Any | None = None) -> tuple[Any, Any]:
        """Arc length [m] and distance [m] of the nearest point of the path, each (...,).

        ``near`` (...,) restricts the search to within ``width_m`` of arc length, so that crossings are unambiguous.
        """
        xp = array_namespace(features)
        corners = np.asarray(self.path_m)
        edges = np.roll(corners, -1, axis=0) - corners
        lengths = np.hypot(*edges.T)
        starts = np.concatenate([[0.0], np.cumsum(lengths)[:-1]])

        def constant(values: Any) -> Any:
            made = xp.asarray(values, dtype=features.dtype)
            return made.to(features.device) if hasattr(features, "is_cuda") else made

        first, edge, length, start = (constant(v) for v in (corners, edges / lengths[:, None], lengths, starts))
        offset = features[..., None, :2] - first
        along = xp.clip(xp.sum(offset * edge, axis=-1), 0.0 * length, length)
        rest = offset - along[..., None] * edge
        distance = xp.sqrt(xp.sum(rest * rest, axis=-1) + 1e-12)
        arc = start + along
        cost = distance
        if near is not None:
            apart = xp.abs(wrap_length(arc - near[..., None], float(lengths.sum())))
            cost = distance + 1e3 * xp.astype(apart > self.width_m, features.dtype)
        index = xp.argmin(cost, axis=-1)[..., None]
        return (
            xp.take_along_axis(arc, index, axis=-1)[..., 0],
            xp.take_along_axis(distance, index, axis=-1)[..., 0],
        )

    @property
    def length_m(self) -> float:
        """Length of the closed path [m]."""
        corners = np.asarray(self.path_m)
        return float(np.hypot(*(np.roll(corners, -1, axis=0) - corners).T).sum())

    def reward(self, features: Any, action: Any, next_features: Any) -> Any:
        """Reward (...,) of transitions."""
        xp = array_namespace(next_features)
        arc, _ = self.project(features)
        next_arc, offset = self.project(next_features, near=arc)
        progress = wrap_length(next_arc - arc, self.length_m)
        return (
            progress / (self.speed_mps * self.period_s)
            - (offset / self.width_m) ** 2
            - self.action_cost * xp.sum(action**2, axis=-1)
        )

    def terminated(self, next_features: Any) -> Any:
        """Whether the car is further from the path than ``width_m``."""
        return self.project(next_features)[1] > self.width_m

    def summary(self, final: CarState) -> dict[str, float]:
        """Final distance from the path and speed."""
        features = np.array([final.x_m, final.y_m])
        return {"offset_m": float(self.project(features)[1]), "speed_mps": final.speed_mps}


@dataclass(frozen=True, slots=True)
class RecordedTask:
    """A task with an initial state only, for replaying recorded actions. Every reward is zero."""

    start: CarState
    max_ticks: int
    history_length: int = 3
    arena_m: Corners = ()
    name: str = "recorded"

    @property
    def goal(self) -> tuple[float, float, float] | None:
        """None."""
        return None

    @property
    def path_m(self) -> Corners:
        """None."""
        return ()

    def sample_start(self, rng: np.random.Generator) -> CarState:
        """The recorded initial state."""
        return self.start

    def reward(self, features: Any, action: Any, next_features: Any) -> Any:
        """Zero."""
        return 0.0 * next_features[..., 0]

    def terminated(self, next_features: Any) -> Any:
        """Never."""
        return (next_features[..., 0] * 0.0) > 1.0

    def summary(self, final: CarState) -> dict[str, float]:
        """Speed at the end."""
        return {"speed_mps": final.speed_mps}


def wrap_length(length_m: Any, total_m: float) -> Any:
    """Signed arc length on a closed path, in [-total / 2, total / 2)."""
    return (length_m + 0.5 * total_m) % total_m - 0.5 * total_m


TASKS: dict[str, type[ParkingTask] | type[PathTask]] = {"parking": ParkingTask, "path": PathTask}
