"""Tasks: start, goal, reward, end and success, shared by real, emulated, simulated and learned worlds.

Rewards, costs, ends and successes are pure functions of features (see ``carlab.core.observation``) in the array library
of their inputs, NumPy or torch, batched over leading axes and differentiable where their inputs are.
"""

from __future__ import annotations

import copy
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from array_api_compat import array_namespace

from carlab.core.angles import wrap
from carlab.core.errors import ConfigError
from carlab.core.geofence import rectangle
from carlab.core.keep_out import Corners, Disc, KeepOut
from carlab.core.observation import ACTION_SIZE, encode
from carlab.core.quantities import CarState, FloatArray

# The arena of the paper's laboratory: lasgroup/simulation_transfer, sim_transfer/hardware/car_env.py.
PAPER_ARENA_M: Corners = rectangle(-1.4, 2.8, -2.6, 1.5)
START_MARGIN_M = 0.4
"""Smallest distance of a random start from the edge of the arena."""
MAX_START_DRAWS = 1000
"""Number of random starts in keep-out shapes after which the shapes count as covering the arena."""
REFERENCE_RATE_HZ = 30.0
"""Control rate at which carlab's tasks state rewards and costs of a tick and the number of ticks."""
TICK_WEIGHT_DIGITS = 4
"""Decimals of the duration of a tick in reference ticks, so that 0.0333333333 s is one."""


class Task(ABC):
    """Base of all tasks. A subclass defines ``sample_start`` and ``reward``, and overrides what differs.

    Attributes:
        name: short name in recordings.
        history_length: H, the number of past actions in the features; a run sets it.
        max_ticks: number of ticks of an episode.
        cost_weight: reward that one unit of constraint cost takes away in the training of a policy.
        tick_weight: factor on the rewards and costs of a tick; ``at_period`` sets it.
    """

    name: str = "task"
    history_length: int = 3
    max_ticks: int = 100
    cost_weight: float = 1.0
    tick_weight: float = 1.0

    @property
    def arena_m(self) -> Corners:
        """Corners of the task's area [m]; empty without an arena."""
        return ()

    @property
    def goal(self) -> tuple[float, float, float] | None:
        """Goal pose (x [m], y [m], yaw [rad]); None without a goal."""
        return None

    @property
    def path_m(self) -> Corners:
        """Reference path [m]; empty without a path."""
        return ()

    @property
    def keep_out(self) -> tuple[KeepOut, ...]:
        """Areas that the car must not enter."""
        return ()

    @property
    def outlines_m(self) -> tuple[Corners, ...]:
        """Closed lines to draw [m]: by default the outlines of ``keep_out``."""
        return tuple(shape.outline_m for shape in self.keep_out)

    @property
    def has_constraint(self) -> bool:
        """Whether the task has a constraint cost."""
        return bool(self.keep_out) or type(self).cost is not Task.cost

    @abstractmethod
    def sample_start(self, rng: np.random.Generator) -> CarState:
        """Draw an initial state."""

    def sample_training_start(self, rng: np.random.Generator) -> CarState:
        """Draw an initial state for the training in the learned car; by default that of ``sample_start``."""
        return self.sample_start(rng)

    @abstractmethod
    def reward(self, features: Any, action: Any, next_features: Any) -> Any:
        """Reward (...,) of transitions; features (..., F), action (..., 2)."""

    def terminated(self, next_features: Any) -> Any:
        """Whether the task ends the episode, booleans (...,); by default never."""
        return next_features[..., 0] * 0.0 > 1.0

    def success(self, features: Any) -> Any:
        """Whether the task is fulfilled in a state, booleans (...,); by default never."""
        return features[..., 0] * 0.0 > 1.0

    def cost(self, next_features: Any) -> Any:
        """Constraint cost (...,) of a tick, not below zero; by default the number of ``keep_out`` shapes entered."""
        cost = 0.0 * next_features[..., 0]
        for shape in self.keep_out:
            cost = cost + 1.0 * shape.contains(next_features[..., :2])
        return cost

    def summary(self, times_s: FloatArray, states: FloatArray) -> dict[str, float]:
        """Figures of an episode, by name with unit; ``success`` is 1.0 or 0.0.

        Args:
            times_s: times of the observations (T + 1,).
            states: x, y [m], yaw [rad], vx, vy [m/s], yaw rate [rad/s] (T + 1, 6).
        """
        features = encode(states[-1], np.zeros((self.history_length, ACTION_SIZE)))
        return {"success": float(self.success(features))}

    def outcome(self, summary: Mapping[str, float]) -> str:
        """The result of an episode in a few words, for the console."""
        return "success" if summary["success"] else "no success"

    def at_period(self, period_s: float) -> Self:
        """The task at a control period [s]; by default the task itself, whose rewards and ticks are of any period.

        carlab's tasks have episodes of the same duration, and rewards and costs of the same sum, at each period.
        """
        return self

    def resized(self, history_length: int, max_ticks: int | None = None) -> Self:
        """Copy with another number of past actions, and of ticks if given.

        Raises:
            ConfigError: the task does not let a run set them, for example because one is a property.
        """
        ticks = {} if max_ticks is None else {"max_ticks": max_ticks}
        return self._with_attributes({"history_length": history_length, **ticks})

    def _at_tick_weight(self, period_s: float) -> Self:
        """Copy whose ``tick_weight`` is the duration of a tick in reference ticks, with the same duration."""
        weight = reference_ticks(period_s)
        if weight == 1.0:
            return self
        return self._with_attributes({"tick_weight": weight, "max_ticks": max(round(self.max_ticks / weight), 1)})

    def _with_attributes(self, values: Mapping[str, float]) -> Self:
        """Copy with other attributes. Raises ConfigError if one cannot be set."""
        changed = copy.copy(self)
        for name, value in values.items():
            try:
                object.__setattr__(changed, name, value)
            except AttributeError as error:
                raise ConfigError(
                    f"A run cannot set {name} of the task {self.name} to {value} ({error}); make it an attribute of "
                    "the class."
                ) from error
        return changed


