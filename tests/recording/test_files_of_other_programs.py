"""Files of Motive and of ROS tools, which have other tables than carlab, are refused with the remedy that helps."""

import foreign_drive as foreign
import numpy as np
import pytest

from carlab.core.errors import ConfigError, DataError
from carlab.recording.audit.report import RefusedError
from carlab.recording.csv.foreign import import_csv
from carlab.recording.csv.repairing_import import import_repaired
from carlab.recording.layouts import CANONICAL, recognise_layout

MOTIVE = """Format Version,1.23,Take Name,Take 1,Export Frame Rate,120.000000,Rotation Type,Quaternion

,Type,Rigid Body,Rigid Body
,Name,car,car
Frame,Time (Seconds),X,Y
0,0.0,0.1,0.2
"""


def test_export_of_motive_is_refused_with_the_script_that_joins_the_commands(tmp_path):
    path = tmp_path / "take.csv"
    path.write_text(MOTIVE, encoding="utf-8")
    with pytest.raises(DataError, match=r"is an export of Motive.*no commands.*examples/join_logs\.py"):
        import_csv(path)


def joined_topics(n_rows=400):
    """A table as ROS tools export several topics: a row has a number in the columns of one message only."""
    columns = foreign.drive(np.arange(n_rows) / 60.0)
    is_pose = np.arange(n_rows) % 2 == 0
    return {
        name: column if name == "t" else np.where(is_pose == (name not in ("steering", "throttle")), column, np.nan)
        for name, column in columns.items()
    }


@pytest.mark.parametrize("options", [{}, {"missing": "drop"}])
def test_rows_of_different_topics_have_another_remedy_than_dropping_all_rows(tmp_path, options):
    columns = joined_topics()
    path = foreign.write(tmp_path / "bag.csv", columns)
    with pytest.raises(RefusedError) as error:
        import_csv(path, mapping=CANONICAL.with_options(**options))
    text = str(error.value)
    assert "Only 0 of 400 rows have a number in each of t, x, y, yaw" in text
    assert "messages of different topics" in text
    assert "--missing drop" not in text
    assert error.value.findings[0].option == "--missing hold"
    assert len(error.value.findings) == 1
    repaired = import_repaired(path, mapping=CANONICAL.with_options(**options))
    assert [finding.id for finding in repaired.repaired] == ["joined_messages"]
    poses = np.arange(2, 400, 2)  # between the first and the last command
    np.testing.assert_allclose(repaired.episode.times_s, columns["t"][poses] - columns["t"][2], atol=1e-9)
    np.testing.assert_array_equal(repaired.episode.states[:, 0], columns["x"][poses])
    np.testing.assert_array_equal(repaired.episode.sent[:, 1], columns["throttle"][poses - 1][:-1])


