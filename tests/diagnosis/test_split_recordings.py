"""Recordings that allow no split, with reasons that fit a diagnosis."""

from dataclasses import replace

import numpy as np
import pytest

from carlab.core.episode_data import EpisodeData
from carlab.diagnosis.diagnose import diagnose
from carlab.diagnosis.findings import DataFault
from carlab.diagnosis.recordings import Inconclusive, split_recordings
from carlab.diagnosis.settings import DEFAULT
from sim_backends import SimulatorConfig
from tests.helpers.recorded_drives import PERIOD_S, drive

CAR = SimulatorConfig(control_period_s=PERIOD_S)


def parked_from(episode: EpisodeData, begin_s: float) -> EpisodeData:
    """The recording of a car that stands still from ``begin_s`` on."""
    row = int(begin_s / PERIOD_S)
    states, commands = episode.states.copy(), episode.sent.copy()
    states[row:, :3], states[row:, 3:], commands[row:] = states[row, :3], 0.0, 0.0
    return replace(episode, states=states, sent=commands)


def test_parked_car_in_the_held_out_part_is_stated_with_a_remedy_of_a_diagnosis() -> None:
    """A diagnosis has no option for the horizon."""
    with pytest.raises(Inconclusive, match=r"In the held-out part .* moves in no stretch of 1\.6 s") as caught:
        split_recordings([parked_from(drive(CAR, 40.0, 3), 24.0)], [], 0.3, CAR, DEFAULT)
    assert "horizon" not in str(caught.value)


def test_short_recording_at_a_high_rate_is_not_called_faulty() -> None:
    """7 s at 100 Hz are usable but too short; at the 30 Hz of the car file its 701 rows would be 23 s."""
    times_s = 0.01 * np.arange(701)
    yaw = 0.8 * times_s
    states = np.column_stack([np.sin(yaw), 1.0 - np.cos(yaw), yaw, *np.tile([[0.8], [0.0], [0.8]], 701)])
    commands = np.column_stack([0.3 * np.sin(5.0 * times_s), 0.3 + 0.1 * np.cos(3.0 * times_s)])[:-1]
    fast = EpisodeData(times_s, states, commands, commands, np.zeros(700))
    fault = DataFault("outliers", "x, y, yaw", 1, "repaired: one row.")
    with pytest.raises(Inconclusive, match=r"contain 7\.0 s of driving") as caught:
        diagnose([fast], [], CAR, data_faults=[fault])
    assert caught.value.verdict == "inconclusive"