def reference_ticks(period_s: float) -> float:
    """Duration of a control period [s] in ticks of ``REFERENCE_RATE_HZ``."""
    return round(period_s * REFERENCE_RATE_HZ, TICK_WEIGHT_DIGITS)


def long_tail_tolerance(distance: Any, bound: float, margin: float, value_at_margin: float = 0.1) -> Any:
    """1 up to ``bound``, then 1 / (1 + scale ((d - bound) / margin)^2), which is ``value_at_margin`` at the margin.

    The 'long_tail' sigmoid of dm_control.utils.rewards (Tassa et al., arXiv 1801.00690).
    """
    xp = array_namespace(distance)
    beyond = xp.clip(distance - bound, 0.0, None) / margin
    return 1.0 / ((1.0 / value_at_margin - 1.0) * beyond**2 + 1.0)


@dataclass(frozen=True, slots=True)
class ParkingTask(Task):
    """Reverse parking of Rothfuss et al., arXiv 2403.16644: about 1.8 m away, turned by 180 degrees, 100 ticks.

    Reward at 30 Hz: tolerance of d = sqrt(|position error|^2 + yaw error^2) [m and rad mixed, as the paper does] with
    bound 0.1 and margin 2, minus 0.005 |a|^2; ``tick_weight`` multiplies it at other rates. Start: pose (1.42, -1.04,
    pi) +- (0.1 m, 0.1 m, 0.1 pi), velocities with standard deviations (0.005, 0.005 m/s, 0.02 rad/s). The car counts as
    parked within 0.2 m and 0.35 rad, slower than 0.3 m/s.
    """

    goal: tuple[float, float, float] = (0.0, 0.0, 0.0)
    start_pose: tuple[float, float, float] = (1.42, -1.04, math.pi)
    start_spread: tuple[float, float, float] = (0.1, 0.1, 0.1 * math.pi)
    start_velocity_std: tuple[float, float, float] = (0.005, 0.005, 0.02)
    bound: float = 0.1
    margin: float = 2.0
    action_cost: float = 0.005
    parked_position_m: float = 0.2
    parked_yaw_rad: float = 0.35
    parked_speed_mps: float = 0.3
    history_length: int = 3
    max_ticks: int = 100
    tick_weight: float = 1.0
    arena_m: Corners = PAPER_ARENA_M
    name: str = "parking"

    def sample_start(self, rng: np.random.Generator) -> CarState:
        """Draw a start state; position, yaw and velocities are independent."""
        pose = np.asarray(self.start_pose) + rng.uniform(-1.0, 1.0, 3) * np.asarray(self.start_spread)
        velocity = rng.normal(0.0, self.start_velocity_std)
        return CarState(float(pose[0]), float(pose[1]), float(wrap(pose[2])), *(float(v) for v in velocity))

    def at_period(self, period_s: float) -> Self:
        """The task at a control period [s], with the same duration and sum of rewards."""
        return self._at_tick_weight(period_s)

    def errors(self, features: Any) -> tuple[Any, Any]:
        """Distance to the goal [m] and wrapped yaw error [rad], each (...,)."""
        xp = array_namespace(features)
        dx, dy = features[..., 0] - self.goal[0], features[..., 1] - self.goal[1]
        yaw = xp.atan2(features[..., 2], features[..., 3])
        return xp.sqrt(dx * dx + dy * dy + 1e-12), wrap(yaw - self.goal[2])

    def reward(self, features: Any, action: Any, next_features: Any) -> Any:
        """Reward (...,) of arriving at ``next_features`` (..., F) by ``action`` (..., 2)."""
        xp = array_namespace(next_features)
        distance, yaw_error = self.errors(next_features)
        total = xp.sqrt(distance * distance + yaw_error * yaw_error + 1e-12)
        tolerance = long_tail_tolerance(total, self.bound, self.margin)
        return self.tick_weight * (tolerance - self.action_cost * xp.sum(action**2, axis=-1))

    def success(self, features: Any) -> Any:
        """Whether the car is parked, booleans (...,)."""
        xp = array_namespace(features)
        distance, yaw_error = self.errors(features)
        speed = xp.sqrt(features[..., 4] ** 2 + features[..., 5] ** 2)
        return (
            (distance < self.parked_position_m)
            & (xp.abs(yaw_error) < self.parked_yaw_rad)
            & (speed < self.parked_speed_mps)
        )

    def summary(self, times_s: FloatArray, states: FloatArray) -> dict[str, float]:
        """Final distance [m], yaw error [rad] and speed [m/s], and 1.0 for parked; arguments as of ``Task``."""
        final = CarState.from_array(states[-1])
        return {
            "distance_m": math.hypot(final.x_m - self.goal[0], final.y_m - self.goal[1]),
            "yaw_error_rad": abs(float(wrap(final.yaw_rad - self.goal[2]))),
            "speed_mps": final.speed_mps,
            "success": float(self.success(encode(states[-1], np.zeros((self.history_length, ACTION_SIZE))))),
        }

    def outcome(self, summary: Mapping[str, float]) -> str:
        """``parked``, or the distance from the goal."""
        return "parked" if summary["success"] else f"{summary['distance_m']:.2f} m from the goal"


