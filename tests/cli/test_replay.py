"""``carlab replay`` on a simulated car: errors by part and channel, the overlay in rerun, and refusals."""

import re
from pathlib import Path

import pytest

from tests.cli.test_bad_input import canonical_csv, write
from tests.helpers.command_line import Carlab


def circle(folder: Path, seconds: float) -> Path:
    """Write an exact circle at 1 m/s as CSV."""
    return write(*canonical_csv(folder, rows=round(30 * seconds)))


def test_both_parts_and_all_channels_are_compared_with_constant_velocity(carlab: Carlab, tmp_path: Path) -> None:
    """The constant-velocity prediction is exact on a circle; the default car drives another circle."""
    code, text = carlab("replay", circle(tmp_path, 30.0), "--save", tmp_path / "drive.rrd")
    assert code == 0
    assert "whole recording (107 windows from 0.6 to 29.9 s)" in text
    assert "last 30 % (" in text
    assert text.count("constant velocity 0.0000 0.0000") == 2
    for channel in ("x [m]", "y [m]", "yaw [rad]", "vx [m/s]", "vy [m/s]", "yaw_rate [rad/s]"):
        assert channel in text
    assert (tmp_path / "drive.rrd").stat().st_size > 0


def test_short_recording_is_scored_as_a_whole(carlab: Carlab, tmp_path: Path) -> None:
    code, text = carlab("replay", circle(tmp_path, 5.0))
    assert code == 0
    assert "whole recording (" in text
    assert "The last part is too short to be scored by itself." in text


def test_given_holdout_share_and_horizon_are_used(carlab: Carlab, tmp_path: Path) -> None:
    path = circle(tmp_path, 30.0)
    code, text = carlab("replay", path, "--holdout-share", "0.5", "--horizon", "0.5", "--stride", "0.5")
    assert code == 0
    assert "Error after 0.50 s, last 50 % (" in text


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--holdout-share", "0.7"), "at most 0.5"),
        (("--horizon", "60"), "shorter horizon"),
        (("--horizon", "0"), "--horizon 0: give a number above zero"),
        (("--stride", "-1"), "--stride -1: give a number above zero"),
    ],
)
def test_invalid_options_are_refused_in_one_sentence(
    carlab: Carlab, tmp_path: Path, options: tuple[str, ...], message: str
) -> None:
    code, text = carlab("replay", circle(tmp_path, 30.0), *options)
    assert code != 0
    assert message in text


def test_adaptation_to_a_car_that_turns_more_than_its_simulator_is_printed(carlab: Carlab, tmp_path: Path) -> None:
    """The default car does not drive this circle; an adapted one predicts it several times better."""
    path = circle(tmp_path, 30.0)
    code, text = carlab("replay", path, "--adapt")
    assert code == 0
    last_part = text[text.index("last 30 %") :]
    model, adapted = (float(re.findall(rf"{name} ([\d.]+)", last_part)[0]) for name in ("model", "adapted"))
    assert model > 0.1
    assert adapted < 0.3 * model
    for quantity in ("drive force [1]", "steering trim [rad]", "grip [1]", "force forward [m/s2]"):
        assert quantity in text
    assert "The noise of the adaptation was chosen on this recording" in text
    assert "adapted" not in carlab("replay", path)[1]


@pytest.mark.parametrize(
    ("seconds", "columns"),
    [("0.01", "channel end (0.03 s)"), ("0.7", "channel 0.5 s end (0.70 s)"), ("1", "channel 0.5 s 1 s end (1.00 s)")],
)
def test_difference_is_printed_only_at_times_that_the_drive_reached(
    carlab: Carlab, tmp_path: Path, seconds: str, columns: str
) -> None:
    path = circle(tmp_path, 5.0)
    code, text = carlab("replay", path, "--drive", "--seconds", seconds, "--out", tmp_path / "runs")
    assert code == 0
    assert columns in " ".join(re.sub(r"[^\w.() \[\]/]", " ", text).split())
