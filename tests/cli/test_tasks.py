"""Tasks on the command line: laps, obstacles and a user's file are learned; a learned policy drives again."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from carlab.cli.learn import _training_messages
from carlab.core.observation import episode_features
from carlab.core.task import ObstacleParkingTask
from carlab.core.track import oval_track
from carlab.recording.mcap.source import read_episode
from tests.helpers.command_line import Carlab, run_command

TICKS = 20
TINY = ("--ticks", TICKS, "--model-steps", 40, "--updates", 32, "--history", 1, "--no-rerun", "--episodes", 1)
SOURCE = """
import numpy as np
import carlab
from carlab.core.keep_out import Disc
from carlab.core.task import Task

class Forward(Task):
    name = "forward"
    keep_out = (Disc(0.0, 3.0, 0.5),)
    def sample_start(self, rng):
        return carlab.CarState(y_m=rng.uniform(-0.05, 0.05))
    def reward(self, features, action, next_features):
        return next_features[..., 0] - features[..., 0]
    def success(self, features):
        return features[..., 0] > 0.5

class Timed(Forward):
    @property
    def max_ticks(self):
        return 30

class Sometimes(Forward):
    def summary(self, times_s, states):
        figures = {"success": 0.0}
        return figures | ({"left_m": states[0, 1]} if states[0, 1] > 0.0 else {"right_m": -states[0, 1]})

class NumPy(Forward):
    arena_m = tuple(map(tuple, np.array([[-4, -4], [4, -4], [4, 4], [-4, 4]])))
    goal = tuple(np.array([1.0, 0.0, 0.0], dtype=np.float32))
    path_m = tuple(map(tuple, np.array([[0, 0], [1, 0], [1, 1]])))
    outlines_m = (path_m,)

class Rare(Forward):
    starts = 0
    def sample_start(self, rng):
        type(self).starts += 1
        if self.starts > 41:  # 40 starts of the check, one of the first episode
            raise ZeroDivisionError("no start")
        return super().sample_start(rng)

    def sample_training_start(self, rng):
        return super().sample_start(rng)

class Broken(Forward):
    def reward(self, features, action, next_features):
        return next_features[..., 0:1]
