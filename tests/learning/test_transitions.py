"""Test transitions (commands, frames, gaps) and ridge regression against explicit computations."""

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
    """Return an episode whose commands encode their tick."""
    rng = np.random.default_rng(seed)
    sent = np.stack([np.arange(ticks) / 100.0, -np.arange(ticks) / 100.0], axis=1)
    states = rng.normal(size=(ticks + 1, 6))
    return EpisodeData(np.arange(ticks + 1) / 30.0, states, sent, sent, np.zeros(ticks))


def test_row_of_a_tick_ends_with_the_command_of_that_tick():
    rows = transitions_of([episode()], 3)
    assert rows.inputs.shape == (27, 3 + 8)
    assert rows.targets.shape == (27, len(OUTPUTS))
    for row, tick in zip(rows.inputs, rows.tick, strict=True):
        assert row[3:].reshape(4, 2)[:, 0] == pytest.approx([(tick - back) / 100.0 for back in (3, 2, 1, 0)])
        assert row[-1] == pytest.approx(-tick / 100.0)


def test_step_numbers_differ_by_one_exactly_between_consecutive_steps_of_an_episode():
    """The velocities after a step are those before the next one, as in no other pair of the random states."""
    first = episode(12, seed=1)
    times_s = first.times_s.copy()
    times_s[6:] += 1.0
    with_gap = dataclasses.replace(first, times_s=times_s)
    rows = transitions_of([with_gap, episode(9, seed=2)], 1)
    after = rows.inputs[:, :3] + rows.targets[:, 3:]
    follows = np.isclose(after[:, None], rows.inputs[None, :, :3]).all(axis=2)
    assert follows.sum() > 10
    np.testing.assert_array_equal(rows.step_numbers[None] - rows.step_numbers[:, None] == 1, follows)


def test_targets_are_changes_in_the_body_frame():
    """For a car facing +y, motion along +y is ahead and motion along -x is to the left."""
    base = episode(2)
    states = np.zeros((3, 6))
    states[0] = [1.0, 2.0, math.pi / 2, 1.0, 0.0, 0.5]
    states[1] = [0.9, 2.3, math.pi / 2 + 0.1, 1.2, 0.1, 0.4]
    states[2] = [0.9, 2.3, math.pi / 2 + 0.1 - 2 * math.pi, 1.2, 0.1, 0.4]
    rows = transitions_of([dataclasses.replace(base, states=states)], 0)
    assert rows.targets[0] == pytest.approx([0.3, 0.1, 0.1, 0.2, 0.1, -0.1])
    assert rows.targets[1] == pytest.approx(np.zeros(6), abs=1e-12)


def test_transitions_are_invariant_under_rigid_motions():
    base = episode()
    angle, states = 1.2, base.states.copy()
    c, s = math.cos(angle), math.sin(angle)
    states[:, :2] = base.states[:, :2] @ np.array([[c, s], [-s, c]]) + [4.0, -2.0]
    states[:, 2] += angle
    original, moved = transitions_of([base], 2), transitions_of([dataclasses.replace(base, states=states)], 2)
    assert np.allclose(original.inputs, moved.inputs)
    assert np.allclose(original.targets, moved.targets)


def test_steps_with_time_gaps_or_nan_are_excluded():
    base = episode()
    times, states = base.times_s.copy(), base.states.copy()
    times[11:] += 0.5  # between rows 10 and 11
    states[20, 3] = math.nan
    rows = transitions_of([dataclasses.replace(base, times_s=times, states=states)], 3)
    assert set(range(3, 30)) - set(rows.tick) == {10, 11, 12, 13, 19, 20}


def test_steps_with_pose_jumps_or_repeated_poses_are_excluded():
    base = episode()
    segment = np.where(np.arange(31) < 16, 0.0, 1.0)
    with_jump = transitions_of([dataclasses.replace(base, extra={"segment": segment})], 2)
    assert with_jump.tick.tolist() == [t for t in range(2, 30) if t != 15]
    # Motion capture loses the body at tick 10 and repeats the pose of tick 9; tick 11 has a new pose.
    age = np.full(31, 0.012)
    age[1::2] += 0.010  # cameras at 100 Hz and a control period of 33 ms give varying pose ages
    age[10] = age[9] + base.period_s
    with_loss = transitions_of([dataclasses.replace(base, extra={"pose_age_s": age})], 2)
    assert with_loss.tick.tolist() == [t for t in range(2, 30) if t not in (9, 10)]
    unknown_age = transitions_of([dataclasses.replace(base, extra={"pose_age_s": np.full(31, np.nan)})], 2)
    assert len(unknown_age) == 28


def test_histories_do_not_cross_episodes():
    rows = transitions_of([episode(10), episode(12, seed=1)], 4)
    assert [(rows.episode == k).sum() for k in (0, 1)] == [6, 8]
    assert rows.tick.min() == 4


@pytest.mark.parametrize(("history", "message"), [(-1, "0 or more"), (40, "shorter history")])
def test_invalid_history_is_refused(history, message):
    with pytest.raises(DataError, match=message):
        transitions_of([episode()], history)


