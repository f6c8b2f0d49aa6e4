"""A constant angle between car and tracked rigid body is repaired, also if the body points backward."""

from dataclasses import replace

import numpy as np
import pytest

from carlab.core.episode_data import EpisodeData
from carlab.core.planar import to_body
from carlab.diagnosis.recording_faults.find import check
from carlab.recording.faults.heading import heading_faults
from carlab.recording.pose_velocity import pose_motion
from sim_backends.car_parameters import SimulatorConfig
from tests.helpers.recorded_drives import PERIOD_S, drive, driven

NOMINAL = SimulatorConfig(control_period_s=PERIOD_S)
YAW, YAW_RATE = 2, 5


@pytest.fixture(scope="module")
def clean() -> EpisodeData:
    return drive(NOMINAL, 45.0, 1)


def yaw_error(found: EpisodeData, true: EpisodeData) -> np.ndarray:
    return np.abs((found.states[:, YAW] - true.states[:, YAW] + np.pi) % (2.0 * np.pi) - np.pi)


@pytest.mark.parametrize("source", ["column", "pose"])
@pytest.mark.parametrize("offset_deg", [60.0, -90.0, 120.0, -150.0, 180.0])
def test_yaw_of_another_axis_is_the_only_repaired_column(clean: EpisodeData, offset_deg: float, source: str) -> None:
    states = clean.states.copy()
    states[:, YAW] += np.deg2rad(offset_deg)
    rotated = replace(clean, states=states, metadata={"velocity_source": source})
    (found,), _, faults = check([rotated], [], NOMINAL)
    assert [(f.id, f.channel) for f in faults] == [("wrong_frame", "yaw")]
    assert yaw_error(found, clean).max() < np.deg2rad(2.0)
    np.testing.assert_array_equal(found.sent, clean.sent)
    np.testing.assert_allclose(found.states[:, 3], clean.states[:, 3], atol=0.1)


def test_an_axis_is_found_after_the_sense_of_rotation(clean: EpisodeData) -> None:
    states = clean.states.copy()
    states[:, YAW] = -(states[:, YAW] + np.deg2rad(40.0))
    (found,), _, faults = check([replace(clean, states=states)], [], NOMINAL)
    assert [(f.id, f.channel) for f in faults] == [("wrong_sign", "yaw"), ("wrong_frame", "yaw")]
    assert yaw_error(found, clean).max() < np.deg2rad(2.0)


def test_a_drive_in_reverse_gear_is_unchanged() -> None:
    rng = np.random.default_rng(2)
    levels = np.column_stack([rng.uniform(-0.8, 0.8, 90), rng.choice([-0.8, -0.5, -0.3, -0.1, 0.0], 90)])
    commands = np.repeat(levels, 15, axis=0)
    states = driven(NOMINAL, commands)
    times_s = PERIOD_S * np.arange(len(states))
    backward = EpisodeData(times_s, states, commands, commands, np.zeros(len(commands)))
    assert np.mean(states[:, 3] < 0.0) > 0.8
    (found,), _, faults = check([backward], [], NOMINAL)
    assert found is backward
    assert faults == []


def test_slip_in_reverse_gear_is_no_yaw_that_points_to_the_rear() -> None:
    t_s = np.arange(0.0, 20.0, PERIOD_S)
    yaw = 0.9 * t_s
    course = yaw + np.pi + np.deg2rad(20.0)
    x, y = (np.cumsum(PERIOD_S * component) for component in (np.cos(course), np.sin(course)))
    (fault,) = heading_faults(t_s, {"x": x, "y": y, "yaw": yaw})
    assert fault.evidence["offset_rad"] == pytest.approx(np.deg2rad(20.0), abs=0.03)


@pytest.mark.parametrize("offset_deg", [-20.0, 8.0, 25.0])
def test_yaw_offset_is_no_scale_of_true_velocities(clean: EpisodeData, offset_deg: float) -> None:
    """The speeds along the wrong axis are smaller by the cosine of the offset."""
    states, offset_rad = clean.states.copy(), np.deg2rad(offset_deg)
    states[:, YAW] += offset_rad
    (found,), _, faults = check([replace(clean, states=states, metadata={"velocity_source": "column"})], [], NOMINAL)
    assert [(f.id, f.channel) for f in faults] == [("wrong_frame", "vx, vy")]
    assert f"rotated by {offset_deg:.0f} degrees against the motion of the pose" in faults[0].action
    vx, vy = clean.states[:, 3:5].T
    along = np.cos(offset_rad) * vx + np.sin(offset_rad) * vy
    np.testing.assert_allclose(found.states[5:-5, 3], along[5:-5], atol=0.1)


@pytest.mark.parametrize("offset_deg", [90.0, -90.0, 180.0])
def test_a_body_mounted_at_a_right_angle_is_repaired_exactly(clean: EpisodeData, offset_deg: float) -> None:
    """The tracked body is rotated in the car, and so are the velocities of motion capture in its frame."""
    states, offset_rad = clean.states.copy(), np.deg2rad(offset_deg)
    states[:, YAW] += offset_rad
    states[:, 3], states[:, 4] = to_body(*clean.states[:, 3:5].T, np.asarray(offset_rad))
    (found,), _, _ = check([replace(clean, states=states, metadata={"velocity_source": "column"})], [], NOMINAL)
    assert yaw_error(found, clean).max() < 1e-9
    np.testing.assert_allclose(found.states[:, 3:5], clean.states[:, 3:5], atol=0.02)


def test_velocities_of_a_repaired_pose_are_estimated_as_by_the_import(clean: EpisodeData) -> None:
    x, y, yaw = clean.states.T[:3]
    motion = pose_motion(clean.times_s, x, y, yaw, np.zeros(len(x)), for_states=True)
    states = np.column_stack([x, y, yaw + np.pi, motion.vx, motion.vy, motion.yaw_rate])
    (found,), _, _ = check([replace(clean, states=states, metadata={"velocity_source": "pose"})], [], NOMINAL)
    np.testing.assert_allclose(found.states[:, 3:], np.column_stack([motion.vx, motion.vy, motion.yaw_rate]), atol=1e-9)
