"""Policies that need no learning: manoeuvres, recorded actions, standing still, and a feedback parking policy."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from carlab.core.angles import wrap
from carlab.core.manoeuvres import Manoeuvre
from carlab.core.policy import PolicyInput
from carlab.core.quantities import NEUTRAL, Action, FloatArray
from sim_backends.car_parameters import SimulatorConfig


class NeutralPolicy:
    """Does nothing."""

    name = "neutral"

    def reset(self) -> None:
        """Nothing to forget."""

    def act(self, view: PolicyInput) -> Action | None:
        """Neutral."""
        return NEUTRAL


class ManoeuvrePolicy:
    """Plays a manoeuvre by the clock."""

    def __init__(self, manoeuvre: Manoeuvre) -> None:
        self.name = manoeuvre.name
        self._manoeuvre = manoeuvre

    def reset(self) -> None:
        """A manoeuvre depends on time alone."""

    def act(self, view: PolicyInput) -> Action | None:
        """The manoeuvre's action at this time."""
        return self._manoeuvre.command(view.elapsed_s + 1e-9)


class ReplayPolicy:
    """Sends recorded actions (T, 2) again, each at its own time [s] (T,) since the first, held until the next."""

    name = "replay"

    def __init__(self, times_s: FloatArray, actions: FloatArray) -> None:
        self._times_s = np.asarray(times_s, dtype=np.float64) - times_s[0]
        self._actions = actions
        self._end_s = float(self._times_s[-1] + (np.median(np.diff(self._times_s)) if len(times_s) > 1 else 0.0))

    def reset(self) -> None:
        """Replay depends on time alone."""

    def act(self, view: PolicyInput) -> Action | None:
        """The action held at this time; a tick that wakes a hair early counts as on time."""
        elapsed_s = view.elapsed_s + 1e-3
        if elapsed_s >= self._end_s:
            return None
        return Action.from_array(self._actions[np.searchsorted(self._times_s, elapsed_s, side="right") - 1])


@dataclass(slots=True)
class ReverseParkingPolicy:
    """Backs into a pose by feedback; a baseline to compare a learned policy with.

    The reversed car drives along its tail. Its course is drawn onto the line through the goal by a vector field
    (Nelson et al., "Vector field path following for miniature air vehicles", IEEE Transactions on Robotics 2007): far
    from the line across it, on the line along it. Speed follows what braking at ``braking_mps2`` allows, held by a
    proportional throttle with feed-forward. State is predicted over the reaction time before anything is decided.
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
        """Gains for a car as its file describes it."""
        p = simulator.parameters
        return cls(
            wheelbase_m=p.wheelbase_m,
            max_angle_rad=p.max_angle_rad,
            drive_gain_n=p.drive_gain_n,
            damping_nspm=p.damping_nspm,
            mass_kg=p.mass_kg,
            reaction_s=simulator.command_delay_s + 0.04,
        )

    def reset(self) -> None:
        """Feedback has no memory."""

    def act(self, view: PolicyInput) -> Action | None:
        """Steering and throttle of this tick."""
        state = view.observation.state
        yaw = state.yaw_rad + state.yaw_rate_radps * self.reaction_s
        middle = state.yaw_rad + 0.5 * state.yaw_rate_radps * self.reaction_s
        x = state.x_m + self.reaction_s * (state.vx_mps * math.cos(middle) - state.vy_mps * math.sin(middle))
        y = state.y_m + self.reaction_s * (state.vx_mps * math.sin(middle) + state.vy_mps * math.cos(middle))
        # Along and left of the line that leads, tail first, into the goal.
        line = self.goal[2] + math.pi
        dx, dy = self.goal[0] - x, self.goal[1] - y
        ahead = dx * math.cos(line) + dy * math.sin(line)
        left = dx * math.sin(line) - dy * math.cos(line)
        wanted = -self.approach_rad * (2.0 / math.pi) * math.atan(left / self.line_width_m)
        # Tyres let the heading swing on: what counts is where it will point.
        pointing = wrap(yaw + self.swing_s * state.yaw_rate_radps + math.pi - line)
        turn = wrap(wanted - pointing)
        limit = math.tan(self.max_angle_rad) / self.wheelbase_m
        curvature = min(max(self.turn_gain_per_m * turn, -limit), limit)
        # Turning left along the tail is turning the front wheels right.
        steering = -math.atan(self.wheelbase_m * curvature) / self.max_angle_rad
        rest = ahead + self.left_weight * abs(left)
        # Braking at a constant rate asks for too much at the very end: there, in proportion to the rest.
        braked = min(math.sqrt(2.0 * self.braking_mps2 * abs(rest)), 2.5 * abs(rest))
        speed = -math.copysign(min(self.cruise_mps, braked), rest) if abs(rest) > 0.02 else 0.0
        push = self.mass_kg * 6.0 * (speed - state.vx_mps) + self.damping_nspm * speed
        return Action(min(max(steering, -1.0), 1.0), min(max(push / self.drive_gain_n, -1.0), 1.0))
