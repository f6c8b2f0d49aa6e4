"""Reference implementation of the base model: one car at a time, NumPy, a Python loop.

The batched simulator is tested and benchmarked against it. It shares no code with the simulator and is not optimised.
"""

from __future__ import annotations

import numpy as np

from carlab.core.quantities import FloatArray
from sim_backends.car_parameters import CarParameters, SimulatorConfig
from sim_backends.dynamics.integrate import MAX_STEP_S, substeps_for
from sim_backends.effects.base import GRAVITY_MPS2


def derivative(state: FloatArray, steering: float, throttle: float, p: CarParameters) -> FloatArray:
    """Derivative (6,) of a state (6,) by the dynamic single-track model with Pacejka tyres (``single_track``).

    Args:
        state: x, y [m], yaw [rad], vx, vy [m/s], yaw rate [rad/s].
        steering: In [-1, 1].
        throttle: In [-1, 1].
        p: Parameters of the car.
    """
    _, _, yaw, vx, vy, r = state
    d = p.max_angle_rad * steering
    wheelbase = p.front_axle_m + p.rear_axle_m
    load_front = p.mass_kg * GRAVITY_MPS2 * p.rear_axle_m / wheelbase
    load_rear = p.mass_kg * GRAVITY_MPS2 * p.front_axle_m / wheelbase
    side = vy + p.front_axle_m * r
    along = vx * np.cos(d) + side * np.sin(d)
    across = -vx * np.sin(d) + side * np.cos(d)
    slip_front = np.arctan2(across, max(abs(along), 0.3))
    slip_rear = np.arctan2(vy - p.rear_axle_m * r, max(abs(vx), 0.3))
    force_front = -p.front_mu * load_front * np.sin(p.front_c * np.arctan(p.front_b * slip_front))
    force_rear = -p.rear_mu * load_rear * np.sin(p.rear_c * np.arctan(p.rear_b * slip_rear))
    drive = p.drive_gain_n * throttle - p.damping_nspm * vx
    return np.array(
        [
            vx * np.cos(yaw) - vy * np.sin(yaw),
            vx * np.sin(yaw) + vy * np.cos(yaw),
            r,
            (drive - force_front * np.sin(d)) / p.mass_kg + vy * r,
            (force_rear + force_front * np.cos(d)) / p.mass_kg - vx * r,
            (p.front_axle_m * force_front * np.cos(d) - p.rear_axle_m * force_rear) / p.yaw_inertia_kgm2,
        ]
    )


def rk4(state: FloatArray, steering: float, throttle: float, p: CarParameters, step_s: float) -> FloatArray:
    """State (6,) after one classical fourth-order Runge-Kutta step from a state (6,) with held commands in [-1, 1]."""
    k1 = derivative(state, steering, throttle, p)
    k2 = derivative(state + 0.5 * step_s * k1, steering, throttle, p)
    k3 = derivative(state + 0.5 * step_s * k2, steering, throttle, p)
    k4 = derivative(state + step_s * k3, steering, throttle, p)
    return state + step_s / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


def rollout_one_by_one(config: SimulatorConfig, start: FloatArray, commands: FloatArray) -> FloatArray:
    """Simulate cars one after the other; same meaning and shapes as ``batch.rollout.rollout`` without history.

    Args:
        config: A simulator of kind "dynamic" without effects.
        start: (N, 6).
        commands: (N, T, 2).

    Returns:
        States (N, T + 1, 6).
    """
    period_s = config.control_period_s
    late = int(np.floor(config.command_delay_s / period_s))
    phase_s = config.command_delay_s - late * period_s
    cars, ticks, _ = commands.shape
    states = np.empty((cars, ticks + 1, 6))
    for car in range(cars):
        states[car, 0] = state = start[car]
        for k in range(ticks):
            for index, length_s in ((k - late - 1, phase_s), (k - late, period_s - phase_s)):
                if length_s <= 0.0:
                    continue
                steering, throttle = commands[car, index] if index >= 0 else (0.0, 0.0)
                steps = substeps_for(length_s, MAX_STEP_S)
                for _ in range(steps):
                    state = rk4(state, steering, throttle, config.parameters, length_s / steps)
            states[car, k + 1] = state
    return states
