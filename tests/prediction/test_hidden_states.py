"""Test predictions of cars with hidden states against scipy's integration of the equations."""

import numpy as np
from scipy.integrate import solve_ivp

from carlab.core.episode_data import EpisodeData
from carlab.prediction.errors import final_errors
from carlab.prediction.initial_states import as_recorded
from carlab.prediction.predict import SimulatorModel
from carlab.prediction.windows import cut_windows, segments_of
from sim_backends import CarParameters, SimulatorConfig
from sim_backends.car_parameters import MocapParameters

PARAMETERS = CarParameters()
LENGTH_M = 0.3
PERIOD_S = 1 / 30


def rates(s, angle, drive_n, p=PARAMETERS):
    """Evaluate the single-track model; the last two states are the side forces, which relax over ``LENGTH_M``."""
    yaw, vx, vy, r, front, rear = s[2:]
    load = p.mass_kg * 9.81 / (p.front_axle_m + p.rear_axle_m)
    across = -vx * np.sin(angle) + (vy + p.front_axle_m * r) * np.cos(angle)
    along = vx * np.cos(angle) + (vy + p.front_axle_m * r) * np.sin(angle)
    steady = [
        -mu * load * arm * np.sin(c * np.arctan(b * np.arctan2(side, max(abs(forward), 0.3))))
        for mu, arm, c, b, side, forward in (
            (p.front_mu, p.rear_axle_m, p.front_c, p.front_b, across, along),
            (p.rear_mu, p.front_axle_m, p.rear_c, p.rear_b, vy - p.rear_axle_m * r, vx),
        )
    ]
    rate = max(abs(vx), 0.3) / LENGTH_M
    return [
        vx * np.cos(yaw) - vy * np.sin(yaw),
        vx * np.sin(yaw) + vy * np.cos(yaw),
        r,
        (drive_n - p.damping_nspm * vx - front * np.sin(angle)) / p.mass_kg + vy * r,
        (rear + front * np.cos(angle)) / p.mass_kg - vx * r,
        (p.front_axle_m * front * np.cos(angle) - p.rear_axle_m * rear) / p.yaw_inertia_kgm2,
        rate * (steady[0] - front),
        rate * (steady[1] - rear),
    ]


def drive(seconds=12.0):
    """Drive a slalom at about 2 m/s."""
    t = PERIOD_S * np.arange(round(seconds / PERIOD_S))
    sent = np.column_stack([0.5 * np.sin(3.0 * t), 0.45 + 0.05 * np.sin(t)])
    state = np.array([0.0, 0.0, 0.5, 2.0, 0.0, 0.0, 0.0, 0.0])
    states = [state[:6]]
    for steering, throttle in sent:
        held = (PARAMETERS.max_angle_rad * steering, PARAMETERS.drive_gain_n * throttle)
        state = solve_ivp(lambda _, s, h=held: rates(s, *h), (0.0, PERIOD_S), state, rtol=1e-9, atol=1e-11).y[:, -1]
        states.append(state[:6])
    times_s = PERIOD_S * np.arange(len(states))
    return EpisodeData(times_s, np.array(states), sent, sent, np.full(len(sent), np.nan))


def test_side_forces_at_the_start_of_a_window_follow_from_the_motion_before_it():
    config = SimulatorConfig(
        PARAMETERS,
        control_period_s=PERIOD_S,
        command_delay_s=0.0,
        mocap=MocapParameters(latency_s=0.0),
        effects={"tyre_relaxation": {"length": LENGTH_M}},
    )
    windows = as_recorded(cut_windows(segments_of([drive()]), 0.3, 0.25))
    error = np.abs(final_errors(SimulatorModel(config), windows)).max(axis=0)
    assert np.all(error < [1e-3, 1e-3, 3e-3, 3e-3, 5e-3, 2e-2]), error