@dataclass(frozen=True, slots=True)
class ObstacleParkingTask(ParkingTask):
    """Reverse parking behind four discs, from the authors' safe-learning work (github lasgroup/safe-learning).

    The cost of a tick at 30 Hz is the car's kinetic energy [J] while its reference point is inside a disc
    (ss2r/benchmark_suites/rccar/rccar.py there; discs of ss2r/configs/environment/rccar.yaml). Differences: the discs
    do not push the car back, reward and start are those of ``ParkingTask``, and an episode has 200 ticks, not 250.
    """

    obstacles: tuple[KeepOut, ...] = tuple(Disc(0.75, y, 0.25) for y in (-0.55, -0.15, 0.25, 0.65))
    mass_kg: float = 1.65
    max_ticks: int = 200
    cost_weight: float = 5.0
    name: str = "obstacles"

    @property
    def keep_out(self) -> tuple[KeepOut, ...]:
        """The discs."""
        return self.obstacles

    def sample_training_start(self, rng: np.random.Generator) -> CarState:
        """Draw a state at rest anywhere in the arena outside the discs, with any yaw, as in the authors' simulation.

        Raises:
            ConfigError: the discs cover the arena.
        """
        low, high = np.min(self.arena_m, axis=0), np.max(self.arena_m, axis=0)
        for _ in range(MAX_START_DRAWS):
            x, y = rng.uniform(low + START_MARGIN_M, high - START_MARGIN_M)
            if not any(bool(shape.contains(np.array([x, y]))) for shape in self.keep_out):
                return CarState(float(x), float(y), float(rng.uniform(-math.pi, math.pi)))
        raise ConfigError("the keep-out shapes cover the arena; make them smaller")

    def cost(self, next_features: Any) -> Any:
        """Kinetic energy [J] inside a disc, times ``tick_weight``; zero outside."""
        energy_j = 0.5 * self.mass_kg * (next_features[..., 4] ** 2 + next_features[..., 5] ** 2)
        return self.tick_weight * energy_j * Task.cost(self, next_features)


@dataclass(frozen=True, slots=True)
class RecordedTask(Task):
    """A task with an initial state only, for replaying recorded actions. Every reward is zero."""

    start: CarState
    max_ticks: int
    history_length: int = 3
    arena_m: Corners = ()
    name: str = "recorded"

    def sample_start(self, rng: np.random.Generator) -> CarState:
        """The recorded initial state."""
        return self.start

    def reward(self, features: Any, action: Any, next_features: Any) -> Any:
        """Zero for every step."""
        return 0.0 * next_features[..., 0]

    def summary(self, times_s: FloatArray, states: FloatArray) -> dict[str, float]:
        """Speed [m/s] at the end; arguments as of ``Task``."""
        return {"speed_mps": CarState.from_array(states[-1]).speed_mps}

    def outcome(self, summary: Mapping[str, float]) -> str:
        """Nothing: the task has no success."""
        return ""