"""


def learn(out: Path, *options: object) -> tuple[int, str, Path]:
    code, text = run_command("learn", "--out", out, *TINY, *options)
    (folder,) = out.iterdir()
    return code, text, folder


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("user") / "mine.py"
    path.write_text(SOURCE)
    return path


@pytest.fixture(scope="module")
def user_run(tmp_path_factory: pytest.TempPathFactory, file: Path) -> tuple[int, str, Path]:
    return learn(tmp_path_factory.mktemp("runs"), "--task", f"{file}:Forward")


@pytest.fixture(scope="module")
def laps_run(tmp_path_factory: pytest.TempPathFactory) -> tuple[int, str, Path]:
    """Laps of a track in a CSV file, which is removed after the run."""
    folder = tmp_path_factory.mktemp("track")
    track = oval_track(straight_m=1.0, radius_m=1.2)
    rows = [f"{x},{y},{w}" for (x, y), w in zip(track.centre_line_m, track.width_m, strict=True)]
    (folder / "track.csv").write_text("\n".join(["x,y,width", *rows]))
    found = learn(tmp_path_factory.mktemp("runs"), "--task", "laps", "--track", folder / "track.csv")
    shutil.rmtree(folder)
    return found


def only_row(folder: Path) -> dict[str, object]:
    (row,) = json.loads((folder / "learn.json").read_text())["episodes"]
    return dict(row)


def test_task_of_a_user_is_learned(user_run: tuple[int, str, Path], file: Path) -> None:
    code, text, folder = user_run
    assert code == 0, text
    episode = read_episode(folder / "episodes" / "0001.mcap")
    assert episode.metadata["task"] == "forward"
    np.testing.assert_allclose(episode.rewards, np.diff(episode.states[:, 0]), atol=1e-9)
    row = only_row(folder)
    assert row["success"] is bool(episode.states[-1, 0] > 0.5)
    assert (row["cost"], row["violations"], row["distance_m"]) == (0.0, 0.0, None)
    saved = (folder / "campaign.json").read_text()
    assert "mine.py:Forward" in saved
    assert str(file.parent) not in saved
    assert "def reward" not in saved
    assert (folder / "learn.png").is_file()


def test_run_of_a_user_s_task_is_resumed_only_with_the_same_file(
    carlab: Carlab, user_run: tuple[int, str, Path], file: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "run"
    shutil.copytree(user_run[2], folder)
    code, text = carlab("learn", "--resume", folder)
    assert code == 2
    assert "name the file again: --task PATH/mine.py:Forward" in text
    other = tmp_path / "mine.py"
    other.write_text(SOURCE.replace("0.5", "0.6"))
    code, text = carlab("learn", "--resume", folder, "--task", f"{other}:Forward")
    assert code == 2
    assert "differs from the one that this run was started with" in text
    code, text = carlab("learn", "--resume", folder, "--task", f"{file}:Forward", "--episodes", 2)
    assert code == 0
    assert "episode 2: return" in text


def test_wrong_task_is_refused_before_anything_is_written(carlab: Carlab, file: Path, tmp_path: Path) -> None:
    for verb in ("learn", "drive", "check"):
        options = () if verb == "check" else ("--out", tmp_path / "runs")
        code, text = carlab(verb, "--task", f"{file}:Broken", *options)
        assert code == 2
        assert "The task Broken has an error: reward returns the shape" in text
    assert not (tmp_path / "runs").exists()


def test_ticks_of_a_task_with_its_own_number_are_refused_before_the_training(
    carlab: Carlab, file: Path, tmp_path: Path
) -> None:
    code, text = carlab("learn", "--task", f"{file}:Timed", "--ticks", 20, "--out", tmp_path / "runs")
    assert code == 2
    assert "A run cannot set max_ticks of the task forward to 20" in text
    assert not (tmp_path / "runs").exists()


def test_check_of_a_correct_task(carlab: Carlab, file: Path) -> None:
    code, text = carlab("check", "--task", f"{file}:Forward", "--seconds", 0.2)
    assert code == 0
    assert "No error found in the task." in text


def test_laps_report_laps_and_track_limits(laps_run: tuple[int, str, Path]) -> None:
    code, text, folder = laps_run
    assert code == 0, text
    row = only_row(folder)
    figures = row["task_figures"]
    assert isinstance(figures, dict)
    assert figures["laps"] < 0.5
    assert figures["best_lap_s"] is None
    assert "laps" in text
    assert row["success"] is False
    episode = read_episode(folder / "episodes" / "0001.mcap")
    assert len(json.loads(episode.metadata["outlines_m"])) == 2


def test_learned_policy_drives_again_on_another_car(
    carlab: Carlab, laps_run: tuple[int, str, Path], tmp_path: Path
) -> None:
    """The track is in the run's folder."""
    code, text = carlab(
        "drive", "--policy", laps_run[2], "--out", tmp_path, "--no-rerun", "--no-picture", "--episodes", 2,
        "--vehicle", "eth_rc_car",
    )  # fmt: skip
    assert code == 0, text
    assert "best lap" in text
    (folder,) = tmp_path.iterdir()
    episode = read_episode(folder / "episodes" / "0001.mcap")
    assert episode.metadata["policy"] == "sac"
    assert episode.metadata["task"] == "laps"
    assert episode.metadata["history_length"] == "1"
    assert episode.ticks <= TICKS
    arena = np.array(json.loads(episode.metadata["arena_m"]))
    code, text = carlab("drive", "--policy", laps_run[2], "--car", "dart_jetracer", "--out", tmp_path)
    assert code == 2
    assert "was trained with a control period of 0.03333 s, the car has 0.1 s" in text
    assert arena[:, 0].max() == pytest.approx(0.5 + 1.2 + 1.5, abs=0.05)


def test_policy_folder_that_is_no_run_is_refused(
    carlab: Carlab, laps_run: tuple[int, str, Path], user_run: tuple[int, str, Path], tmp_path: Path
) -> None:
    (tmp_path / "empty").mkdir()
    run_folder = tmp_path / "run"
    shutil.copytree(laps_run[2], run_folder)
    (run_folder / "models" / "0001" / "policy.npz").write_bytes(b"cposix\nmkdir\n(V/nonexistent/x\ntR.")
    options = ("--out", tmp_path / "runs")
    for policy, code_wanted, message in (
        ("flying", 2, "--policy flying: choose one of parking, excitation, neutral"),
        ("mine.py", 2, "A policy of your own is an object in a Python script"),
        (tmp_path / "nothing", 2, "nothing: this folder does not exist; name the folder of a run."),
        (tmp_path / "empty", 1, "is not the folder of a run of carlab learn"),
        (run_folder, 1, "cannot be read"),
        (user_run[2], 2, "name the file again: --task PATH/mine.py:Forward"),
    ):
        code, text = carlab("drive", "--policy", policy, *options)
        assert code == code_wanted
        assert message in text
    (run_folder / "models" / "0001").rename(run_folder / "models" / "\N{SUPERSCRIPT TWO}")
    code, text = carlab("drive", "--policy", run_folder, *options)
    assert code == 1
    assert "has no policy" in text
    assert not (tmp_path / "runs").exists()


def test_figures_that_only_some_episodes_have_are_printed(carlab: Carlab, file: Path, tmp_path: Path) -> None:
    options = ("--policy", "neutral", "--episodes", 4, "--ticks", 3, "--no-rerun", "--no-picture")
    code, text = carlab("drive", "--task", f"{file}:Sometimes", *options, "--out", tmp_path)
    assert code == 0
    assert {"left", "right"} <= set(text.split())
    (folder,) = tmp_path.iterdir()
    rows = json.loads((folder / "result.json").read_text())["episodes"]
    assert {name for row in rows for name in row} >= {"left_m", "right_m"}, "both kinds of episodes were driven"
    assert all(("left_m" in row) != ("right_m" in row) for row in rows)


