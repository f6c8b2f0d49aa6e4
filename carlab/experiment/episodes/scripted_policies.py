"""Policies without learning: manoeuvres, replay of recorded actions, neutral, and a feedback parking policy."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from carlab.core.angles import wrap
from carlab.core.manoeuvres import Manoeuvre
from carlab.core.policy import PolicyInput
from carlab.core.quantities import NEUTRAL, Action, FloatArray
from sim_backends.car_parameters import SimulatorConfig


class StatelessPolicy:
    """A policy without a state."""

    def reset(self) -> None:
        """Do nothing."""


class NeutralPolicy(StatelessPolicy):
    """Neutral at every tick."""

    name = "neutral"

    def act(self, view: PolicyInput) -> Action | None:
        """Neutral steering and throttle."""
        return NEUTRAL


class ManoeuvrePolicy(StatelessPolicy):
    """A manoeuvre as a function of time."""

    def __init__(self, manoeuvre: Manoeuvre) -> None:
        self.name = manoeuvre.name
        self._manoeuvre = manoeuvre

    def act(self, view: PolicyInput) -> Action | None:
        """Action of the manoeuvre at this time."""
        return self._manoeuvre.command(view.elapsed_s + 1e-9)


class ReplayPolicy(StatelessPolicy):
    """Replays recorded actions (T, 2) at their times [s] (T,) since the first, each held until the next."""

    name = "replay"

    def __init__(self, times_s: FloatArray, actions: FloatArray) -> None:
        self._times_s = np.asarray(times_s, dtype=np.float64) - times_s[0]
        self._actions = actions
        self._end_s = float(self._times_s[-1] + (np.median(np.diff(self._times_s)) if len(times_s) > 1 else 0.0))

    def act(self, view: PolicyInput) -> Action | None:
        """The action held at this time, with a tolerance of 1 ms for an early tick."""
        elapsed_s = view.elapsed_s + 1e-3
        if elapsed_s >= self._end_s:
            return None
        return Action.from_array(self._actions[np.searchsorted(self._times_s, elapsed_s, side="right") - 1])


@dataclass(slots=True)
class ReverseParkingPolicy(StatelessPolicy):
    """Reverse parking by feedback: a baseline for learned policies.

    The car drives in reverse. A vector field determines its course (Nelson et al., "Vector field path following for
    miniature air vehicles", IEEE Transactions on Robotics 2007): perpendicular to the line through the goal far from
    it, along the line on it. The speed limit follows from braking at ``braking_mps2``; a proportional throttle with
    feed-forward controls the speed. The state is predicted over the reaction time first.
    """

    goal: tuple[float, float, float] = (0.0, 0.0, 0.0)
    wheelbase_m: float = 0.30
    max_angle_rad: float = 0.6
    drive_gain_n: float = 8.2
    damping_nspm: float = 1.56
    mass_kg: float = 1.65
    reaction_s: float = 0.12
    cruise_mps: float = 1.2
    braking_mps2: float = 1.7
    approach_rad: float = 1.7
    line_width_m: float = 0.8
    turn_gain_per_m: float = 3.0
    swing_s: float = 0.13
    left_weight: float = 0.72
    name: str = "reverse_parking"

    @classmethod
    def for_car(cls, simulator: SimulatorConfig) -> ReverseParkingPolicy:
        """Create the policy with the parameters of a simulator."""
        p = simulator.parameters
        return cls(
            wheelbase_m=p.wheelbase_m,
            max_angle_rad=p.max_angle_rad,
            drive_gain_n=p.drive_gain_n,
            damping_nspm=p.damping_nspm,
            mass_kg=p.mass_kg,
            reaction_s=simulator.command_delay_s + 0.04,
        )

    def act(self, view: PolicyInput) -> Action | None:
        """Steering and throttle of this tick."""
        state = view.observation.state.after(self.reaction_s)
        # Distances along the line, in reverse direction of the goal's heading, and to its left.
        line = self.goal[2] + math.pi
        dx, dy = self.goal[0] - state.x_m, self.goal[1] - state.y_m
        ahead = dx * math.cos(line) + dy * math.sin(line)
        left = dx * math.sin(line) - dy * math.cos(line)
        desired_course = -self.approach_rad * (2.0 / math.pi) * math.atan(left / self.line_width_m)
        # The yaw rate persists because of tyre lag; the course is predicted over ``swing_s``.
        course = wrap(state.yaw_rad + self.swing_s * state.yaw_rate_radps + math.pi - line)
        course_error = wrap(desired_course - course)
        limit = math.tan(self.max_angle_rad) / self.wheelbase_m
        curvature = min(max(self.turn_gain_per_m * course_error, -limit), limit)
        # In reverse, a left turn of the course needs front wheels to the right.
        steering = -math.atan(self.wheelbase_m * curvature) / self.max_angle_rad
        distance = ahead + self.left_weight * abs(left)
        # Near the goal, speed proportional to the distance replaces the square-root law of constant braking.
        max_speed = min(math.sqrt(2.0 * self.braking_mps2 * abs(distance)), 2.5 * abs(distance))
        speed = -math.copysign(min(self.cruise_mps, max_speed), distance) if abs(distance) > 0.02 else 0.0
        force = self.mass_kg * 6.0 * (speed - state.vx_mps) + self.damping_nspm * speed
        return Action(min(max(steering, -1.0), 1.0), min(max(force / self.drive_gain_n, -1.0), 1.0))
