"""Rows for a model: which command belongs to which step, frames, gaps; and ridge regression against brute force."""

import dataclasses
import math

import numpy as np
import pytest

from carlab.cars import choose_car
from carlab.core.episode_data import EpisodeData
from carlab.core.errors import DataError
from carlab.core.quantities import Action
from carlab.core.task import ParkingTask
from carlab.experiment.episodes.episode import run_episode
from learning.baselines.ridge import PENALTIES, Ridge
from learning.transitions import OUTPUTS, Transitions, has_whole_step, transitions_of, velocity_delay_s


def episode(ticks=30, seed=0):
    """An episode whose numbers encode their position."""
    rng = np.random.default_rng(seed)
    sent = np.stack([np.arange(ticks) / 100.0, -np.arange(ticks) / 100.0], axis=1)
    states = rng.normal(size=(ticks + 1, 6))
    return EpisodeData(np.arange(ticks + 1) / 30.0, states, sent, sent, np.zeros(ticks))


def test_the_row_of_tick_t_ends_in_the_command_sent_at_t():
    whole = transitions_of([episode()], 3)
    assert whole.inputs.shape == (27, 3 + 8)
    assert whole.targets.shape == (27, len(OUTPUTS))
    for row, tick in zip(whole.inputs, whole.tick, strict=True):
        assert row[3:].reshape(4, 2)[:, 0] == pytest.approx([(tick - back) / 100.0 for back in (3, 2, 1, 0)])
        assert row[-1] == pytest.approx(-tick / 100.0)


def test_targets_are_changes_seen_from_the_car():
    """A car that faces north and moves north has moved ahead, one that drifts west has moved left."""
    base = episode(2)
    states = np.zeros((3, 6))
    states[0] = [1.0, 2.0, math.pi / 2, 1.0, 0.0, 0.5]
    states[1] = [0.9, 2.3, math.pi / 2 + 0.1, 1.2, 0.1, 0.4]
    states[2] = [0.9, 2.3, math.pi / 2 + 0.1 - 2 * math.pi, 1.2, 0.1, 0.4]
    whole = transitions_of([dataclasses.replace(base, states=states)], 0)
    assert whole.targets[0] == pytest.approx([0.3, 0.1, 0.1, 0.2, 0.1, -0.1])
    assert whole.targets[1] == pytest.approx(np.zeros(6), abs=1e-12)


def test_turning_and_shifting_the_room_changes_nothing():
    base = episode()
    turn, states = 1.2, base.states.copy()
    c, s = math.cos(turn), math.sin(turn)
    states[:, :2] = base.states[:, :2] @ np.array([[c, s], [-s, c]]) + [4.0, -2.0]
    states[:, 2] += turn
    ours, theirs = transitions_of([base], 2), transitions_of([dataclasses.replace(base, states=states)], 2)
    assert np.allclose(ours.inputs, theirs.inputs)
    assert np.allclose(ours.targets, theirs.targets)


def test_steps_across_gaps_and_rows_with_missing_numbers_are_left_out():
    base = episode()
    times, states = base.times_s.copy(), base.states.copy()
    times[11:] += 0.5  # between rows 10 and 11
    states[20, 3] = math.nan
    whole = transitions_of([dataclasses.replace(base, times_s=times, states=states)], 3)
    assert set(range(3, 30)) - set(whole.tick) == {10, 11, 12, 13, 19, 20}


def test_steps_across_a_jump_of_the_poses_and_from_poses_that_stood_still_are_left_out():
    base = episode()
    segment = np.where(np.arange(31) < 16, 0.0, 1.0)
    jumped = transitions_of([dataclasses.replace(base, extra={"segment": segment})], 2)
    assert jumped.tick.tolist() == [t for t in range(2, 30) if t != 15]
    # Motion capture loses the body for tick 10: it shows the pose of tick 9 again, and one two periods on at tick 11.
    age = np.full(31, 0.012)
    age[1::2] += 0.010  # cameras at 100 Hz, a control period of 33 ms: their frames come early and late
    age[10] = age[9] + base.period_s
    lost = transitions_of([dataclasses.replace(base, extra={"pose_age_s": age})], 2)
    assert lost.tick.tolist() == [t for t in range(2, 30) if t not in (9, 10)]
    untold = transitions_of([dataclasses.replace(base, extra={"pose_age_s": np.full(31, np.nan)})], 2)
    assert len(untold) == 28


def test_episodes_do_not_flow_into_each_other():
    whole = transitions_of([episode(10), episode(12, seed=1)], 4)
    assert [(whole.episode == k).sum() for k in (0, 1)] == [6, 8]
    assert whole.tick.min() == 4


@pytest.mark.parametrize(("history", "said"), [(-1, "0 or more"), (40, "shorter history")])
def test_what_makes_no_row_is_said(history, said):
    with pytest.raises(DataError, match=said):
        transitions_of([episode()], history)


def test_a_short_episode_with_a_late_stamp_has_no_whole_step():
    whole = episode(4)
    assert has_whole_step(whole, 3)
    assert not has_whole_step(dataclasses.replace(whole, times_s=np.array([0.0, 1.0, 2.0, 6.0, 7.0]) / 30.0), 3)
    assert not has_whole_step(episode(3), 3)


