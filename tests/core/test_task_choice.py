"""Tasks by name and from a user's file; a run folder keeps name, track and hash, and reading it runs no code."""

import hashlib
from pathlib import Path

import pytest

from carlab.core.errors import ConfigError
from carlab.core.path_tasks import LapTask
from carlab.core.task import ObstacleParkingTask, ParkingTask
from carlab.core.task_choice import TASKS, TaskChoice, choose_task
from carlab.core.track import oval_track

USER_TASK = """
from pathlib import Path
import carlab
from carlab.core.task import Task

Path(__file__).with_name("executed").touch()

class Reach(Task):
    name = "reach"
    max_ticks = 40
    def sample_start(self, rng):
        return carlab.CarState(y_m=rng.uniform(-0.05, 0.05))
    def reward(self, features, action, next_features):
        return next_features[..., 0]

class Unfinished(Task):
    pass

class Other:
    pass
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "mine.py"
    path.write_text(USER_TASK)
    return path


def test_tasks_of_carlab_are_found_by_name() -> None:
    assert set(TASKS) == {"parking", "obstacles", "path", "laps"}
    assert choose_task("obstacles").load() == ObstacleParkingTask()
    track = oval_track(radius_m=1.2)
    assert choose_task("laps", track).load() == LapTask(track=track)
    assert all(kind().name == name for name, kind in TASKS.items())


def test_task_of_a_file_is_loaded_and_resized(file: Path) -> None:
    choice = choose_task(f"{file}:Reach")
    assert not file.with_name("executed").exists(), "choosing a task runs no code"
    task = choice.load().resized(5, 60)
    assert (task.name, task.history_length, task.max_ticks) == ("reach", 5, 60)
    assert choice.load().max_ticks == 40
    assert choice.name == "mine.py:Reach"
    assert choice.sha256 == hashlib.sha256(file.read_bytes()).hexdigest()


def test_resized_copies_of_frozen_tasks_differ_only_in_size() -> None:
    changed = ParkingTask(margin=3.0).resized(6)
    assert changed == ParkingTask(margin=3.0, history_length=6)


def test_saved_task_has_no_path_and_runs_no_code(file: Path) -> None:
    saved = choose_task(f"{file}:Reach").to_table()
    assert str(file.parent) not in str(saved)
    read = TaskChoice.from_table(saved)
    assert not file.with_name("executed").exists()
    with pytest.raises(ConfigError, match=r"name the file again: --task PATH/mine\.py:Reach"):
        read.named_again(None)
    assert read.named_again(choose_task(f"{file}:Reach")).load().name == "reach"


def test_name_of_a_file_with_a_space_is_quoted_for_the_shell(file: Path) -> None:
    saved = choose_task(f"{file.rename(file.with_name('my task.py'))}:Reach").to_table()
    with pytest.raises(ConfigError, match=r"--task 'PATH/my task\.py:Reach'"):
        TaskChoice.from_table(saved).named_again(None)


def test_changed_file_is_refused_in_a_later_run_and_during_a_run(file: Path) -> None:
    saved = choose_task(f"{file}:Reach")
    file.write_text(USER_TASK + "\n")
    with pytest.raises(ConfigError, match="differs from the one that this run was started with"):
        TaskChoice.from_table(saved.to_table()).named_again(choose_task(f"{file}:Reach"))
    with pytest.raises(ConfigError, match="was changed during the run"):
        saved.load()
    assert not file.with_name("executed").exists()


def test_another_task_or_track_is_refused_in_a_later_run() -> None:
    saved = TaskChoice.from_table(choose_task("laps", oval_track(radius_m=1.2)).to_table())
    assert saved.named_again(None) == saved.named_again(choose_task("laps")) == saved
    with pytest.raises(ConfigError, match="--task laps: this run was started with laps on another track"):
        saved.named_again(choose_task("laps", oval_track(radius_m=1.3)))
    with pytest.raises(ConfigError, match="--task parking: this run was started with laps"):
        saved.named_again(choose_task("parking"))


@pytest.mark.parametrize(
    "table",
    [
        {}, {"name": "laps"}, {"name": "mine.py:Reach", "sha256": "", "track": None},
        {"name": 3, "sha256": "", "track": None}, {"name": "parking", "sha256": "", "track": oval_track().to_table()},
        {"name": "laps", "sha256": "", "track": {"centre_line_m": [[0, 0]], "width_m": 1}},
        {"name": "laps", "sha256": "", "track": 5},
    ],
)  # fmt: skip
def test_malformed_saved_task_is_refused(table: dict[str, object]) -> None:
    with pytest.raises((KeyError, TypeError, ValueError)):
        TaskChoice.from_table(table)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("driving", "choose one of parking, obstacles, path, laps, or FILE.py:CLASS"),
        ("mine.py", "add the name of the class, for example mine.py:MyTask"),
        ("mine.py:", "choose one of"),
        ("missing.py:Reach", "cannot be read"),
    ],
)
def test_unknown_task_is_refused(name: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        choose_task(name)


@pytest.mark.parametrize(
    ("source", "name", "message"),
    [
        (USER_TASK, "Nothing", "has no class Nothing; it has Reach, Unfinished, Other"),
        (USER_TASK, "Other", "Other in .* is not derived from carlab.core.task.Task; write .class Other.Task.:"),
        (USER_TASK, "Unfinished", "Unfinished.. fails: TypeError: .*reward"),
        ("def", "Reach", "cannot be loaded: SyntaxError"),
        ("import nothing_of_this_name", "Reach", "cannot be loaded: ModuleNotFoundError"),
        ("raise SystemExit(3)", "Reach", "cannot be loaded: SystemExit: 3"),
    ],
)
def test_broken_file_is_refused_with_one_sentence(file: Path, source: str, name: str, message: str) -> None:
    file.write_text(source)
    with pytest.raises(ConfigError, match=message) as error:
        choose_task(f"{file}:{name}").load()
    assert "\n" not in str(error.value)


def test_track_needs_laps() -> None:
    with pytest.raises(ConfigError, match="--track needs --task laps"):
        choose_task("path", oval_track())
