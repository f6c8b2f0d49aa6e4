"""The checker accepts all tasks of carlab and of the examples, and names each error of a wrong task."""

import math
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from array_api_compat import array_namespace, device

from carlab.core.errors import ConfigError
from carlab.core.geofence import rectangle
from carlab.core.keep_out import Disc
from carlab.core.quantities import CarState
from carlab.core.task import ObstacleParkingTask, Task
from carlab.core.task_choice import TASKS, choose_task
from carlab.experiment.episodes import task_check
from carlab.experiment.episodes.task_check import check_task

EXAMPLE = Path(__file__).parents[2] / "examples" / "write_task.py"


class Reach(Task):
    """A correct task."""

    name = "reach"
    arena_m = rectangle(-2.0, 4.0, -2.0, 2.0)
    goal = (1.0, 0.0, 0.0)

    def sample_start(self, rng: np.random.Generator) -> CarState:
        return CarState(y_m=float(rng.uniform(-0.05, 0.05)))

    def reward(self, features: Any, action: Any, next_features: Any) -> Any:
        return next_features[..., 0] - 0.01 * (action**2).sum(-1)

    def success(self, features: Any) -> Any:
        return abs(features[..., 0] - 1.0) < 0.1


def changed(**members: Any) -> Task:
    """A task with other members."""
    task: Task = type("Changed", (Reach,), members)()
    return task


@pytest.mark.parametrize("name", list(TASKS))
def test_tasks_of_carlab_have_no_error(name: str) -> None:
    check_task(TASKS[name]())


def test_tasks_of_the_example_and_of_this_page_have_no_error() -> None:
    check_task(Reach())
    check_task(choose_task(f"{EXAMPLE}:StopAfterOneMetre").load())


def slow(self: Task, features: Any, action: Any, next_features: Any) -> Any:
    """A reward of 25 ms, where a tick has 33 ms in all."""
    time.sleep(0.025)
    return next_features[..., 0]


def in_place(self: Task, features: Any, action: Any, next_features: Any) -> Any:
    next_features[..., 0] -= 1.0
    return next_features[..., 0]


def like(features: Any, values: Any) -> Any:
    """An array of the library of the features, but on the CPU."""
    return array_namespace(features).asarray(np.asarray(values, dtype=np.float32))


def start(**state: Any) -> Callable[[Task, np.random.Generator], CarState]:
    return lambda self, rng: CarState(**state)