def test_error_of_a_start_ends_the_run_with_one_sentence(carlab: Carlab, file: Path, tmp_path: Path) -> None:
    options = ("--policy", "neutral", "--episodes", 3, "--ticks", 3, "--no-rerun", "--no-picture")
    code, text = carlab("drive", "--task", f"{file}:Rare", *options, "--out", tmp_path)
    assert code == 2
    assert "The task forward cannot draw a start (ZeroDivisionError: no start); correct its sample_start." in text
    assert "has the episode before, see result.json" in text


def test_numbers_of_numpy_in_a_task_are_recorded(carlab: Carlab, file: Path, tmp_path: Path) -> None:
    code, text = carlab("drive", "--task", f"{file}:NumPy", "--policy", "neutral", "--ticks", 3, "--out", tmp_path)
    assert code == 0, text
    (folder,) = tmp_path.iterdir()
    metadata = read_episode(folder / "episodes" / "0001.mcap").metadata
    assert json.loads(metadata["arena_m"]) == [[-4.0, -4.0], [4.0, -4.0], [4.0, 4.0], [-4.0, 4.0]]
    assert json.loads(metadata["goal"]) == [1.0, 0.0, 0.0]
    assert json.loads(metadata["outlines_m"]) == [json.loads(metadata["path_m"])] == [[[0, 0], [1, 0], [1, 1]]]


def test_message_about_longer_episodes_names_no_task() -> None:
    (message,) = _training_messages({"needed_ticks": 150})
    assert "Start a run with --ticks 150" in message
    assert "park" not in message


def test_parking_policy_is_refused_for_laps(carlab: Carlab, tmp_path: Path) -> None:
    code, text = carlab("drive", "--task", "laps", "--out", tmp_path / "runs")
    assert code == 2
    assert "The parking policy only parks; choose another --policy for --task laps." in text


def test_violations_are_reported_beside_return(carlab: Carlab, tmp_path: Path) -> None:
    """The parking policy ignores the discs; the cost is that of the recorded states."""
    code, text = carlab("drive", "--task", "obstacles", "--out", tmp_path, "--no-rerun")
    assert code == 0, text
    (folder,) = tmp_path.iterdir()
    (row,) = json.loads((folder / "result.json").read_text())["episodes"]
    episode = read_episode(folder / "episodes" / "0001.mcap")
    x, y, _, vx, vy, _ = episode.states[1:].T
    inside = sum((np.hypot(x - 0.75, y - c) < 0.25).astype(float) for c in (-0.55, -0.15, 0.25, 0.65))
    assert row["violations"] == np.count_nonzero(inside) > 0
    assert row["cost"] == pytest.approx(np.sum(inside * 0.5 * 1.65 * (vx**2 + vy**2)))
    assert f" {row['cost']:.2f} {row['violations']:.0f} " in text
    features = episode_features(episode.states, episode.sent, 3)
    assert ObstacleParkingTask().cost(features[1:]).sum() == pytest.approx(row["cost"])


def test_track_of_the_car_file_is_driven(carlab: Carlab, tmp_path: Path) -> None:
    car = tmp_path / "car.toml"
    track = oval_track(straight_m=1.0, radius_m=1.3)
    points = [list(p) for p in track.centre_line_m]
    car.write_text(f"[vehicle]\nmass = 1.6\n\n[track]\ncentre_line_m = {points}\nwidth_m = 0.9\n")
    options = ("--policy", "neutral", "--ticks", 5, "--out", tmp_path / "runs", "--no-rerun", "--no-picture")
    code, text = carlab("drive", "--car", car, "--task", "laps", *options)
    assert code == 0, text
    (folder,) = (tmp_path / "runs").iterdir()
    path = json.loads(read_episode(folder / "episodes" / "0001.mcap").metadata["path_m"])
    np.testing.assert_allclose(path, points)


@pytest.mark.parametrize(
    ("options", "is_scored"),
    [
        (("--policy", "slow_circle"), False),
        (("--policy", "excitation"), False),
        (("--policy", "slow_circle", "--task", "parking"), True),
        ((), True),
    ],
)
def test_drive_without_a_task_has_no_figures_of_parking(
    carlab: Carlab, tmp_path: Path, options: tuple[str, ...], is_scored: bool
) -> None:
    code, text = carlab("drive", *options, "--ticks", "5", "--out", tmp_path, "--no-rerun", "--no-picture")
    assert code == 0, text
    assert "episode ticks" in text
    assert all((word in text) == is_scored for word in ("return", "success", "distance"))
