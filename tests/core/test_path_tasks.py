"""Tracks and laps against circles and ovals with known lengths, widths and lap times."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from carlab.core.errors import ConfigError
from carlab.core.observation import encode
from carlab.core.path_tasks import LapTask, lap_times
from carlab.core.track import ClosedPath, Track, oval_track, read_track, track_from_table


def circle_states(angles: np.ndarray, radius_m: float) -> np.ndarray:
    states = np.zeros((len(angles), 6))
    states[:, 0], states[:, 1] = radius_m * np.cos(angles), radius_m * np.sin(angles)
    states[:, 2], states[:, 3] = angles + math.pi / 2, 1.0
    return states


def circle_track(radius_m: float = 2.0, width_m: float = 0.6, points: int = 360) -> Track:
    angles = np.linspace(0, 2 * math.pi, points, endpoint=False)
    return Track(tuple((float(radius_m * np.cos(a)), float(radius_m * np.sin(a))) for a in angles), (width_m,) * points)


def features(states: np.ndarray) -> np.ndarray:
    return encode(states, np.zeros((len(states), 3, 2)))


def test_oval_has_its_closed_form_length_and_is_driven_counter_clockwise() -> None:
    track = oval_track(straight_m=2.0, radius_m=1.0, width_m=0.7, spacing_m=0.01)
    assert track.path.length_m == pytest.approx(4.0 + 2.0 * math.pi, rel=1e-4)
    x, y = np.array(track.centre_line_m).T
    area = 0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))
    assert area == pytest.approx(2.0 * 2.0 + math.pi, rel=1e-3)
    assert track.centre_line_m[0] == pytest.approx((0.0, -1.0), abs=1e-9)


def test_borders_are_half_a_width_from_the_centre_line() -> None:
    left, right = circle_track(2.0, 0.6).borders_m
    np.testing.assert_allclose(np.hypot(*np.array(left).T), 1.7, atol=1e-6)
    np.testing.assert_allclose(np.hypot(*np.array(right).T), 2.3, atol=1e-6)


def test_width_between_two_points_is_interpolated() -> None:
    path = ClosedPath(((0.0, 0.0), (4.0, 0.0), (4.0, 3.0)), (1.0, 2.0, 1.0))
    at = path.project(np.array([[1.0, 0.2], [4.5, 1.5]]))
    np.testing.assert_allclose(at.arc_m, [1.0, 5.5])
    np.testing.assert_allclose(at.distance_m, [0.2, 0.5], atol=1e-9)
    np.testing.assert_allclose(at.value_m, [1.25, 1.5])


def test_reward_is_progress_and_the_limit_is_half_the_width() -> None:
    task = LapTask(track=circle_track(2.0, 0.6), action_cost=0.0)
    states = circle_states(np.array([0.1, 0.12, 0.12]), 2.0)
    forward = task.reward(features(states[:1]), np.zeros((1, 2)), features(states[1:2]))[0]
    assert forward == pytest.approx(0.02 * 2.0 * 30.0, rel=1e-3), "1.2 m/s is 1.2 a tick"
    for radius_m, outside in ((2.29, False), (2.31, True), (1.71, False), (1.69, True)):
        rows = features(circle_states(np.array([1.0]), radius_m))
        assert bool(task.terminated(rows)[0]) is outside
        assert task.cost(rows).tolist() == [float(outside)]
        assert bool(task.terminated(torch.from_numpy(rows).float())[0]) is outside


def test_lap_times_are_those_of_a_circle_at_constant_rate() -> None:
    """Laps of 2.5 s; the drive starts 0.1 rad before the line and has two complete laps."""
    times_s = np.arange(0, 5.6, 1 / 30) + 7.0
    angles = 2 * math.pi / 2.5 * (times_s - 7.0) - 0.1
    task = LapTask(track=circle_track())
    summary = task.summary(times_s, circle_states(angles, 2.1))
    assert summary["best_lap_s"] == pytest.approx(2.5, abs=2e-3)
    assert summary["laps"] == pytest.approx(angles[-1] / (2 * math.pi), abs=1e-3)
    assert summary["max_offset_m"] == pytest.approx(0.1, abs=1e-3)
    assert summary["success"] == 1.0
    assert task.outcome(summary) == f"{summary['laps']:.2f} laps, best 2.50 s"


@pytest.mark.parametrize(("end", "radius_m"), [(0.9, 2.0), (1.2, 2.4)])
def test_incomplete_lap_or_a_left_track_is_no_success(end: float, radius_m: float) -> None:
    angles = np.linspace(0, 2 * math.pi * end, 100)
    summary = LapTask(track=circle_track()).summary(np.linspace(0, 3, 100), circle_states(angles, radius_m))
    assert summary["success"] == 0.0
    assert math.isnan(summary["best_lap_s"]) == (end < 1.0)


def test_first_lap_of_a_car_that_starts_beyond_the_line_begins_at_the_line() -> None:
    """Laps of 2.5 s; the drive starts 1 rad beyond the line."""
    times_s = np.arange(0, 5.0, 1 / 30)
    states = circle_states(1.0 + 2 * math.pi / 2.5 * times_s, 2.0)
    task, after_first_passage = LapTask(track=circle_track()), times_s > 2.2
    once = task.summary(times_s[~after_first_passage], states[~after_first_passage])
    assert (math.isnan(once["best_lap_s"]), once["success"]) == (True, 0.0)
    twice = task.summary(times_s, states)
    assert (twice["best_lap_s"], twice["success"]) == (pytest.approx(2.5, abs=2e-3), 1.0)


def test_backward_laps_do_not_count() -> None:
    angles = np.linspace(0, -4 * math.pi, 200)
    summary = LapTask(track=circle_track()).summary(np.linspace(0, 5, 200), circle_states(angles, 2.0))
    assert summary["laps"] == pytest.approx(-2.0, abs=1e-3)
    assert math.isnan(summary["best_lap_s"])


def test_lap_times_interpolate_the_crossing_of_the_line() -> None:
    times_s, travelled_m = np.array([0.0, 1.0, 2.0, 3.0]), np.array([-1.0, 3.0, 11.0, 25.0])
    assert lap_times(times_s, travelled_m, 10.0) == pytest.approx([1.875 - 0.25, 2 + 9 / 14 - 1.875])


def test_start_is_at_the_line_in_driving_direction(rng: np.random.Generator) -> None:
    task = LapTask(track=oval_track())
    for _ in range(50):
        start = task.sample_start(rng)
        assert math.hypot(start.x_m, start.y_m + 0.9) < 0.08
        assert abs(start.yaw_rad) < 0.11


def test_training_starts_lie_on_the_whole_track_in_driving_direction(rng: np.random.Generator) -> None:
    task = LapTask(track=circle_track(2.0, 0.6))
    states = np.array([task.sample_training_start(rng).to_array() for _ in range(300)])
    radius_m, angle = np.hypot(states[:, 0], states[:, 1]), np.arctan2(states[:, 1], states[:, 0])
    assert np.abs(radius_m - 2.0).max() < 0.16
    assert np.histogram(angle, bins=6, range=(-math.pi, math.pi))[0].min() > 20
    error = np.angle(np.exp(1j * (states[:, 2] - angle - math.pi / 2)))
    assert 0.2 < np.abs(error).max() < 0.32
    assert states[:, 3].max() <= 1.5


def test_track_of_a_csv_file_and_of_a_table_are_equal(tmp_path: Path) -> None:
    file = tmp_path / "track.csv"
    file.write_text("# oval\nx_m, y_m, width_m\n0,0,0.5\n2,0,0.6\n2,2,0.7\n0,0,0.5\n")
    expected = Track(((0.0, 0.0), (2.0, 0.0), (2.0, 2.0)), (0.5, 0.6, 0.7))
    assert read_track(file) == expected
    file.write_text(file.read_text().replace(",", ";"))
    assert read_track(file) == expected
    file.write_text("# oval, 0,5 m\n" + file.read_text().replace(".", ","))
    assert read_track(file) == expected, "decimal commas"
    file.write_text("# oval; closed\nx,y,width\n0,0,0.5\n2,0,0.6\n2,2,0.7\n")
    assert read_track(file) == expected, "a comment does not choose the separator"
    assert track_from_table(expected.to_table(), "[track]") == expected
    assert track_from_table({"centre_line_m": [[0, 0], [2, 0], [2, 2]], "width_m": 0.5}, "").width_m == (0.5,) * 3


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "lacks the column x"),
        ("x,y\n0,0\n", "lacks the column width"),
        ("x,y,width\n0,0,a\n", "Row 2"),
        ("# oval\n\nx,y,width\n0,0,1\n\n1,0,a\n", "Row 6"),
        ("x,y,width\n0,0,1\n1,0,1\n2,0,1\n1,0,1\n", r"turns back on itself at \(0, 0\) m"),
        ("x,y,width\n0,0,1\n1,0,1\n", r"^The track .*track.csv has 2 points"),
        ("x,y,width\n0,0,1\n1,0,1\n1,0,1\n0,1,1\n", "two equal points"),
        ("x,y,width\n0,0,nan\n1,0,1\n0,1,1\n", "not finite"),
        (
            "x,y,width\n0,0,1\n1,0,1\n2,0,1\n3,0,1\n4,0,1\n5,0,1\n6,0,1\n",
            "is open: its last point is 6 m from",
        ),
        ("x,y,width\n0,0,800\n3000,0,800\n3000,3000,800\n", "in metres"),
        ("x,y,width\n0,0,0.01\n2,0,1\n0,2,1\n", "in metres"),
    ],
)
def test_invalid_track_is_refused_with_one_sentence(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "track.csv"
    file.write_text(text)
    with pytest.raises(ConfigError, match=message) as error:
        read_track(file)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "table",
    [
        3, {}, {"centre_line_m": [[0, 0], [1, 0], [0, 1]]}, {"centre_line_m": [[0, 0], [1], [0, 1]], "width_m": 1},
        {"centre_line_m": [[0, 0], [1, 0], [0, 1]], "width_m": [1, 1]}, {"width": 1},
        {"centre_line_m": [["a", 0], [1, 0], [0, 1]], "width_m": 1},
    ],
)  # fmt: skip
def test_invalid_track_table_is_refused(table: object) -> None:
    with pytest.raises(ConfigError, match="track"):
        track_from_table(table, "[track] of car.toml")
