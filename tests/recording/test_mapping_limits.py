"""Declarations of a mapping that would replace or confuse data are refused in one sentence with the remedy."""

from dataclasses import replace

import foreign_drive as foreign
import numpy as np
import pytest

import carlab
from carlab.core.errors import ConfigError, DataError
from carlab.recording.column_mapping import load_mapping
from carlab.recording.csv.foreign import import_csv
from carlab.recording.layouts import CANONICAL, DART_ONBOARD, recognise_layout


@pytest.fixture(scope="module")
def drive():
    """Ten seconds at 30 Hz."""
    return foreign.drive(np.arange(301) / 30.0)


@pytest.mark.parametrize("option", ["command_lag", "velocity_lag"])
@pytest.mark.parametrize("lag_s", [50.0, -5.0, 1e9, 1e300, float("inf"), float("nan")])
def test_lag_in_milliseconds_is_refused(option, lag_s):
    with pytest.raises(ConfigError, match=rf"{option} is .* at most 1 s; give it in seconds"):
        replace(CANONICAL, **{f"{option}_s": lag_s})


@pytest.mark.parametrize(("rows", "is_refused"), [(301, False), (291, True)])
def test_command_lag_is_at_most_a_tenth_of_the_recording(drive, tmp_path, rows, is_refused):
    path = foreign.write(tmp_path / "run.csv", {name: column[:rows] for name, column in drive.items()})
    mapping = CANONICAL.with_options(command_lag_s=0.99)
    if is_refused:
        with pytest.raises(DataError, match=r"lag of 0.99 s exceeds 10% of the recording \(9.67 s\).*--command-lag"):
            import_csv(path, mapping=mapping)
        return
    sent = import_csv(path, mapping=mapping).episode.sent
    # The command of 0.99 s later is that of the 29th row after, which is held until the 30th.
    np.testing.assert_array_equal(sent[: rows - 30, 0], drive["steering"][29 : rows - 1])


@pytest.mark.parametrize(("channel", "column"), [("y", "x"), ("throttle", "steering")])
def test_one_column_for_two_channels_is_refused(channel, column):
    with pytest.raises(ConfigError, match=rf"takes {column} and {channel} from the same column '{column}'"):
        CANONICAL.with_options(columns={channel: {"name": column}})


def test_channels_may_exchange_their_columns(drive, tmp_path):
    path = foreign.write(tmp_path / "run.csv", {**drive, "x": drive["y"], "y": drive["x"]})
    exchanged = CANONICAL.with_options(columns={"x": {"name": "y"}, "y": {"name": "x"}})
    states = import_csv(path, mapping=exchanged).episode.states
    np.testing.assert_array_equal(states[:, :2], np.column_stack([drive["x"], drive["y"]]))


def test_channel_as_throttle_gate_is_refused():
    with pytest.raises(ConfigError, match="takes throttle and throttle_gate from the same column 'throttle'"):
        CANONICAL.with_options(throttle_gate="throttle")


def test_text_in_the_throttle_gate_is_refused_with_its_row(drive, tmp_path):
    gate = np.ones(len(drive["t"])).astype(object)
    gate[4] = "on"
    path = foreign.write(tmp_path / "run.csv", {**drive, "gate": gate})
    with pytest.raises(DataError, match=r"Row 5 of column 'gate' in run.csv holds 'on'"):
        import_csv(path, mapping=CANONICAL.with_options(throttle_gate="gate"))


def test_clock_cannot_be_rebuilt_without_a_pose(tmp_path):
    t_s = np.arange(301) / 30.0
    named = foreign.drive(t_s)
    columns = {source.name: named[channel] for channel, source in DART_ONBOARD.columns.items()}
    path = foreign.write(tmp_path / "run.csv", {**columns, "vy": named["vy"], "safety_value": np.ones(301)})
    mapping = DART_ONBOARD.with_options(columns={"vy": {"name": "vy"}}, clock="velocity")
    with pytest.raises(DataError, match="cannot be rebuilt without x, y, vx and vy columns; use --clock column"):
        import_csv(path, mapping=mapping)


def test_reference_that_is_no_text_is_refused(tmp_path):
    path = tmp_path / "map.toml"
    path.write_text('references = {encoder = 5}\n[columns]\nt = "t"\n')
    with pytest.raises(ConfigError, match=r"The reference 'encoder' of mapping .* is 5; name the channel"):
        load_mapping(path)


@pytest.mark.parametrize("factor", [1e-9, 1e-300, 1.0 / 86_400.0])
def test_stamps_that_are_closer_than_any_samples_are_refused(drive, tmp_path, factor):
    """The last factor gives days."""
    path = foreign.write(tmp_path / "run.csv", {**drive, "t": drive["t"] * factor})
    with pytest.raises(DataError, match=r"Column 't': rows are .* s apart.*--t-unit, or convert"):
        import_csv(path)


@pytest.mark.parametrize("rate_hz", [1e300, float("inf"), float("nan"), 0.0])
def test_rate_that_no_sensor_has_is_refused(rate_hz):
    with pytest.raises(ConfigError, match=r"give a number above zero, at most 100000\."):
        replace(CANONICAL, rate_hz=rate_hz)


def test_rate_replaces_the_time_column_of_a_known_layout(drive, tmp_path):
    columns = {name: column for name, column in drive.items() if name != "t"}
    path = foreign.write(tmp_path / "run.csv", columns)
    episode = carlab.load(path, rate=30.0).episode
    np.testing.assert_allclose(episode.times_s, drive["t"], rtol=0.0, atol=1e-12)
    np.testing.assert_array_equal(episode.states[:, 0], drive["x"])
    with pytest.raises(DataError, match=r"has no column t; .*; give the rate of the rows with --rate, say which"):
        carlab.load(path)
    columns["yaw_deg"] = columns.pop("yaw")
    named = foreign.write(tmp_path / "named.csv", columns)
    with pytest.raises(DataError, match=r"has no column yaw \(is it 'yaw_deg'\?\); .*; say which"):
        carlab.load(named, rate=30.0)
    with pytest.raises(ConfigError, match="'rate_hz' in the mapping's options must be a number, not 'fast'"):
        carlab.load(path, rate="fast")


@pytest.mark.parametrize("name", ["field.pose.orientation.w", "qw", "q_w", "rotation_w", "Quat W"])
def test_quaternion_instead_of_yaw_has_the_formula_as_remedy(name):
    header = ["t", "x", "y", name, "steering", "throttle"]
    with pytest.raises(DataError, match=r"has no column yaw.*compute yaw from the quaternion as atan2\(2 \(w z"):
        recognise_layout(header, "drive.csv")


@pytest.mark.parametrize("channel", ["x", "y", "yaw"])
def test_column_of_another_channel_is_not_proposed_for_a_missing_one(channel):
    header = [name for name in CANONICAL.columns if name != channel]
    with pytest.raises(DataError) as error:
        recognise_layout(header, "drive.csv")
    assert f"has no column {channel}; " in str(error.value)


def test_other_columns_are_no_quaternion():
    with pytest.raises(DataError) as error:
        recognise_layout(["t", "x", "y", "view", "raw", "steering", "throttle"], "drive.csv")
    assert "quaternion" not in str(error.value)
