"""Random commands inside an arena, for recordings that identify a car."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from carlab.core.errors import ConfigError
from carlab.core.geofence import can_stop_inside_batch, stopping_distance_m
from carlab.core.policy import PolicyInput
from carlab.core.quantities import NEUTRAL, Action, CarState, FloatArray
from carlab.core.safety import SafetyEnvelope
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.effects.base import GRAVITY_MPS2

HOLD_S = (0.2, 1.2)
"""Range of the time for which a command is constant: about the response times of steering and speed."""
THROTTLE_SHARES = (0.6, 0.2, 0.2)
"""Shares of commands with forward, no and backward throttle."""
MIN_THROTTLE = 0.05
"""Minimum throttle of a command that is not without throttle."""
N_DRAWS = 64
"""Number of commands that are drawn and predicted."""
MARGIN_M = 0.2
"""Distance of a planned stopping point from the edge: errors of the pose and of the prediction."""
STOPPING_RATIO = 1.5
"""Planned stopping distance over that of the geofence. With this margin, the geofence ended none of 28 drives of a
minute in 3 by 3 m, with cars whose motor, grip, lag, delay or steering differ from the car file."""
N_CHOICES = 4
"""Number of drawn commands that keep the car inside, of which the one with the highest final speed is used. With 1
the car is slow, because most fast commands leave a small arena."""
REVERSE_WEIGHT = 0.5
"""Weight of a speed in reverse."""
STEP_S = 0.05
"""Step of the prediction."""
STOPPING_S = 0.2
"""Time in which a slow car brakes to rest; a fast one brakes with the deceleration of the geofence."""


class ExcitationPolicy:
    """Draws random commands, and holds each as long as the car can stop inside the arena afterwards.

    Steering is uniform over its range, so that slow and fast curves to both sides occur. The path of a command is
    predicted by a kinematic single-track model with limited grip, from the state in which the command acts. It may be
    inaccurate, because it is checked again at each tick; a path that has become too long is replaced. If no drawn
    command keeps the car inside, the car brakes straight ahead.

    Args:
        simulator: car file, for geometry, motor, grip and command delay.
        envelope: safety limits with the arena; commands stay within the limits.
        seed: seed of the commands.

    Raises:
        ConfigError: the envelope has no arena.
    """

    name = "excitation"

    def __init__(self, simulator: SimulatorConfig, envelope: SafetyEnvelope, seed: int = 0) -> None:
        if not envelope.arena_m:
            raise ConfigError("The policy excitation needs an arena; choose a task or a car file with one.")
        self._car = simulator.parameters
        self._delay_s = simulator.command_delay_s
        self._envelope = envelope
        self._rng = np.random.default_rng(seed)
        self._action = NEUTRAL
        self._until_s = 0.0

    def reset(self) -> None:
        """Draw a new command at the next tick; the random sequence continues, so that episodes differ."""
        self._until_s = -math.inf

    def act(self, view: PolicyInput) -> Action | None:
        """The command that is held, a new one, or braking."""
        state = view.observation.state.after(self._delay_s)
        left_s = self._until_s - view.elapsed_s
        if left_s > 0.0 and self._planned(state, self._action.to_array()[None], np.array([left_s]))[0][0]:
            return self._action
        commands, hold_s = self._draw()
        stays_inside, speed = self._planned(state, commands, hold_s)
        inside = np.flatnonzero(stays_inside)[:N_CHOICES]
        if not len(inside):
            self._until_s = -math.inf
            return self._braking(state)
        preference = np.where(speed < 0.0, -REVERSE_WEIGHT * speed, speed)
        chosen = inside[int(np.argmax(preference[inside]))]
        self._action = Action.from_array(commands[chosen])
        self._until_s = view.elapsed_s + float(hold_s[chosen])
        return self._action

    def _draw(self) -> tuple[FloatArray, FloatArray]:
        """Commands (n, 2) and the times (n,) for which they are held [s]."""
        envelope, rng = self._envelope, self._rng
        sign = rng.choice([1.0, 0.0, -1.0], N_DRAWS, p=THROTTLE_SHARES)
        size = rng.uniform(min(MIN_THROTTLE, envelope.max_throttle), envelope.max_throttle, N_DRAWS)
        steering = rng.uniform(-envelope.max_steering, envelope.max_steering, N_DRAWS)
        return np.stack([steering, sign * size], axis=1), rng.uniform(*HOLD_S, N_DRAWS)

    def _planned(
        self, state: CarState, commands: FloatArray, hold_s: FloatArray
    ) -> tuple[NDArray[np.bool_], FloatArray]:
        """Whether the car can stop inside the arena at each moment of each command (n,), and its final speed [m/s]."""
        envelope = self._envelope
        steps = max(math.ceil(float(hold_s.max()) / STEP_S), 1)
        place, course, speed = self._predicted(state, commands, steps)
        needed = stopping_distance_m(STOPPING_RATIO * np.abs(speed), envelope.reaction_s, envelope.deceleration_mps2)
        stops = can_stop_inside_batch(
            envelope.arena_m, place.reshape(-1, 2), course.ravel(), needed.ravel() + MARGIN_M
        ).reshape(course.shape)
        is_later = STEP_S * np.arange(steps)[:, None] >= hold_s
        last = (~is_later).sum(axis=0) - 1
        return np.asarray((stops | is_later).all(axis=0)), speed[last, np.arange(len(hold_s))]

    def _predicted(
        self, state: CarState, commands: FloatArray, steps: int
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Places (steps, n, 2) [m], courses [rad] and speeds [m/s] (steps, n); speeds are negative in reverse."""
        car, dt = self._car, STEP_S
        curvature = np.tan(commands[:, 0] * car.max_angle_rad) / car.wheelbase_m
        grip_mps2 = GRAVITY_MPS2 * min(car.front_mu, car.rear_mu)
        yaw = np.full(len(commands), state.yaw_rad)
        place = np.tile([state.x_m, state.y_m], (len(commands), 1))
        speed = np.full(len(commands), state.vx_mps)
        found = []
        for _ in range(steps):
            speed = speed + dt * (car.drive_gain_n * commands[:, 1] - car.damping_nspm * speed) / car.mass_kg
            max_yaw_rate = grip_mps2 / np.maximum(np.abs(speed), 1e-3)
            yaw = yaw + dt * np.clip(curvature * speed, -max_yaw_rate, max_yaw_rate)
            place = place + dt * speed[:, None] * np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
            found.append((place, yaw + np.pi * (speed < 0.0), speed))
        places, courses, speeds = (np.array(each) for each in zip(*found, strict=True))
        return places, courses, speeds

    def _braking(self, state: CarState) -> Action:
        """Straight ahead, with the throttle that stops the car at the geofence's deceleration."""
        car, envelope = self._car, self._envelope
        stop_mps2 = float(np.clip(state.vx_mps / STOPPING_S, -envelope.deceleration_mps2, envelope.deceleration_mps2))
        throttle = -car.mass_kg * stop_mps2 / max(car.drive_gain_n, 1e-6)
        return Action(0.0, min(max(throttle, -envelope.max_throttle), envelope.max_throttle))
