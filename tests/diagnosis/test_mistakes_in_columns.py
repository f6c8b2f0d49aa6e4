"""Mistakes of a log are faults of the recording and no physics: other sensors, late poses, exchanged columns."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from carlab.core.episode_data import EpisodeData
from carlab.diagnosis.recording_faults.find import check
from carlab.recording.csv.export import write_csv
from carlab.recording.csv.foreign import import_csv
from tests.helpers.kinematic_drives import NOMINAL, Car, with_sent, with_states, without_rows

VX, VY = 3, 4


def exchange(sent: np.ndarray) -> None:
    sent[:] = sent[:, ::-1].copy()


def test_velocities_of_wheel_odometry_are_replaced_by_those_of_the_pose():
    """Wheels measure the speed along the car: ``vy`` is zero although the centre of mass moves sideways."""
    true = Car(rear_axle_m=0.12).drive()
    odometry = with_states(true, lambda states: states.__setitem__((slice(None), VY), 0.0))
    (fit,), _, (fault,) = check([odometry], [], NOMINAL)
    assert (fault.id, fault.channel, fault.action) == (
        "column_scale",
        "vy",
        "repaired: vy does not follow the motion of the pose; the velocities were estimated from the pose.",
    )
    np.testing.assert_allclose(fit.states[:, VY], true.states[:, VY], atol=0.12)
    assert odometry.has_velocity_columns
    assert not fit.has_velocity_columns


def test_velocities_of_zero_are_one_fault_for_each_column(clean):
    """A column without motion has no delay, so the poses are not late."""
    empty = with_states(clean, lambda states: states.__setitem__((slice(None), slice(VX, None)), 0.0))
    _, _, faults = check([empty], [], NOMINAL)
    assert [(f.id, f.channel) for f in faults] == [("column_scale", "vx"), ("column_scale", "yaw_rate")]


@pytest.mark.parametrize("rows", [1, 2])
def test_velocities_that_precede_late_poses_are_replaced(clean, rows):
    """One delay of motion capture explains poses and velocities only if both have it."""
    states = clean.states[rows:].copy()
    states[:, :3] = clean.states[:-rows, :3]
    late = without_rows(clean, np.arange(len(clean.states)) < rows, states)
    (fit,), _, (fault,) = check([late], [], NOMINAL)
    assert (fault.id, fault.channel) == ("column_shift", "vx, vy, yaw_rate")
    assert "the poses are late" in fault.action
    np.testing.assert_allclose(fit.states[5:-5, VX], clean.states[5:-rows, VX][:-5], atol=0.1)


def test_velocities_less_than_half_a_row_early_are_no_fault(clean):
    """A shift of a third of a row is within the error of stamps and filters."""
    times_s = clean.times_s
    early = [np.interp(times_s + 0.3 / 30.0, times_s, column) for column in clean.states[:, VX:].T]
    shifted = with_states(clean, lambda states: states.__setitem__((slice(None), slice(VX, None)), np.stack(early, 1)))
    (found,), _, faults = check([shifted], [], NOMINAL)
    assert not faults
    assert found is shifted


def filtered_in_world(episode: EpisodeData, time_constant_s: float) -> EpisodeData:
    """Velocities that a program filters along the axes of the room and then rotates by the yaw of the row."""
    heading = np.exp(1j * episode.states[:, 2])
    share = 1.0 - np.exp(-np.median(np.diff(episode.times_s)) / time_constant_s)
    room = (episode.states[:, VX] + 1j * episode.states[:, VY]) * heading
    body = lfilter([share], [1.0, share - 1.0], room) / heading
    velocity = np.column_stack([body.real, body.imag])
    return with_states(episode, lambda states: states.__setitem__((slice(None), slice(VX, VY + 1)), velocity))


@pytest.mark.parametrize("time_constant_s", [0.05, 0.1, 0.2])
def test_velocities_filtered_in_the_world_frame_are_replaced(clean, time_constant_s):
    """While the car turns, this filter puts a part of vx into vy. No filter of body velocities does that."""
    (fit,), _, (fault,) = check([filtered_in_world(clean, time_constant_s)], [], NOMINAL)
    assert (fault.id, fault.channel) == ("wrong_frame", "vx, vy")
    stated_s = 1e-3 * float(re.search(r"about (\d+) ms before", fault.action)[1])
    assert stated_s == pytest.approx(time_constant_s, abs=0.02)
    rows = slice(5, -5)
    np.testing.assert_allclose(fit.states[rows, VY], clean.states[rows, VY], atol=0.12)


def test_a_comparison_replaces_velocities_of_all_recordings_or_of_none(clean, held):
    """Otherwise a filter of one group would appear as a change of the car."""
    for others, n_faults in (([held], 0), ([filtered_in_world(held, 0.1)], 1)):
        _, _, faults = check([filtered_in_world(clean, 0.1)], others, NOMINAL, alike=True)
        assert sum("the velocities were estimated from the pose" in fault.action for fault in faults) == n_faults


def test_exchanged_command_columns_are_repaired(clean, held):
    fit, out, faults = check([with_sent(clean, exchange)], [with_sent(held, exchange)], NOMINAL)
    assert [(f.id, f.channel) for f in faults] == [("exchanged_columns", "steering, throttle")]
    np.testing.assert_array_equal(fit[0].sent, clean.sent)
    np.testing.assert_array_equal(out[0].sent, held.sent)


def exchanged_and_late(episode: EpisodeData, rows: int) -> EpisodeData:
    """The columns of both commands are exchanged, and each command is in a row that is ``rows`` later."""
    return with_sent(episode, lambda sent: sent.__setitem__(slice(None), np.roll(sent[:, ::-1], rows, axis=0).copy()))


@pytest.mark.parametrize("offset_s", [0.3, 1.0, -2.0])
def test_exchanged_commands_of_another_clock_are_repaired(clean, offset_s):
    (fit,), _, faults = check([exchanged_and_late(clean, round(offset_s * 30.0))], [], NOMINAL)
    assert faults[0].id == "exchanged_columns"
    assert {f.id for f in faults[1:]} == {"column_shift" if abs(offset_s) < 0.5 else "clock_offset"}
    rows = np.searchsorted(clean.times_s, fit.times_s[:-1])
    agree = np.abs(fit.sent - clean.sent[rows])[90:-90] < 0.15
    assert agree.mean() > 0.95


@pytest.mark.parametrize("offset_s", [0.3, -2.0])
def test_audit_names_exchanged_commands_of_another_clock(clean, tmp_path, offset_s):
    write_csv(exchanged_and_late(clean, round(offset_s * 30.0)), tmp_path / "drive.csv")
    assert len(import_csv(tmp_path / "drive.csv").report.of("exchanged_columns")) == 1


def test_audit_names_exchanged_command_columns(clean, tmp_path):
    write_csv(with_sent(clean, exchange), tmp_path / "drive.csv")
    (finding,) = import_csv(tmp_path / "drive.csv").report.of("exchanged_columns")
    assert "exchange the columns 'steering' and 'throttle' in the mapping" in finding.sentence


def test_only_the_recording_with_exchanged_columns_is_repaired(clean, held):
    fit, out, _ = check([with_sent(clean, exchange)], [held], NOMINAL)
    np.testing.assert_array_equal(fit[0].sent, clean.sent)
    assert out[0] is held


def test_commands_between_rows_are_reported_as_lost(clean):
    """A log at 10 Hz of a car with 30 commands per second."""
    sent = clean.sent[::3]
    states = clean.states[::3][: len(sent) + 1]
    changed = {"states": states, "requested": sent, "sent": sent[: len(states) - 1]}
    slow = replace(clean, times_s=clean.times_s[::3][: len(states)], rewards=np.full(len(sent), np.nan), **changed)
    _, _, faults = check([slow], [], NOMINAL)
    (action,) = [f.action for f in faults if f.id == "coarse_rows"]
    assert "rows are 0.099 s apart" in action
    assert "the recording lacks the commands between the rows" in action


@pytest.mark.parametrize(("every", "source", "is_slow"), [(1, "pose", False), (2, "pose", True), (2, "column", False)])
def test_velocities_of_poses_that_are_far_apart_are_reported(clean, every, source, is_slow):
    """Velocities of three poses at 15 Hz average over 0.13 s."""
    states = clean.states[::every]
    sent = clean.sent[::every][: len(states) - 1]
    changed = {"states": states, "requested": sent, "sent": sent, "metadata": {"velocity_source": source}}
    slow = replace(clean, times_s=clean.times_s[::every], rewards=np.full(len(sent), np.nan), **changed)
    _, _, faults = check([slow], [], NOMINAL)
    actions = [f.action for f in faults if f.id == "slow_poses"]
    assert len(actions) == is_slow
    assert all(re.search(r"poses that are 0\.06[67] s apart", action) for action in actions)


def test_commands_that_the_log_limits_are_reported(clean):
    _, _, faults = check([with_sent(clean, lambda sent: np.clip(sent, -0.4, 0.4, out=sent))], [], NOMINAL)
    found = {f.channel: f.action for f in faults}
    assert {f.id for f in faults} == {"limited_commands"}
    assert "at its limit of 0.4 and -0.4" in found["steering"]
    assert "more than by this command: the log or the radio limits the command" in found["steering"]


def test_audit_names_commands_that_the_log_limits(clean, tmp_path):
    write_csv(with_sent(clean, lambda sent: np.clip(sent, -0.4, 0.4, out=sent)), tmp_path / "drive.csv")
    found = import_csv(tmp_path / "drive.csv").report.of("limited_commands")
    assert [f.channel for f in found] == ["steering", "throttle"]
    assert "log the commands that the car executes" in found[0].sentence


def test_a_driver_who_keeps_to_a_limit_is_no_fault():
    limited = Car(command_limit=0.4).drive()
    assert np.mean(np.abs(limited.sent[:, 0]) == 0.4) > 0.1
    assert check([limited], [], NOMINAL)[2] == []


@pytest.mark.parametrize(("factor", "where"), [(1.2, "too far apart"), (0.5, "too close together")])
def test_one_factor_of_all_velocities_is_a_wrong_frame_rate(clean, factor, where):
    stretched = replace(clean, times_s=clean.times_s * factor)
    (fit,), _, (fault,) = check([stretched], [], NOMINAL)
    assert (fault.id, fault.channel) == ("wrong_frame_rate", "t, vx, vy, yaw_rate")
    assert f"probably the stamps are {where} (a wrong frame rate)" in fault.action
    remedy = re.search(r"if the stamps are wrong, multiply them by (\S+) and diagnose again", fault.action)
    assert float(remedy[1]) == pytest.approx(1.0 / factor, rel=0.01)
    np.testing.assert_allclose(fit.states[:, VX:] * factor, clean.states[:, VX:], rtol=0.02, atol=0.01)


def test_different_factors_are_faults_of_the_columns(clean):
    def scale(states: np.ndarray) -> None:
        states[:, VX:] *= [1.2, 1.2, 1.4]

    _, _, faults = check([with_states(clean, scale)], [], NOMINAL)
    assert [(f.id, f.channel) for f in faults] == [("column_scale", "vx"), ("column_scale", "yaw_rate")]


def test_audit_names_a_wrong_frame_rate(clean, tmp_path):
    write_csv(replace(clean, times_s=clean.times_s * 1.2), tmp_path / "drive.csv")
    (finding,) = import_csv(tmp_path / "drive.csv").report.of("wrong_frame_rate")
    assert "if the stamps are wrong, multiply them by 0.83" in finding.sentence
