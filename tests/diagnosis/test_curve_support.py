"""Commands of a recording as inputs of measured curves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from carlab.diagnosis.curves.support import recorded_forces
from carlab.prediction.windows import RecordingSegment
from sim_backends.car_parameters import SimulatorConfig

PERIOD_S = 0.02
CAR = replace(SimulatorConfig(control_period_s=PERIOD_S), command_delay_s=0.06)


def segment(throttle: np.ndarray) -> RecordingSegment:
    """A car that stands, with these throttle commands (n,)."""
    count = len(throttle)
    states = np.zeros((count, 6))
    commands = np.stack([np.zeros(count), throttle], axis=1)
    return RecordingSegment(
        0, PERIOD_S, PERIOD_S * np.arange(count), states, states, commands, states, np.zeros(count), states, PERIOD_S,
        np.zeros(count, dtype=bool),
    )  # fmt: skip


def test_first_command_is_held_where_the_delayed_commands_are_not_recorded() -> None:
    """The last commands of the recording do not act at its beginning."""
    assert CAR.delays_s()[1] == 0.06
    found = recorded_forces(segment(np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])), CAR).throttle
    np.testing.assert_array_equal(found, [0.1, 0.1, 0.1, 0.1, 0.2, 0.3])


def test_delay_longer_than_the_recording_leaves_the_first_command() -> None:
    found = recorded_forces(segment(np.array([0.1, 0.2])), CAR).throttle
    np.testing.assert_array_equal(found, [0.1, 0.1])
