"""Rewards and encoder: closed forms, and agreement of NumPy and torch."""

import math

import numpy as np
import pytest
import torch

from carlab.core.errors import ConfigError
from carlab.core.geofence import contains
from carlab.core.keep_out import Disc, Polygon
from carlab.core.observation import ActionHistory, decode_history, decode_state, encode, feature_size
from carlab.core.path_tasks import LapTask, PathTask, figure_eight_path
from carlab.core.quantities import Action, CarState
from carlab.core.task import ObstacleParkingTask, ParkingTask, Task


def features_of(states: np.ndarray, history: int = 3) -> np.ndarray:
    return encode(states, np.zeros((*states.shape[:-1], history, 2)))


def test_encode_and_decode_are_inverse(rng: np.random.Generator) -> None:
    states = rng.uniform(-3, 3, (50, 6))
    history = rng.uniform(-1, 1, (50, 3, 2))
    features = encode(states, history)
    assert features.shape == (50, feature_size(3)) == (50, 13)
    np.testing.assert_allclose(decode_state(features), states, atol=1e-12)
    np.testing.assert_array_equal(decode_history(features), history)
    # The layout itself: oldest action first, steering before throttle.
    np.testing.assert_allclose(features[0, 2:4], [math.sin(states[0, 2]), math.cos(states[0, 2])])
    np.testing.assert_array_equal(features[0, 7:], history[0].reshape(-1))


def test_history_keeps_the_newest_action_last() -> None:
    history = ActionHistory(3)
    for k in range(1, 6):
        history.push(Action(k / 10, -k / 10))
    np.testing.assert_allclose(history.rows[:, 0], [0.3, 0.4, 0.5])
    np.testing.assert_allclose(history.rows[-1], [0.5, -0.5])


def test_parking_reward_is_the_paper_s_closed_form() -> None:
    task = ParkingTask()
    # d <= 0.1 gives 1; d = 0.1 + margin gives 0.1; yaw counts like metres; the action costs 0.005 |a|^2.
    states = np.zeros((4, 6))
    states[1, 0] = 0.1
    states[2, 1] = 2.1
    states[3, 2] = -2.1
    actions = np.tile([1.0, -1.0], (4, 1))
    reward = task.reward(features_of(states), actions, features_of(states))
    np.testing.assert_allclose(reward, np.array([1.0, 1.0, 0.1, 0.1]) - 0.01, atol=1e-6)
    # The yaw error is wrapped to [-pi, pi).
    turned = np.zeros((1, 6))
    turned[0, 2] = 2 * math.pi - 0.05
    assert task.reward(features_of(turned), np.zeros((1, 2)), features_of(turned))[0] == pytest.approx(1.0)


@pytest.mark.parametrize("task", [ParkingTask(), ObstacleParkingTask(), PathTask(), LapTask()], ids=lambda t: t.name)
def test_sums_of_rewards_and_costs_are_the_same_at_each_control_rate(task: Task) -> None:
    """A car drives at 0.3 m/s from (0.1, -0.15) along y = -0.15, through a disc of ObstacleParkingTask."""
    sums = []
    for rate_hz in (30.0, 10.0, 60.0):
        own = task.at_period(1.0 / rate_hz)
        states = np.tile([0.1, -0.15, 0.1, 0.3, 0.0, 0.0], (own.max_ticks + 1, 1))
        states[:, 0] += 0.3 * np.arange(len(states)) / rate_hz
        features, actions = features_of(states), np.tile([0.5, 0.5], (own.max_ticks, 1))
        reward, cost = own.reward(features[:-1], actions, features[1:]), own.cost(features[1:])
        assert own.max_ticks / rate_hz == pytest.approx(task.max_ticks / 30.0, abs=0.5 / rate_hz)
        sums.append((float(reward.sum()), 0.0 if isinstance(task, (PathTask, LapTask)) else float(cost.sum())))
    assert sums[1] == pytest.approx(sums[0], rel=0.04)
    assert sums[2] == pytest.approx(sums[0], rel=0.04)


def test_a_rounded_period_of_30_hz_does_not_change_a_task() -> None:
    for task in (ParkingTask(), LapTask()):
        assert task.at_period(0.0333333333) is task
        assert task.at_period(0.033333) is task