def test_values_are_held_by_the_mapped_columns_and_all_others(tmp_path):
    columns = joined_topics(60)
    columns["t"][30] = np.nan
    columns["battery"] = np.where(np.arange(60) % 20 == 0, 7.0 + np.arange(60) / 60.0, np.nan)
    path = foreign.write(tmp_path / "bag.csv", columns)
    imported = import_csv(path, mapping=CANONICAL.with_options(missing="hold"))
    poses = np.setdiff1d(np.arange(2, 60, 2), [30])
    np.testing.assert_array_equal(imported.episode.states[:, 0], columns["x"][poses])
    np.testing.assert_allclose(imported.episode.extra["battery"], 7.0 + 20 * (poses // 20) / 60.0, rtol=1e-12)
    (held,) = [finding for finding in imported.report.findings if finding.id == "held_values"]
    assert held.evidence["max_age_s"] == pytest.approx(1.0 / 60.0, abs=1e-4)


def held(tmp_path, columns):
    path = foreign.write(tmp_path / "bag.csv", columns)
    return import_csv(path, mapping=CANONICAL.with_options(missing="hold"))


def test_rows_of_topics_may_follow_each_other_and_have_equal_times(tmp_path):
    """All poses precede all commands in the file; each command has the time of a pose."""
    columns = joined_topics(60)
    columns["t"][1::2] = columns["t"][0::2]
    is_command = np.isfinite(columns["throttle"])
    sorted_rows = np.argsort(is_command, kind="stable")
    episode = held(tmp_path, {name: column[sorted_rows] for name, column in columns.items()}).episode
    np.testing.assert_array_equal(episode.states[:, 0], columns["x"][0::2])
    np.testing.assert_array_equal(episode.sent[:, 1], columns["throttle"][1::2][:-1])


def test_incomplete_poses_get_no_older_coordinate_and_are_stated(tmp_path):
    columns = joined_topics(60)
    columns["y"][20] = columns["yaw"][30] = np.nan
    imported = held(tmp_path, columns)
    poses = np.setdiff1d(np.arange(2, 60, 2), [20, 30])
    np.testing.assert_array_equal(imported.episode.states[:, 1], columns["y"][poses])
    (finding,) = imported.report.of("held_values")
    assert "; 3 poses that are incomplete, or before the first or after the last value" in finding.sentence


def test_clock_that_starts_again_is_refused_if_values_are_held(tmp_path):
    columns = joined_topics(60)
    columns["t"][30:] -= columns["t"][30]
    with pytest.raises(DataError, match=r"The times of the poses in bag.csv go back; sort its rows by time, or cut it"):
        held(tmp_path, columns)


def test_text_in_a_column_of_held_values_is_refused(tmp_path):
    columns = {name: column.astype(object) for name, column in joined_topics(60).items()}
    columns["steering"][7] = "left"
    with pytest.raises(DataError, match=r"Row 8 of column 'steering' in bag.csv holds 'left', which is not a number"):
        held(tmp_path, columns)


def test_poses_without_commands_at_the_same_time_are_refused(tmp_path):
    columns = joined_topics(60)
    for name in ("steering", "throttle"):
        columns[name][6:] = np.nan
    path = foreign.write(tmp_path / "bag.csv", columns)
    with pytest.raises(DataError, match=r"bag.csv has 2 poses between .* 'steering' has the fewest numbers \(3\)"):
        import_csv(path, mapping=CANONICAL.with_options(missing="hold"))


def test_held_values_need_times():
    with pytest.raises(ConfigError, match="Held values need times"):
        CANONICAL.with_options(missing="hold", rate_hz=30.0)


def test_rows_without_a_pose_are_no_other_topic(tmp_path):
    columns = foreign.drive(np.arange(400) / 60.0)
    columns["x"][40:300] = np.nan
    with pytest.raises(RefusedError, match=r"no number in 260 of 400 rows.*--missing drop"):
        import_csv(foreign.write(tmp_path / "lost.csv", columns), mapping=CANONICAL)


def test_part_of_a_quaternion_is_not_proposed_as_yaw():
    with pytest.raises(DataError) as error:
        recognise_layout(["t", "x", "y", "qx", "qy", "qz", "qw", "steering", "throttle"], "drive.csv")
    assert "has no column yaw; it holds" in str(error.value)
    assert "compute yaw from the quaternion" in str(error.value)


def test_topics_of_which_some_stamps_coincide_are_still_different_topics(tmp_path):
    columns = joined_topics()
    complete = foreign.drive(columns["t"])
    for name, column in columns.items():
        column[100:104] = complete[name][100:104]
    path = foreign.write(tmp_path / "bag.csv", columns)
    with pytest.raises(RefusedError, match="Only 4 of 400 rows have a number in each") as error:
        import_csv(path, mapping=CANONICAL.with_options(missing="drop"))
    assert "messages of different topics" in str(error.value)


def test_commands_of_a_slow_topic_are_a_different_topic(tmp_path):
    columns = foreign.drive(np.arange(400) / 60.0)
    is_pose = np.arange(400) % 10 != 0
    for name in ("x", "y", "yaw"):
        columns[name][~is_pose] = np.nan
    for name in ("steering", "throttle"):
        columns[name][is_pose] = np.nan
    with pytest.raises(RefusedError, match="messages of different topics"):
        import_csv(foreign.write(tmp_path / "bag.csv", columns), mapping=CANONICAL)


@pytest.mark.parametrize(
    ("cell", "sentence"),
    [
        (np.nan, "Column 'x' has no number in 398 of 400 rows"),
        (1e300, "Column 'x' has too large numbers in 398 of 400"),
    ],
)
def test_lost_or_too_large_poses_are_not_messages_of_another_topic(tmp_path, cell, sentence):
    columns = foreign.drive(np.arange(400) / 60.0)
    columns["x"][2:] = cell
    with pytest.raises(RefusedError) as error:
        import_csv(foreign.write(tmp_path / "lost.csv", columns), mapping=CANONICAL)
    assert sentence in str(error.value)
    assert "topics" not in str(error.value)