class TestVelocityDelay:
    """Velocities of a drive that are differences of its poses, half a period late."""

    def late(self, rate):
        ahead = 0.03 * np.sin(np.arange(60) / 9.0) + 0.05
        turn = rate / 30.0 * np.cos(np.arange(60) / 7.0)
        inputs = np.zeros((59, 5))
        inputs[:, 0], inputs[:, 2] = ahead[:-1] * 30.0, turn[:-1] * 30.0
        change = np.stack([np.diff(ahead), 0 * turn[1:], np.diff(turn)], axis=1) * 30.0
        targets = np.hstack([ahead[1:, None], 0 * turn[1:, None], turn[1:, None], change])
        index = np.arange(59)
        return velocity_delay_s(Transitions(inputs, targets, 0 * index, index, 0), 1.0 / 30.0)

    @pytest.mark.parametrize("rate", [0.0, 2.0])
    def test_it_is_half_a_period_whether_or_not_the_car_turns(self, rate):
        assert self.late(rate) == pytest.approx(0.5 / 30.0, rel=1e-6)

    def test_no_rows_tell_nothing(self):
        rows = transitions_of([episode()], 3)
        with pytest.raises(DataError, match="longer drives"):
            velocity_delay_s(rows.take(np.zeros(len(rows), dtype=bool)), 1.0 / 30.0)


class Noise:
    """Small random actions, remembered."""

    name = "noise"

    def __init__(self):
        self.given = []

    def reset(self):
        self.given = []

    def act(self, view):
        rng = np.random.default_rng(view.step)
        self.given.append(Action(float(rng.uniform(-0.3, 0.3)), float(rng.uniform(-0.1, 0.4))))
        return self.given[-1]


def test_in_simulation_a_row_holds_the_command_of_its_tick_and_the_one_that_moves_the_car():
    choice = choose_car("sim", seed=0)
    delay = round(choice.simulator.command_delay_s / choice.control_period_s)
    task, policy = ParkingTask(), Noise()
    with choice.car as car:
        car.place(task.sample_start(np.random.default_rng(0)))
        driven = run_episode(car, policy, task, choice.envelope, period_s=choice.control_period_s, max_ticks=90)
    whole = transitions_of([driven], 5)
    assert len(whole) > 40
    for row, tick in zip(whole.inputs, whole.tick, strict=True):
        assert tuple(row[-2:]) == (policy.given[tick].steering, policy.given[tick].throttle)
    throttle = whole.inputs[:, 3:].reshape(-1, 6, 2)[:, :, 1]
    design = np.hstack([throttle, whole.inputs[:, :1], np.ones((len(whole), 1))])
    slopes = np.linalg.lstsq(design, whole.targets[:, 3], rcond=None)[0][:6]
    # What is seen of it is older still by motion capture's latency and the velocity filter.
    assert delay <= 5 - int(np.argmax(np.abs(slopes))) <= delay + 2
    assert slopes[-1] == pytest.approx(0.0, abs=0.2 * np.abs(slopes).max())  # it has not arrived yet


@pytest.mark.parametrize("count", [25, 5])
def test_ridge_is_the_normal_equations_and_its_errors_are_those_of_rows_left_out(count):
    """Also where there are as many rows as numbers to be found, and lines go through all of them."""
    rng = np.random.default_rng(0)
    x = rng.normal(size=(count, 4)) * [1.0, 3.0, 0.2, 1.0] + [0.0, 5.0, -1.0, 0.0]
    y = x @ rng.normal(size=(4, 2)) + rng.normal(size=(count, 2)) * [0.3, 1.0]
    model = Ridge.fit(x, y)
    z = (x - x.mean(axis=0)) / x.std(axis=0)
    best = []
    for output in range(2):
        errors = []
        for penalty in PENALTIES:
            left = []
            for k in range(count):
                others = np.arange(count) != k
                # The penalty is on slopes alone; the constant is the mean of all rows.
                design = np.hstack([z, np.ones((count, 1))])
                lhs = design[others].T @ design[others] + np.diag([penalty] * 4 + [0.0])
                left.append(y[k, output] - design[k] @ np.linalg.solve(lhs, design[others].T @ y[others, output]))
            errors.append(left)
        least = int(np.argmin([np.mean(np.square(left)) for left in errors]))
        best.append(PENALTIES[least])
        assert model.errors[:, output] == pytest.approx(np.array(errors[least]), rel=0.02, abs=1e-3)
    for output, penalty in enumerate(best):
        slopes = np.linalg.solve(z.T @ z + penalty * np.eye(4), z.T @ (y[:, output] - y[:, output].mean()))
        assert model(x)[:, output] == pytest.approx(z @ slopes + y[:, output].mean(), abs=1e-9)


def test_two_rows_make_no_regression():
    rng = np.random.default_rng(1)
    with pytest.raises(DataError, match="three rows"):
        Ridge.fit(rng.normal(size=(2, 3)), rng.normal(size=(2, 2)))
