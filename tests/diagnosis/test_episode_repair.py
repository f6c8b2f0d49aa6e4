"""The poses of a repaired recording are those of its repaired rows."""

from dataclasses import replace

import numpy as np

from carlab.diagnosis.recording_faults.episode_repair import EpisodeRepair
from carlab.diagnosis.recording_faults.find import check
from sim_backends import SimulatorConfig
from tests.helpers.recorded_drives import PERIOD_S, drive


def test_poses_have_the_units_and_rows_of_the_states() -> None:
    """Poses in millimetres, and the last row is removed: both repairs hold for the poses too."""
    true = drive(SimulatorConfig(control_period_s=PERIOD_S), 4.0, 1)
    states = true.states * [1e3, 1e3, 1.0, 1.0, 1.0, 1.0]
    poses = np.column_stack([true.times_s, states[:, :3]])
    repair = EpisodeRepair.of(replace(true, states=states, poses=poses))
    repair.states[:, :2] *= 1e-3
    repair.trim(1, at_end=True)
    expected = np.column_stack([true.times_s, true.states[:, :3]])[:-1]
    np.testing.assert_allclose(repair.result().poses, expected, rtol=1e-12)


def test_poses_of_another_rate_stay_as_they_are() -> None:
    true = drive(SimulatorConfig(control_period_s=PERIOD_S), 4.0, 1)
    poses = np.column_stack([true.times_s, true.states[:, :3]])[::2]
    repair = EpisodeRepair.of(replace(true, poses=poses))
    repair.trim(1, at_end=True)
    np.testing.assert_array_equal(repair.result().poses, poses)


def test_one_wrong_pose_is_described_in_the_singular() -> None:
    car = SimulatorConfig(control_period_s=PERIOD_S)
    true = drive(car, 20.0, 1)
    states = true.states.copy()
    states[300, 0] += 0.4
    _, _, (fault,) = check([replace(true, states=states)], [], car)
    assert fault.action == (
        "repaired: the pose of 1 row is far from the path of its neighbours (another marker, a bad frame); 1 was "
        "interpolated from its neighbours."
    )