WRONG: list[tuple[dict[str, Any], str]] = [
    ({"name": ""}, "name is ''"),
    ({"max_ticks": 0}, "max_ticks is 0"),
    ({"max_ticks": 10.0}, "max_ticks is 10.0"),
    (
        {"history_length": property(lambda self: 3)},
        "cannot set history_length of the task reach to 4 .* make it an attr",
    ),
    ({"resized": lambda self, history, ticks=None: self}, "must return the task with history_length 4"),
    ({"resized": lambda self, history, ticks=None: None}, "must return the task with history_length 4"),
    ({"at_period": lambda self, period_s: None}, r"at_period\(0.1\) must return a task"),
    ({"at_period": lambda self, period_s: 1 // 0}, "at_period raises ZeroDivisionError"),
    ({"goal": (100.0, 0.0, 0.0)}, "the goal .* is outside the arena; positions are in metres"),
    ({"goal": (1.0, 0.0, 90.0)}, "yaw of 90; angles are in radians"),
    ({"goal": (1.0, 0.0)}, "goal is"),
    ({"goal": (2.0, 0.0, 0.0)}, "success is false for a car at rest at the goal"),
    ({"keep_out": (Disc(0.0, 0.0, 0.3),)}, "cost is above zero at a start"),
    ({"keep_out": (Disc(1.0, 0.0, 0.3),)}, r"the goal \(1, 0\) is in a keep-out shape"),
    ({"keep_out": ((0.0, 0.0, 0.3),)}, "keep_out must be a tuple of Disc and Polygon"),
    ({"sample_start": start(x_m=150.0)}, "outside the arena"),
    ({"sample_start": start(yaw_rad=180.0)}, "yaw of 180; angles are in radians"),
    ({"sample_start": start(vx_mps=30.0)}, "speed of 30; speeds are in m/s"),
    ({"sample_start": start(x_m=math.nan)}, "give finite numbers"),
    ({"sample_start": lambda self, rng: (0.0, 0.0, 0.0)}, "returns a tuple; return a carlab.CarState"),
    ({"sample_start": lambda self, rng: CarState(np.random.default_rng().normal() / 9)}, "two starts for one seed"),
    (
        {"reward": lambda self, f, a, n: n[..., 0:1]},
        r"reward returns the shape \(20, 1\) for features of shape \(20, F\);",
    ),
    ({"reward": lambda self, f, a, n: float(np.mean(n[..., 0]))}, r"reward returns the shape \(\)"),
    ({"reward": lambda self, f, a, n: n[0] * a[0]}, "reward of a batch raises ValueError"),
    ({"reward": lambda self, f, a, n: n[:, 0]}, "reward of one row raises IndexError"),
    ({"reward": lambda self, f, a, n: np.hypot(np.asarray(n)[..., 0], 1.0)}, "return a tensor"),
    (
        {"reward": lambda self, f, a, n: np.exp(n[..., 0])},
        "reward of tensors on a GPU would fail, because it mixes them",
    ),
    (
        {"cost": lambda self, n: np.maximum(n[..., 0] - 9.0, 0.0)},
        "cost of tensors on a GPU would fail, because it mixes them with NumPy or with tensors on the CPU; use",
    ),
    (
        {"reward": lambda self, f, a, n: -((n[..., :2] - like(n, [1.0, 0.0])) ** 2).sum(-1)},
        "reward of tensors on a GPU would fail, because it mixes them with NumPy or with tensors on the CPU",
    ),
    ({"cost": lambda self, n: like(n, np.zeros(n.shape[:-1]))}, "cost of tensors on a GPU returns a value that is not"),
    ({"reward": lambda self, f, a, n: 1e5 * n[..., 0]}, "in a tick; scale it"),
    ({"reward": lambda self, f, a, n: 1.0 + 0.0 * n[..., 0]}, "nothing to learn"),
    ({"reward": lambda self, f, a, n: (n[..., 0] - 100.0) ** 0.5}, "reward is not finite"),
    ({"reward": in_place}, "reward changes its arguments"),
    ({"reward": slow}, "take [0-9]+ ms in a tick; make them faster than 20 ms"),
    ({"cost": lambda self, n: -1.0 + 0.0 * n[..., 0]}, "must not be below zero"),
    ({"terminated": lambda self, n: n[..., 0] * 0.0}, "terminated returns float64; return booleans"),
    ({"terminated": lambda self, n: n[..., 0] < 10.0}, "the episode would end at once"),
    ({"max_ticks": 10**30}, "max_ticks is 1"),
    ({"goal": 5.0}, "goal is 5.0; give a tuple"),
    ({"goal": "abc"}, "goal is 'abc'; give a tuple"),
    ({"cost_weight": math.nan}, "cost_weight is nan"),
    ({"keep_out": None}, "keep_out must be a tuple"),
    ({"arena_m": None}, "arena_m must be a tuple of points"),
    ({"path_m": ((0.0, 0.0, 0.0),)}, "path_m must be a tuple of points"),
    ({"outlines_m": ((0.0, 1.0),)}, "outlines_m must be a tuple of lines"),
    ({"max_ticks": property(lambda self: 1 // 0)}, "max_ticks raises ZeroDivisionError"),
    ({"sample_start": start(x_m="a")}, "sample_start returns .* give finite numbers"),
    ({"sample_training_start": lambda self, rng: None}, "sample_training_start returns a NoneType"),
    ({"reward": lambda self, f, a, n: sys.exit(0)}, "reward of a batch raises SystemExit: 0"),
    ({"reward": lambda self, f, a, n: [[1.0], [1.0, 2.0]]}, "the value of reward as an array raises ValueError"),
    ({"summary": lambda self, t, s: {"distance_m": 1.0}}, "summary needs 'success'"),
    ({"summary": lambda self, t, s: {"success": math.nan}}, "summary needs 'success'"),
    ({"summary": lambda self, t, s: {"success": 1.0, "return": 2.0}}, "summary has 'return', a figure"),
    ({"summary": lambda self, t, s: {"success": 1.0, "n": 10**400}}, "summary 'n' raises OverflowError"),
    ({"outcome": lambda self, s: None}, "outcome returns None"),
    ({"summary": lambda self, t, s: {"success": "yes"}}, "summary has 'yes' under success"),
    ({"summary": lambda self, t, s: 1.0 / 0.0}, "summary raises ZeroDivisionError"),
]


@pytest.mark.filterwarnings("ignore:invalid value", "ignore:__array_wrap__")
@pytest.mark.parametrize(("members", "message"), WRONG, ids=[message for _, message in WRONG])
def test_each_error_is_named_in_one_sentence(members: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message) as error:
        check_task(changed(**members))
    assert "\n" not in str(error.value)
    assert "The task Changed has an error" in str(error.value)


def test_obstacles_that_cover_the_arena_are_refused() -> None:
    with pytest.raises(ConfigError, match="the keep-out shapes cover the arena"):
        check_task(ObstacleParkingTask(obstacles=(Disc(0.0, 0.0, 10.0),)))


@pytest.mark.parametrize(
    ("task", "needed"),
    [
        (TASKS["parking"](), "start and goal need x 0 to 1.6 m, y -1.2 to 0 m"),
        (TASKS["obstacles"](), "start and goal need x 0 to 1.6 m, y -1.2 to 0 m"),
        (TASKS["laps"](), "start and path need x -1.7 to 1.7 m, y -1 to 0.9 m"),
        (changed(goal=(3.06, 0.0, 0.0), success=Task.success), "start and goal need x 0 to 3.1 m, y -0.1 to 0.1 m"),
    ],
)
def test_arena_of_the_car_that_is_too_small_is_no_error_of_the_task(task: Task, needed: str) -> None:
    with pytest.raises(ConfigError) as error:
        check_task(task, rectangle(-1.0, 1.25, -1.0, 1.0))
    text = str(error.value)
    assert text.startswith("The arena of the car file (x -1 to 1.25 m, y -1 to 1 m) is too small for the task ")
    assert f"the task {task.name}, whose {needed} and room to drive; enlarge [hardware.arena] (" in text
    assert "\n" not in text
    check_task(task, rectangle(-5.0, 5.0, -5.0, 5.0))


def test_numbers_of_numpy_in_a_summary_and_tensors_with_gradient_are_accepted() -> None:
    def reward(self: Task, features: Any, action: Any, next_features: Any) -> Any:
        value = next_features[..., 0] - 0.01 * (action**2).sum(-1)
        return value.requires_grad_() if hasattr(value, "requires_grad_") else value

    summary = {"success": np.float32(1.0), "laps": np.int64(3), "inside": np.True_, "best_lap_s": math.nan}
    check_task(changed(reward=reward, summary=lambda self, t, s: summary))


def test_values_on_the_device_of_the_features_and_operations_that_depend_on_values_are_accepted() -> None:
    def reward(self: Task, features: Any, action: Any, next_features: Any) -> Any:
        xp = array_namespace(next_features)
        target = xp.asarray([1.0, 0.0], dtype=next_features.dtype, device=device(next_features))
        return -((next_features[..., :2] - target) ** 2).sum(-1)

    def cost(self: Task, next_features: Any) -> Any:
        zeros = 0.0 * next_features[..., 0]
        return zeros + 1.0 if (next_features[..., 0] > 90.0).any() else zeros

    check_task(changed(reward=reward, cost=cost))


def test_limit_of_a_call_does_not_change_the_timer_of_the_program() -> None:
    handler, timer = signal.getsignal(signal.SIGALRM), signal.getitimer(signal.ITIMER_REAL)
    check_task(Reach())
    assert signal.getsignal(signal.SIGALRM) is handler
    assert (signal.getitimer(signal.ITIMER_REAL)[0] > 0.0) == (timer[0] > 0.0)


def busy(*arguments: Any) -> Any:
    """A loop of a minute in place of an endless one; it handles each ``Exception``."""
    end_s = time.monotonic() + 60.0
    while time.monotonic() < end_s:
        try:
            time.sleep(0.01)
        except Exception:
            continue


@pytest.mark.parametrize(
    ("name", "member", "what"),
    [
        ("reward", busy, "reward of a batch"),
        ("success", busy, "success"),
        ("sample_start", busy, "sample_start"),
        ("summary", busy, "summary"),
        ("path_m", property(busy), "path_m"),
        ("terminated", lambda self, n: busy() if n.ndim == 1 else n[..., 0] > 9.0, "terminated of one row"),
    ],
)
def test_function_that_does_not_return_is_refused(
    name: str, member: Any, what: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    check_task(Reach())  # imports torch
    monkeypatch.setattr(task_check, "MAX_CALL_S", 0.2)
    with pytest.raises(ConfigError, match=f"{what} does not return within 0.2 s; look for a loop without an end"):
        check_task(changed(**{name: member}))