@pytest.mark.parametrize("task", [ObstacleParkingTask(), PathTask(), LapTask()], ids=lambda task: task.name)
def test_numpy_and_torch_give_the_same_reward(task: Task, rng: np.random.Generator) -> None:
    before, after = (features_of(rng.uniform(-2, 2, (200, 6))) for _ in range(2))
    action = rng.uniform(-1, 1, (200, 2))
    expected = task.reward(before, action, after)
    tensors = [torch.tensor(a, requires_grad=True) for a in (before, action, after)]
    reward = task.reward(*tensors)
    np.testing.assert_allclose(reward.detach().numpy(), expected, atol=1e-12)
    np.testing.assert_array_equal(task.terminated(tensors[2]).numpy(), task.terminated(after))
    np.testing.assert_allclose(task.cost(tensors[2]).detach().numpy(), task.cost(after), atol=1e-12)
    assert task.cost(after).max() > 0.0
    reward.sum().backward()
    assert all(torch.isfinite(t.grad).all() for t in tensors if t.grad is not None)


def test_parking_start_matches_its_description(rng: np.random.Generator) -> None:
    task = ParkingTask()
    starts = np.array([task.sample_start(rng).to_array() for _ in range(4000)])
    assert abs(starts[:, 0] - 1.42).max() <= 0.1
    assert abs(starts[:, 1] + 1.04).max() <= 0.1
    turn = np.abs(np.abs(starts[:, 2]) - math.pi)
    assert turn.max() <= 0.1 * math.pi
    assert turn.max() > 0.09 * math.pi
    np.testing.assert_allclose(starts[:, 3:].std(axis=0), [0.005, 0.005, 0.02], rtol=0.05)
    assert abs(np.corrcoef(starts[:, 0], starts[:, 1])[0, 1]) < 0.06


@pytest.mark.parametrize(
    ("final", "parked"),
    [
        (CarState(0.19, 0.0, 0.3, 0.2), True),
        (CarState(0.21, 0.0, 0.0), False),
        (CarState(0.0, 0.0, 0.36), False),
        (CarState(0.0, 0.0, 2 * math.pi - 0.3), True),
        (CarState(0.0, 0.0, 0.0, 0.22, 0.22), False),
    ],
)
def test_parked_requires_position_heading_and_speed(final: CarState, parked: bool) -> None:
    task = ParkingTask()
    assert bool(task.summary(np.zeros(1), final.to_array()[None])["success"]) is parked
    assert bool(task.success(features_of(final.to_array()[None]))[0]) is parked


def test_progress_along_a_circle_is_its_arc_length() -> None:
    angles = np.linspace(0, 2 * math.pi, 720, endpoint=False)
    circle = tuple((float(np.cos(a)), float(np.sin(a))) for a in angles)
    task = PathTask(points_m=circle, speed_mps=1.0, period_s=0.1, action_cost=0.0)
    states = np.zeros((3, 6))
    for row, angle in enumerate((0.3, 0.4, -0.05)):
        states[row, :2] = np.cos(angle), np.sin(angle)
    features = features_of(states)
    forward = task.reward(features[0:1], np.zeros((1, 2)), features[1:2])[0]
    assert forward == pytest.approx(1.0, rel=1e-3)
    # Across the closing point, backwards: an arc of 0.35 rad.
    back = task.reward(features[0:1], np.zeros((1, 2)), features[2:3])[0]
    assert back == pytest.approx(-3.5, rel=1e-3)


def test_crossing_of_the_path_gives_no_extra_progress() -> None:
    task = PathTask()
    path = np.array(figure_eight_path(1.2))
    # Just before and after the crossing at half a lap: progress is one step, not half a lap.
    middle = len(path) // 2
    states = np.zeros((2, 6))
    states[:, :2] = path[[middle - 1, middle + 1]]
    features = features_of(states)
    step = np.hypot(*(path[middle + 1] - path[middle])) + np.hypot(*(path[middle] - path[middle - 1]))
    reward = task.reward(features[:1], np.zeros((1, 2)), features[1:])[0]
    assert reward == pytest.approx(step / (task.speed_mps * task.period_s), rel=1e-3)