def test_short_episode_with_a_time_gap_has_no_whole_step():
    short = episode(4)
    assert has_whole_step(short, 3)
    assert not has_whole_step(dataclasses.replace(short, times_s=np.array([0.0, 1.0, 2.0, 6.0, 7.0]) / 30.0), 3)
    assert not has_whole_step(episode(3), 3)


class TestVelocityDelay:
    """Velocities from backward differences of poses, with a delay of half a period."""

    def estimated_delay_s(self, rate):
        ahead = 0.03 * np.sin(np.arange(60) / 9.0) + 0.05
        yaw_change = rate / 30.0 * np.cos(np.arange(60) / 7.0)
        inputs = np.zeros((59, 5))
        inputs[:, 0], inputs[:, 2] = ahead[:-1] * 30.0, yaw_change[:-1] * 30.0
        change = np.stack([np.diff(ahead), 0 * yaw_change[1:], np.diff(yaw_change)], axis=1) * 30.0
        targets = np.hstack([ahead[1:, None], 0 * yaw_change[1:, None], yaw_change[1:, None], change])
        index = np.arange(59)
        return velocity_delay_s(Transitions(inputs, targets, 0 * index, index, 0), 1.0 / 30.0)

    @pytest.mark.parametrize("rate", [0.0, 2.0])
    def test_delay_is_half_a_period_with_and_without_turning(self, rate):
        assert self.estimated_delay_s(rate) == pytest.approx(0.5 / 30.0, rel=1e-6)

    def test_delay_without_rows_is_refused(self):
        rows = transitions_of([episode()], 3)
        with pytest.raises(DataError, match="longer drives"):
            velocity_delay_s(rows.take(np.zeros(len(rows), dtype=bool)), 1.0 / 30.0)


class RandomPolicy:
    """A policy of small random actions that stores its actions."""

    name = "noise"

    def __init__(self):
        self.actions = []

    def reset(self):
        self.actions = []

    def act(self, view):
        rng = np.random.default_rng(view.step)
        self.actions.append(Action(float(rng.uniform(-0.3, 0.3)), float(rng.uniform(-0.1, 0.4))))
        return self.actions[-1]


def test_rows_of_a_simulated_drive_contain_the_acting_command():
    choice = choose_car("sim", seed=0)
    delay = round(choice.simulator.command_delay_s / choice.control_period_s)
    task, policy = ParkingTask(), RandomPolicy()
    with choice.car as car:
        car.place(task.sample_start(np.random.default_rng(0)))
        driven = run_episode(car, policy, task, choice.envelope, period_s=choice.control_period_s, max_ticks=90)
    rows = transitions_of([driven], 5)
    assert len(rows) > 40
    for row, tick in zip(rows.inputs, rows.tick, strict=True):
        assert tuple(row[-2:]) == (policy.actions[tick].steering, policy.actions[tick].throttle)
    throttle = rows.inputs[:, 3:].reshape(-1, 6, 2)[:, :, 1]
    design = np.hstack([throttle, rows.inputs[:, :1], np.ones((len(rows), 1))])
    slopes = np.linalg.lstsq(design, rows.targets[:, 3], rcond=None)[0][:6]
    # Motion-capture latency and velocity filter add up to two ticks to the delay.
    assert delay <= 5 - int(np.argmax(np.abs(slopes))) <= delay + 2
    assert slopes[-1] == pytest.approx(0.0, abs=0.2 * np.abs(slopes).max())  # the newest command has not arrived yet


@pytest.mark.parametrize("count", [25, 5])
def test_ridge_equals_normal_equations_and_leave_one_out_refits(count):
    """One case has as many rows as coefficients."""
    rng = np.random.default_rng(0)
    x = rng.normal(size=(count, 4)) * [1.0, 3.0, 0.2, 1.0] + [0.0, 5.0, -1.0, 0.0]
    y = x @ rng.normal(size=(4, 2)) + rng.normal(size=(count, 2)) * [0.3, 1.0]
    model = Ridge.fit(x, y)
    z = (x - x.mean(axis=0)) / x.std(axis=0)
    best = []
    for output in range(2):
        errors = []
        for penalty in PENALTIES:
            loo_errors = []
            for k in range(count):
                others = np.arange(count) != k
                # The penalty is on slopes alone; the constant is the mean of all rows.
                design = np.hstack([z, np.ones((count, 1))])
                lhs = design[others].T @ design[others] + np.diag([penalty] * 4 + [0.0])
                loo_errors.append(y[k, output] - design[k] @ np.linalg.solve(lhs, design[others].T @ y[others, output]))
            errors.append(loo_errors)
        best_index = int(np.argmin([np.mean(np.square(loo_errors)) for loo_errors in errors]))
        best.append(PENALTIES[best_index])
        assert model.errors[:, output] == pytest.approx(np.array(errors[best_index]), rel=0.02, abs=1e-3)
    for output, penalty in enumerate(best):
        slopes = np.linalg.solve(z.T @ z + penalty * np.eye(4), z.T @ (y[:, output] - y[:, output].mean()))
        assert model(x)[:, output] == pytest.approx(z @ slopes + y[:, output].mean(), abs=1e-9)


def test_ridge_refuses_two_rows():
    rng = np.random.default_rng(1)
    with pytest.raises(DataError, match="three rows"):
        Ridge.fit(rng.normal(size=(2, 3)), rng.normal(size=(2, 2)))
