"""Test the commands before a window: play in the steering has the side that it has in the car."""

import numpy as np
import pytest

from carlab.core.episode_data import EpisodeData
from carlab.core.quantities import FloatArray
from carlab.prediction.errors import prediction_errors
from carlab.prediction.past import last_turning_point, past_commands
from carlab.prediction.predict import simulate_windows
from carlab.prediction.windows import cut_windows, history_rows, segments_of
from sim_backends import SimulatorConfig
from sim_backends.car_parameters import MocapParameters
from tests.helpers.recorded_drives import PERIOD_S, driven


@pytest.mark.parametrize(
    ("command", "expected"),
    [
        ([0.3, 0.3, 0.3], None),
        ([0.3, 0.31, 0.3], None),
        ([0.0, 0.5, 0.2, 0.2], 0.5),
        ([0.0, -0.5, 0.2, 0.2, 0.2], -0.5),
        ([-0.5, -0.1, -0.11, 0.0, 0.2], -0.5),
        ([0.0, 0.9, 0.4, 0.5, 0.5], 0.4),
        ([0.0, 0.2, 0.2], 0.0),
    ],
)
def test_turning_point_is_where_the_last_motion_began(command: list[float], expected: float | None) -> None:
    assert last_turning_point(np.array(command)) == (None if expected is None else pytest.approx(expected))


def play(command: FloatArray, half: float) -> float:
    """The output of a play operator that starts at the first command, by its definition."""
    output = float(command[0])
    for value in command:
        output = min(max(output, value - half), value + half)
    return output


def test_play_starts_on_its_side_after_a_held_command() -> None:
    """Steps of more than the play, held for one to three seconds, so that most windows start after a held command."""
    rng = np.random.default_rng(0)
    steering = np.repeat(rng.uniform(-1.0, 1.0, 40), rng.integers(30, 90, 40))
    commands = np.stack([steering, 0.0 * steering], axis=1)
    steps = np.abs(np.diff(steering))
    count, half = 36, 0.4 * steps[steps > 0.0].min()
    for row in range(2 * count, len(steering), 7):
        found = play(past_commands(commands, row, count)[:, 0], half)
        assert found == pytest.approx(play(steering[:row], half), abs=1e-12)


def test_rows_with_a_motion_are_those_of_the_recording() -> None:
    commands = np.random.default_rng(1).uniform(-1.0, 1.0, (100, 2))
    np.testing.assert_array_equal(past_commands(commands, 60, 36), commands[24:60])
    np.testing.assert_array_equal(past_commands(commands, 10, 36)[:26], np.tile(commands[0], (26, 1)))


def test_car_with_play_is_predicted_after_held_commands() -> None:
    """The exact simulator of a car with play has no error, also where the steering was held for 2 s."""
    play = {"steering_backlash": {"play": 0.08}}
    car = SimulatorConfig(control_period_s=PERIOD_S, mocap=MocapParameters(latency_s=0.0), effects=play)
    steering = np.repeat([0.0, 0.5, -0.2, 0.3, -0.5, 0.1], 60)
    commands = np.stack([steering, np.full(len(steering), 0.25)], axis=1)
    times_s = PERIOD_S * np.arange(len(steering) + 1)
    recording = EpisodeData(times_s, driven(car, commands), commands, commands, np.zeros(len(steering)))
    windows = cut_windows(segments_of([recording]), 0.8, 0.25)
    held = np.ptp(windows.past_commands[:, 1:, 0], axis=1) == 0.0
    assert held[windows.t0_s > 60 * PERIOD_S].sum() > 10
    position = prediction_errors(simulate_windows(windows, car), windows)[0, :, -1, :2]
    after_a_step = windows.t0_s > (60 + history_rows(PERIOD_S)) * PERIOD_S
    assert np.abs(position[held & after_a_step]).max() < 2e-3
