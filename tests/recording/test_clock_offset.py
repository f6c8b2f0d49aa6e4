"""The audit finds commands whose clock differs from that of the poses by seconds, in real recordings."""

import numpy as np
import pytest

from carlab.recording.audit.report import Severity
from carlab.recording.csv.export import write_csv
from carlab.recording.csv.foreign import import_csv
from carlab.recording.faults.clock_offset import clock_offset
from carlab.recording.faults.commands import grid_motion
from carlab.recording.faults.robust import held_at
from carlab.recording.layouts import CANONICAL
from carlab.recording.pose_velocity import pose_motion


@pytest.fixture(scope="module")
def recording(shared):
    return import_csv(shared / "data" / "eth_rc_car" / "train_2.csv.gz").episode


@pytest.fixture
def late_file(recording, tmp_path):
    """Writes 60 s of the recording with each command logged ``late_s`` after it was sent."""

    def write(late_s):
        path = tmp_path / "late.csv"
        write_csv(recording, path)
        table = np.genfromtxt(path, delimiter=",", names=True)
        t_s = table["t"]
        rows = np.clip(np.searchsorted(t_s, t_s - late_s, side="right") - 1, 0, None)
        for name in ("steering", "throttle"):
            table[name] = table[name][rows]
        part = table[(t_s > t_s[0] + 30.0) & (t_s < t_s[0] + 90.0)]
        np.savetxt(path, part, delimiter=",", header=",".join(part.dtype.names), comments="", fmt="%.9g")
        return path

    return write


@pytest.mark.parametrize("late_s", [0.0, 0.3])
def test_offset_inside_the_range_of_the_delay_is_no_fault(late_file, late_s):
    report = import_csv(late_file(late_s), mapping=CANONICAL).report
    assert not report.of("clock_offset")
    assert report.of("command_delay", "steering")


@pytest.mark.parametrize("late_s", [0.9, -0.8])
def test_command_lag_corrects_a_short_offset(late_file, late_s):
    path = late_file(late_s)
    report = import_csv(path, mapping=CANONICAL).report
    (finding,) = report.of("clock_offset")
    assert finding.severity is Severity.FAULT
    assert not report.of("command_delay")
    flag, value = finding.option.split()
    assert flag == "--command-lag"
    assert float(value) == pytest.approx(late_s, abs=0.15)
    corrected = import_csv(path, mapping=CANONICAL.with_options(command_lag_s=float(value))).report
    assert not corrected.of("clock_offset")
    for channel in ("steering", "throttle"):
        (delay,) = corrected.of("command_delay", channel)
        assert 0.0 < delay.evidence["delay_s"] < 0.3


@pytest.mark.parametrize(
    ("late_s", "remedy"), [(4.0, "subtract {} s from"), (-2.0, "add {} s to"), (8.0, "subtract {} s from")]
)
def test_longer_offset_is_corrected_before_the_join(late_file, late_s, remedy):
    (finding,) = import_csv(late_file(late_s), mapping=CANONICAL).report.of("clock_offset")
    assert finding.option is None
    proposed_s = 0.1 - finding.evidence["delay_s"]
    assert proposed_s == pytest.approx(late_s, abs=0.15)
    expected = remedy.format(f"{abs(round(proposed_s, 2)):g}") + " the stamps of the commands"
    assert expected in finding.sentence


def test_stamps_with_the_whole_offset_need_no_command_lag(late_file):
    """The proposed change of the stamps includes the declared lag, so both together would correct too much."""
    mapping = CANONICAL.with_options(command_lag_s=0.5)
    (finding,) = import_csv(late_file(4.0), mapping=mapping).report.of("clock_offset")
    assert 0.5 + 0.1 - finding.evidence["delay_s"] == pytest.approx(4.0, abs=0.15)
    assert "and remove --command-lag" in finding.sentence


@pytest.mark.slow
@pytest.mark.parametrize("name", ["train_1", "train_2"])
def test_detection_in_pieces_of_60_s(shared, name):
    """Two pieces of each recording, eight offsets: all are found, and none in the pieces as they are."""
    episode = import_csv(shared / "data" / "eth_rc_car" / f"{name}.csv.gz").episode
    t_s, commands = episode.times_s, np.vstack([episode.sent, episode.sent[-1:]]).T
    for start_s in (t_s[0], t_s[-1] - 60.0):
        rows = (t_s >= start_s) & (t_s <= start_s + 60.0)
        motion = pose_motion(t_s[rows], *episode.states[rows, :3].T, np.zeros(rows.sum()))
        grid = grid_motion(t_s[rows], motion, np.zeros(rows.sum()))
        for late_s in (0, 1, -1, 2, -2, 4, -4, 8, -8):
            late = [held_at(t_s, command, late_s)[rows] for command in commands]
            fault = clock_offset(grid, t_s[rows], late)
            assert (fault is not None) == (late_s != 0)
            if fault is not None:
                assert 0.1 - fault.evidence["delay_s"] == pytest.approx(late_s, abs=0.2)
