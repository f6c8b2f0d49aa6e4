"""Check a task before a car moves: types, shapes, agreement of NumPy and torch, units, start and goal."""

from __future__ import annotations

import dataclasses
import math
import numbers
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from carlab.core.errors import ConfigError
from carlab.core.geofence import as_polygon, contains
from carlab.core.keep_out import Corners, KeepOut
from carlab.core.observation import ACTION_SIZE, encode
from carlab.core.quantities import CarState, FloatArray
from carlab.core.task import Task
from carlab.core.ticks import MAX_TICKS
from carlab.experiment.episodes.time_limit import TimeLimitExceededError, time_limit

N_STARTS = 20
MAX_REWARD, MAX_SPEED_MPS, MAX_POSITION_M = 100.0, 20.0, 1000.0
"""Largest plausible reward of a tick, speed and position; larger ones have the wrong unit."""
TORCH_TOLERANCE = 1e-3
"""Relative difference of float32 from float64."""
MAX_TICK_S, TIMED_CALLS = 0.02, 5
"""Largest computation time [s] of a task in a tick, the shortest of some calls; at 30 Hz a tick has 0.033 s in all."""
MAX_CALL_S = 20.0
"""Time [s] after which a call counts as one that does not return; a first call may import a library or compile code."""
OTHER_PERIOD_S = 0.1
"""A control period other than that of carlab's tasks."""
OTHER_DEVICE = ("to numpy", "the expected device meta", "on the same device")
"""Texts of torch's errors where tensors on a device meet NumPy or tensors on the CPU."""
_METRES = "positions are in metres"
_ATTRIBUTES = (
    *("name", "history_length", "max_ticks", "cost_weight"),
    *("arena_m", "path_m", "outlines_m", "goal"),
)
_RESULT_NAMES = {"", "episode", "ticks", "return", "end_reason", "end_detail"}
"""Names of the other figures of an episode in result.json."""


def check_task(task: Task, arena_m: Corners = ()) -> None:
    """Check a task; nothing moves and nothing is written.

    Args:
        task: the task.
        arena_m: arena of the car; empty: that of the task.

    Raises:
        ConfigError: names the method or attribute, what it returned, and what it must return; or the arena of the car
            is too small for the task.
    """
    _check_attributes(task)
    starts = _starts(task)
    _check_goal_pose(task)
    _check_arena(task, starts[:, :2], arena_m)
    _check_goal(task)
    rng = np.random.default_rng(0)
    before = _features(task, starts, rng)
    after = _features(task, starts + rng.normal(0.0, (0.05, 0.05, 0.1, 0.3, 0.05, 0.3), starts.shape), rng)
    action = rng.uniform(-1.0, 1.0, (len(starts), ACTION_SIZE))
    rewards = _check_function(task, "reward", (before, action, after), bool_wanted=False)
    costs = _check_function(task, "cost", (after,), bool_wanted=False)
    ends = _check_function(task, "terminated", (before,), bool_wanted=True)
    _check_function(task, "success", (after,), bool_wanted=True)
    _check_speed(task, before[:1], action[:1], after[:1])
    if np.abs(rewards).max() > MAX_REWARD:
        raise _error(task, f"reward is {np.abs(rewards).max():.4g} in a tick; scale it so that a good tick is about 1")
    if np.ptp(rewards) == 0.0 and np.ptp(_call(task, "reward", task.reward, before, 0.5 * action, after + 0.1)) == 0.0:
        raise _error(task, "reward is the same for all states and actions, so there is nothing to learn")
    if costs.min() < 0.0:
        raise _error(task, f"cost is {costs.min():.4g}; it must not be below zero")
    if ends.any():
        raise _error(task, "terminated is true at a start of sample_start, so the episode would end at once")
    if (_call(task, "cost", task.cost, before) > 0.0).any():
        raise _error(task, "cost is above zero at a start of sample_start; move the start or the keep-out shapes")
    _check_summary(task, starts)


