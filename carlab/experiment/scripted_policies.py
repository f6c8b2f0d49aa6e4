"""Policies that need no learning: manoeuvres, recorded actions, standing still, and a feedback parking policy."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from carlab.core.angles import wrap
from carlab.core.manoeuvres import Manoeuvre
from carlab.core.policy import PolicyInput
from carlab.core.quantities import NEUTRAL, Action, FloatArray


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
    """Backs into a pose by feedback on polar coordinates; a baseline to compare a learned policy with.

    Aicardi et al., "Closed loop steering of unicycle-like vehicles via Lyapunov techniques", IEEE Robotics and
    Automation Magazine 1995, for the car reversed: with rho the distance, alpha the bearing of the goal from the rear,
    and delta the bearing seen from the goal, curvature = (k_alpha alpha + k_delta delta terms) / rho, clipped to what
    the steering can do. Speed follows the distance and is held by a proportional throttle with feed-forward.
    """

    goal: tuple[float, float, float] = (0.0, 0.0, 0.0)
    wheelbase_m: float = 0.30
    max_angle_rad: float = 0.6
    drive_gain_n: float = 8.2
    damping_nspm: float = 1.56
    mass_kg: float = 1.65
    cruise_mps: float = 1.15
    reaction_s: float = 0.12
    name: str = "reverse_parking"
    _forward: bool = False

    def reset(self) -> None:
        """Begin in reverse."""
        self._forward = False

    def act(self, view: PolicyInput) -> Action | None:
        """Steering and throttle of this tick."""
        state = view.observation.state
        # Where the car will be when this command acts.
        yaw = state.yaw_rad + state.yaw_rate_radps * self.reaction_s
        course = state.yaw_rad + 0.5 * state.yaw_rate_radps * self.reaction_s
        x = state.x_m + self.reaction_s * (state.vx_mps * math.cos(course) - state.vy_mps * math.sin(course))
        y = state.y_m + self.reaction_s * (state.vx_mps * math.sin(course) + state.vy_mps * math.cos(course))
        dx, dy = self.goal[0] - x, self.goal[1] - y
        rho = math.hypot(dx, dy)
        # The reversed car drives "forward" along its tail: heading yaw + pi towards the goal heading + pi.
        heading = yaw + math.pi
        bearing = math.atan2(dy, dx)
        alpha = wrap(bearing - heading)
        delta = wrap(bearing - (self.goal[2] + math.pi))
        ahead = rho * math.cos(alpha)
        speed_goal = -math.copysign(min(self.cruise_mps, 1.3 * math.sqrt(max(abs(ahead) - 0.02, 0.0))), ahead)
        if rho < 0.08:
            speed_goal = 0.0
        sinc = math.cos(alpha) * (math.sin(alpha) / alpha if abs(alpha) > 1e-3 else 1.0)
        curvature = (2.2 * alpha + 1.6 * sinc * (alpha + 1.2 * delta)) / max(rho, 0.3)
        if ahead < 0:
            curvature = -2.0 * wrap(self.goal[2] - yaw)
        limit = math.tan(self.max_angle_rad) / self.wheelbase_m
        curvature = min(max(curvature, -limit), limit)
        # Turning left along the tail is turning the front wheels right.
        steering = -math.atan(self.wheelbase_m * curvature) / self.max_angle_rad
        wanted_mps2 = 5.0 * (speed_goal - state.vx_mps)
        throttle = (self.mass_kg * wanted_mps2 + self.damping_nspm * speed_goal) / self.drive_gain_n
        return Action(min(max(steering, -1.0), 1.0), min(max(throttle, -1.0), 1.0))