def test_cost_behind_obstacles_is_the_kinetic_energy_inside_a_disc() -> None:
    """1.65 kg at 2 m/s have 3.3 J; two discs overlap at (0.75, -0.35)."""
    states = np.zeros((4, 6))
    states[:, :2] = [(0.75, -0.79), (0.75, -0.81), (1.01, 0.65), (0.75, -0.35)]
    states[:, 3], states[:, 4] = 1.2, 1.6
    cost = ObstacleParkingTask().cost(features_of(states))
    np.testing.assert_allclose(cost, [3.3, 0.0, 0.0, 6.6])


def test_start_and_goal_of_obstacle_parking_cost_nothing_and_the_straight_line_does(rng: np.random.Generator) -> None:
    task = ObstacleParkingTask()
    starts = np.array([task.sample_start(rng).to_array() for _ in range(100)])
    assert not task.cost(features_of(starts)).any()
    line = np.linspace([1.42, -1.04, 0, 1, 0, 0], [0, 0, 0, 1, 0, 0], 50)
    assert task.cost(features_of(line)).max() > 0.5


def test_training_starts_of_obstacle_parking_are_outside_the_discs(rng: np.random.Generator) -> None:
    task = ObstacleParkingTask()
    states = np.array([task.sample_training_start(rng).to_array() for _ in range(300)])
    x, y = states[:, 0], states[:, 1]
    assert min(np.hypot(x - 0.75, y - c).min() for c in (-0.55, -0.15, 0.25, 0.65)) >= 0.25
    assert (x.min(), x.max(), y.min(), y.max()) == pytest.approx((-1.0, 2.4, -2.2, 1.1), abs=0.1)
    assert np.abs(states[:, 2]).max() > 2.8


def test_polygon_contains_the_points_that_the_geofence_contains(rng: np.random.Generator) -> None:
    corners = ((-1.0, -1.5), (2.0, -1.5), (2.0, 0.5), (0.5, 0.5), (0.5, -0.5), (-1.0, -0.5))
    points = rng.uniform(-2.5, 2.5, (400, 2))
    expected = [contains(corners, float(x), float(y)) for x, y in points]
    assert 50 < sum(expected) < 350
    assert Polygon(corners).contains(points).tolist() == expected
    assert Polygon(corners).contains(torch.from_numpy(points)).tolist() == expected
    radii = np.hypot(*(points - [0.3, 0.4]).T)
    np.testing.assert_array_equal(Disc(0.3, 0.4, 1.0).contains(points), radii < 1.0)


def test_default_cost_counts_the_shapes_that_are_entered() -> None:
    class Field(Task):
        keep_out = (Disc(0.0, 0.0, 1.0), Polygon(((0.0, -1.0), (2.0, -1.0), (2.0, 1.0), (0.0, 1.0))))

        def sample_start(self, rng: np.random.Generator) -> CarState:
            return CarState(-2.0)

        def reward(self, features: np.ndarray, action: np.ndarray, next_features: np.ndarray) -> np.ndarray:
            return next_features[..., 0]

    states = np.zeros((4, 6))
    states[:, 0] = [-2.0, -0.5, 0.5, 1.5]
    assert Field().cost(features_of(states)).tolist() == [0.0, 1.0, 2.0, 1.0]
    assert Field().has_constraint
    assert not ParkingTask().has_constraint


def test_task_whose_ticks_are_a_property_has_its_own_ticks_only() -> None:
    class Timed(Task):
        max_ticks = property(lambda self: 30)  # type: ignore[assignment]

        def sample_start(self, rng: np.random.Generator) -> CarState:
            return CarState()

        def reward(self, features: np.ndarray, action: np.ndarray, next_features: np.ndarray) -> np.ndarray:
            return next_features[..., 0]

    assert (Timed().resized(5).history_length, Timed().resized(5).max_ticks) == (5, 30)
    with pytest.raises(ConfigError, match=r"cannot set max_ticks of the task task to 40 .*; make it an attribute of"):
        Timed().resized(5, 40)
