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
from tests.helpers.reference_dynamics import reference_rates

PARAMETERS = CarParameters()
PERIOD_S = 1 / 30


def rates(s, angle, throttle, length_m):
    """Evaluate the single-track model; the last two states are the side forces, which relax over ``length_m``."""
    relaxation = {"tyre_relaxation": {"length": length_m}}
    return reference_rates(0.0, [*s, *np.zeros(3)], angle, throttle, PARAMETERS, relaxation)[:8]


def with_play(angles, play):
    """Wheel angles of a linkage that follows its commanded angles with play."""
    found, wheel = [], angles[0]
    for angle in angles:
        wheel = min(max(wheel, angle - 0.5 * play), angle + 0.5 * play)
        found.append(wheel)
    return found


def drive(steering_of_time, length_m, play=0.0, seconds=12.0):
    """Drive at about 2 m/s."""
    t = PERIOD_S * np.arange(round(seconds / PERIOD_S))
    sent = np.column_stack([steering_of_time(t), 0.45 + 0.05 * np.sin(t)])
    angles = with_play(PARAMETERS.max_angle_rad * sent[:, 0], play)
    state = np.array([0.0, 0.0, 0.5, 2.0, 0.0, 0.0, 0.0, 0.0])
    states = [state[:6]]
    for angle, throttle in zip(angles, sent[:, 1], strict=True):
        held = (angle, throttle, length_m)
        state = solve_ivp(lambda _, s, h=held: rates(s, *h), (0.0, PERIOD_S), state, rtol=1e-9, atol=1e-11).y[:, -1]
        states.append(state[:6])
    times_s = PERIOD_S * np.arange(len(states))
    return EpisodeData(times_s, np.array(states), sent, sent, np.full(len(sent), np.nan))


def errors(episode, length_m, **effects):
    """Largest errors (6,) of predictions over 0.3 s from true states."""
    config = SimulatorConfig(
        PARAMETERS,
        control_period_s=PERIOD_S,
        command_delay_s=0.0,
        mocap=MocapParameters(latency_s=0.0),
        effects={"tyre_relaxation": {"length": length_m}, **effects},
    )
    windows = as_recorded(cut_windows(segments_of([episode]), 0.3, 0.25))
    return np.abs(final_errors(SimulatorModel(config), windows)).max(axis=0)


def test_side_forces_at_the_start_of_a_window_follow_from_the_motion_before_it():
    error = errors(drive(lambda t: 0.5 * np.sin(3.0 * t), 0.3), 0.3)
    assert np.all(error < [1e-3, 1e-3, 3e-3, 3e-3, 5e-3, 2e-2]), error


def test_play_at_the_start_of_a_window_follows_from_a_reversal_a_second_before_it():
    """The steering reverses every second and is constant between reversals."""
    length_m, play = 0.02, 0.1
    episode = drive(lambda t: 0.3 * np.sign(np.sin(np.pi * t + 0.1)), length_m, play)
    error = errors(episode, length_m, steering_backlash={"play": play})
    assert np.all(error < [1e-3, 1e-3, 3e-3, 3e-3, 5e-3, 2e-2]), error