def _check_speed(task: Task, before: FloatArray, action: FloatArray, after: FloatArray) -> None:
    """Raise ConfigError if the functions of a tick are too slow for a control loop; arguments have one row each."""
    times_s = []
    for _ in range(TIMED_CALLS):
        began_s = time.perf_counter()
        _call(task, "reward of one row", task.reward, before, action, after)
        for name in ("cost", "terminated", "success"):
            _call(task, f"{name} of one row", getattr(task, name), after)
        times_s.append(time.perf_counter() - began_s)
    if min(times_s) > MAX_TICK_S:
        raise _error(
            task,
            f"reward, cost, terminated and success take {min(times_s) * 1e3:.0f} ms in a tick; make them faster than "
            f"{MAX_TICK_S * 1e3:.0f} ms together, so that the control loop is not late",
        )


def _error(task: Task, text: str) -> ConfigError:
    return ConfigError(f"The task {type(task).__name__} has an error: {text}.")


def _call(task: Task, name: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """The result of a function of the task. Raises ConfigError if it fails, or does not return in ``MAX_CALL_S``."""
    try:
        with time_limit(MAX_CALL_S):
            return function(*arguments)
    except TimeLimitExceededError as error:
        raise _error(
            task, f"{name} does not return within {MAX_CALL_S:g} s; look for a loop without an end, or make it faster"
        ) from error
    except (Exception, SystemExit) as error:
        raise _error(task, f"{name} raises {type(error).__name__}: {error}".rstrip(".: ")) from error


def _check_attributes(task: Task) -> None:
    shapes = _call(task, "keep_out", getattr, task, "keep_out")
    if not isinstance(shapes, (tuple, list)) or not all(isinstance(shape, KeepOut) for shape in shapes):
        raise _error(task, "keep_out must be a tuple of Disc and Polygon (carlab.core.keep_out)")
    values = {name: _call(task, name, getattr, task, name) for name in _ATTRIBUTES}
    if not isinstance(values["name"], str) or not values["name"]:
        raise _error(task, f"name is {values['name']!r}; give a text")
    for name, minimum in (("history_length", 0), ("max_ticks", 1)):
        if type(values[name]) is not int or not minimum <= values[name] <= MAX_TICKS:
            raise _error(task, f"{name} is {values[name]!r}; give a whole number from {minimum} to {MAX_TICKS}")
    weight = values["cost_weight"]
    if type(weight) not in (int, float) or not 0.0 <= weight < math.inf:
        raise _error(task, f"cost_weight is {weight!r}; give a number of at least 0")
    for name in ("arena_m", "path_m"):
        if not _are_points(values[name]):
            raise _error(task, f"{name} must be a tuple of points (x, y) in metres")
    outlines = values["outlines_m"]
    if not isinstance(outlines, (tuple, list)) or not all(map(_are_points, outlines)):
        raise _error(task, "outlines_m must be a tuple of lines, each a tuple of points (x, y) in metres")
    if not isinstance(_call(task, "at_period", task.at_period, OTHER_PERIOD_S), Task):
        raise _error(task, f"at_period({OTHER_PERIOD_S}) must return a task")
    longer = values["history_length"] + 1
    resized = _call(task, "resized", task.resized, longer)
    if not isinstance(resized, Task) or resized.history_length != longer:
        raise _error(task, f"resized({longer}) must return the task with history_length {longer}")
    if values["arena_m"]:
        as_polygon(values["arena_m"], f"arena_m of the task {type(task).__name__}")


def _are_points(points: Any) -> bool:
    """Whether a value is a tuple or list of points (x, y) of finite numbers, possibly empty."""
    return isinstance(points, (tuple, list)) and all(_is_row(point, 2) for point in points)


def _is_row(values: Any, length: int) -> bool:
    """Whether a value is a tuple or list of ``length`` finite numbers."""
    return (
        isinstance(values, (tuple, list))
        and len(values) == length
        and all(isinstance(v, numbers.Real) and math.isfinite(v) for v in values)
    )


def _starts(task: Task) -> FloatArray:
    """States of ``N_STARTS`` starts (N, 6)."""
    starts = []
    for seed in range(N_STARTS):
        start, again = (_drawn(task, "sample_start", seed) for _ in range(2))
        _drawn(task, "sample_training_start", seed)
        state = start.to_array()
        if not np.array_equal(state, again.to_array()):
            raise _error(task, "sample_start gives two starts for one seed; draw random numbers from its argument only")
        if abs(start.yaw_rad) > 2.0 * math.pi:
            raise _error(task, f"sample_start has a yaw of {start.yaw_rad:.4g}; angles are in radians")
        if start.speed_mps > MAX_SPEED_MPS:
            raise _error(task, f"sample_start has a speed of {start.speed_mps:.4g}; speeds are in m/s")
        starts.append(state)
    return np.array(starts)


def _drawn(task: Task, name: str, seed: int) -> CarState:
    """A plausible state of ``sample_start`` or ``sample_training_start``."""
    start = _call(task, name, getattr(task, name), np.random.default_rng(seed))
    if not isinstance(start, CarState):
        raise _error(task, f"{name} returns a {type(start).__name__}; return a carlab.CarState")
    if not _is_row(dataclasses.astuple(start), 6) or max(abs(start.x_m), abs(start.y_m)) > MAX_POSITION_M:
        raise _error(task, f"{name} returns {start}; give finite numbers ({_METRES})")
    return start


def _check_goal_pose(task: Task) -> None:
    goal = task.goal
    if goal is None:
        return
    if not _is_row(goal, 3):
        raise _error(task, f"goal is {goal!r}; give a tuple of x [m], y [m] and yaw [rad], or None")
    if abs(goal[2]) > 2.0 * math.pi:
        raise _error(task, f"the goal has a yaw of {goal[2]:.4g}; angles are in radians")


def _check_arena(task: Task, starts_m: FloatArray, arena_m: Corners) -> None:
    """Check that starts (N, 2), goal and path are inside the arena of the car, or of the task if the car has none."""
    goals_m = [] if task.goal is None else [task.goal[:2]]
    places_m = {"start": starts_m.tolist(), "goal": goals_m, "path": list(task.path_m)}
    outside = [
        (name, x, y)
        for name, points in places_m.items()
        for x, y in points
        if (arena_m or task.arena_m) and not contains(arena_m or task.arena_m, x, y)
    ]
    if outside and not arena_m:
        name, x, y = outside[0]
        raise _error(task, f"the {name} ({x:.4g}, {y:.4g}) is outside the arena; {_METRES}")
    if outside:
        tenths = np.round(10.0 * np.array([point for points in places_m.values() for point in points]), 6)
        needed_m = np.stack([np.floor(tenths), np.ceil(tenths)]).reshape(-1, 2) / 10.0
        raise ConfigError(
            f"The arena of the car file ({_extent(arena_m)}) is too small for the task {task.name}, whose "
            f"{' and '.join(name for name, points in places_m.items() if points)} need {_extent(needed_m)} and room to "
            f"drive; enlarge [hardware.arena] ({_METRES}, in the frame of motion capture), or choose another task."
        )


def _extent(points_m: Any) -> str:
    """Text of the smallest rectangle around points (N, 2) [m]."""
    low, high = np.min(points_m, axis=0) + 0.0, np.max(points_m, axis=0) + 0.0  # without a negative zero
    return f"x {low[0]:.4g} to {high[0]:.4g} m, y {low[1]:.4g} to {high[1]:.4g} m"


def _check_goal(task: Task) -> None:
    goal = task.goal
    if goal is None:
        return
    values = np.asarray(goal, dtype=np.float64)
    if any(bool(shape.contains(values[:2])) for shape in task.keep_out):
        raise _error(task, f"the goal ({values[0]:.4g}, {values[1]:.4g}) is in a keep-out shape; move one of them")
    if type(task).success is not Task.success:
        at_goal = encode(np.array([*values, 0.0, 0.0, 0.0]), np.zeros((task.history_length, ACTION_SIZE)))
        if not bool(np.all(_call(task, "success", task.success, at_goal))):
            raise _error(task, "success is false for a car at rest at the goal; check units and indices of features")


def _features(task: Task, states: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Features (N, 7 + 2 H) of states (N, 6) after random past actions."""
    history = rng.uniform(-1.0, 1.0, (len(states), task.history_length, ACTION_SIZE))
    features: FloatArray = encode(states, history)
    return features


def _check_function(task: Task, name: str, arguments: tuple[FloatArray, ...], *, bool_wanted: bool) -> FloatArray:
    """Check a function of features with one row, a batch of NumPy and a batch of torch; returns its values (N,)."""
    import torch

    function = getattr(task, name)
    copies = [a.copy() for a in arguments]
    batch = _call(task, f"{name} of a batch", function, *copies)
    if not all(np.array_equal(a, b) for a, b in zip(arguments, copies, strict=True)):
        raise _error(task, f"{name} changes its arguments; work on new arrays")
    values = _values(task, name, batch, (len(arguments[0]),), bool_wanted)
    single = np.array([
        _values(task, name, _call(task, f"{name} of one row", function, *(a[k] for a in arguments)), (), bool_wanted)
        for k in range(len(values))
    ])  # fmt: skip
    if not np.allclose(single, values):
        raise _error(task, f"{name} of a batch differs from {name} row by row; index features with [..., k]")
    tensors = [torch.from_numpy(a).float() for a in arguments]
    in_torch = _call(task, f"{name} of torch tensors (use array_api_compat.array_namespace)", function, *tensors)
    if not isinstance(in_torch, torch.Tensor):
        raise _error(task, f"{name} of torch tensors returns a {type(in_torch).__name__}; return a tensor")
    torch_values = _values(task, f"{name} of torch tensors", in_torch.detach().numpy(), values.shape, bool_wanted)
    if not bool_wanted and not np.allclose(torch_values, values, rtol=TORCH_TOLERANCE, atol=TORCH_TOLERANCE):
        raise _error(task, f"{name} differs between NumPy and torch")
    _check_device(task, name, tensors)
    return values


def _check_device(task: Task, name: str, tensors: list[Any]) -> None:
    """Check that a function of torch tensors stays on their device, which is a GPU with ``--device cuda``.

    torch's device ``meta``, whose tensors have no values, represents the GPU. There, tensors of the CPU and conversions
    to NumPy fail as on a GPU. Operations that depend on values fail too, although a GPU has them; they are not checked.
    """
    import torch

    remedy = "use the library and the device of the features (array_namespace(x), device=x.device)"
    try:
        result = _call(task, name, getattr(task, name), *(tensor.to("meta") for tensor in tensors))
    except ConfigError as error:
        if any(text in str(error) for text in OTHER_DEVICE):
            raise _error(task, f"{name} of tensors on a GPU would fail, because it mixes them with NumPy or with "
                               f"tensors on the CPU; {remedy}") from error  # fmt: skip
        return
    if not isinstance(result, torch.Tensor) or result.device.type != "meta":
        raise _error(task, f"{name} of tensors on a GPU returns a value that is not on the GPU; {remedy}")


def _values(task: Task, name: str, result: Any, shape: tuple[int, ...], bool_wanted: bool) -> FloatArray:
    """A result of a function of features as an array of the wanted shape and kind."""
    array: np.ndarray = _call(task, f"the value of {name} as an array", np.asarray, result)
    if array.shape != shape:
        features = ", ".join(map(str, (*shape, "F")))
        raise _error(task, f"{name} returns the shape {array.shape} for features of shape ({features}); "
                           f"return one value per row, {shape}")  # fmt: skip
    kind = "b" if bool_wanted else "fiu"
    if array.dtype.kind not in kind:
        wanted = "booleans" if bool_wanted else "numbers"
        raise _error(task, f"{name} returns {array.dtype}; return {wanted}")
    if not np.isfinite(array.astype(np.float64)).all():
        raise _error(task, f"{name} is not finite; avoid a division by zero or a root of a negative number")
    values: FloatArray = array.astype(np.float64)
    return values


def _check_summary(task: Task, starts: FloatArray) -> None:
    times_s = np.arange(len(starts)) / 30.0
    summary = _call(task, "summary", task.summary, times_s, starts)
    if not isinstance(summary, dict) or not all(isinstance(k, str) for k in summary):
        raise _error(task, "summary must return a dictionary of numbers by name")
    for name, value in summary.items():
        if not isinstance(value, (numbers.Real, np.bool_)) or math.isinf(
            _call(task, f"summary '{name}'", float, value)
        ):
            raise _error(task, f"summary has {value!r} under {name}; give a number (NaN: unknown)")
    if taken := sorted(_RESULT_NAMES & summary.keys()):
        raise _error(task, f"summary has '{taken[0]}', a figure that every episode has; choose another name")
    if summary.get("success") not in (0, 1):
        raise _error(task, "summary needs 'success' (1.0 or 0.0)")
    text = _call(task, "outcome", task.outcome, summary)
    if not isinstance(text, str):
        raise _error(task, f"outcome returns {text!r}; return a text")
