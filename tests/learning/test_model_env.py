"""Test the learned car as an environment against explicit steps, the scalar safety gate and the task's formulas."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from terminating_parking import TerminatingParking
from torch import Tensor

from carlab.core.errors import ConfigError
from carlab.core.geofence import can_stop_inside, rectangle
from carlab.core.quantities import Action, CarState
from carlab.core.safety import SafetyEnvelope, limit
from carlab.core.task import ParkingTask
from learning.policy.sac import FastSac
from learning.policy.sac_agent import SacAgent, SacSettings
from learning.world.model_env import REWARD_SCALE, ModelEnv, policy_inputs
from tests.helpers.step_in_body import StepInBody

HISTORY = 2
WIDTH = 7 + 2 * HISTORY
PERIOD_S = 1 / 30
TASK = ParkingTask(history_length=HISTORY, max_ticks=10**9)
TERMINATING = TerminatingParking(history_length=HISTORY, max_ticks=10**9)


@dataclass
class DelayedCar(StepInBody):
    """A deterministic learned car with a command delay of one step."""

    history: int = HISTORY

    def sample(self, inputs: Tensor, generator: torch.Generator) -> Tensor:
        v, delayed_command = inputs[:, 0], inputs[:, 5:7]
        zero = torch.zeros_like(v)
        yaw_change = 0.1 * v * delayed_command[:, 0]
        return torch.stack(
            [v * PERIOD_S, 0.1 * yaw_change, yaw_change, 0.2 * delayed_command[:, 1] - 0.05 * v, zero, zero], dim=1
        )


def reference_step(state: np.ndarray, delayed_command: np.ndarray) -> np.ndarray:
    """Compute one step of ``DelayedCar`` in the world frame."""
    x, y, yaw, v, *sideways = state
    yaw_change = 0.1 * v * delayed_command[0]
    ahead, left = v * PERIOD_S, 0.1 * yaw_change
    x, y = x + math.cos(yaw) * ahead - math.sin(yaw) * left, y + math.sin(yaw) * ahead + math.cos(yaw) * left
    return np.array([x, y, yaw + yaw_change, v + 0.2 * delayed_command[1] - 0.05 * v, *sideways])


def parking_reward(state: np.ndarray, action: np.ndarray) -> float:
    """Compute the reward of the paper: tolerance of distance and yaw error minus action cost."""
    yaw_error = (state[2] + math.pi) % (2 * math.pi) - math.pi
    excess_distance = max(math.sqrt(state[0] ** 2 + state[1] ** 2 + yaw_error**2) - 0.1, 0.0) / 2.0
    return 1.0 / (1.0 + 9.0 * excess_distance**2) - 0.005 * float(action @ action)


class StationaryCar(StepInBody):
    """A learned car that never moves."""

    history = HISTORY

    def sample(self, inputs: Tensor, generator: torch.Generator) -> Tensor:
        return torch.zeros(len(inputs), 6)


def rows_of(states: np.ndarray, past: np.ndarray | None = None) -> np.ndarray:
    """Return features of states (N, 6) after past commands (N, 2 H); None means zero commands."""
    past = np.zeros((len(states), 2 * HISTORY)) if past is None else past
    yaw = states[:, 2:3]
    return np.hstack([states[:, :2], np.sin(yaw), np.cos(yaw), states[:, 3:], past])


def state_of(features: np.ndarray) -> np.ndarray:
    return np.array([*features[:2], math.atan2(features[2], features[3]), *features[4:7]])


def test_steps_and_rewards_are_those_reference_step() -> None:
    env = ModelEnv(DelayedCar(), TASK, 6, seed=1)
    env.reset()
    rng = np.random.default_rng(0)
    before = env.features.numpy().astype(np.float64)
    states = [state_of(row) for row in before]
    past = before[:, 7:].reshape(6, HISTORY, 2)
    for _ in range(4):
        commands = rng.uniform(-0.4, 0.4, (6, 2)).astype(np.float32)
        observations, rewards, done, _ = env.step(commands)
        assert not done.any()
        states = [reference_step(s, p[-1]) for s, p in zip(states, past, strict=True)]
        past = np.concatenate([past[:, 1:], commands[:, None]], axis=1)
        expected = rows_of(np.array(states), past.reshape(6, -1))
        np.testing.assert_allclose(env.features.numpy(), expected, atol=1e-5)
        np.testing.assert_allclose(observations, expected / [2, 2, 1, 1, 2, 1, 4, 1, 1, 1, 1], atol=1e-5)
        by_formula = [parking_reward(s, a) for s, a in zip(states, commands, strict=True)]
        np.testing.assert_allclose(rewards, REWARD_SCALE * np.array(by_formula), atol=1e-4)


def test_bonus_is_in_training_rewards_and_not_in_rollout_returns() -> None:
    """The bonus is x: it is scaled into the step reward and absent from the return of a rollout."""
    task = replace(TASK, max_ticks=200)
    plain, with_bonus = (
        ModelEnv(DelayedCar(), task, 6, seed=1),
        ModelEnv(DelayedCar(), task, 6, bonus=lambda f: f[:, 0], seed=1),
    )
    for env in (plain, with_bonus):
        env.reset()
    commands = np.random.default_rng(0).uniform(-0.4, 0.4, (6, 2)).astype(np.float32)
    (_, plain_rewards, _, _), (_, rewards, _, _) = plain.step(commands), with_bonus.step(commands)
    np.testing.assert_allclose(rewards - plain_rewards, REWARD_SCALE * with_bonus.features[:, 0].numpy(), atol=1e-4)
    totals = [env.roll_out(lambda observations: np.zeros((6, 2), np.float32))[0] for env in (plain, with_bonus)]
    assert torch.equal(*totals)


def test_commands_pass_the_safety_gate() -> None:
    """The sent commands in the features equal those of the scalar safety gate (limits and slew rates)."""
    envelope = SafetyEnvelope(max_steering=0.9, max_throttle=0.5, steering_rate_per_s=12.0, throttle_rate_per_s=4.0)
    env = ModelEnv(StationaryCar(), TASK, 50, envelope=envelope, period_s=PERIOD_S, seed=0)
    env.reset()
    rng = np.random.default_rng(0)
    sent = [Action(0.0, 0.0)] * 50
    for _ in range(8):
        requested = rng.uniform(-1.5, 1.5, (50, 2)).astype(np.float32)
        env.step(requested)
        sent = [
            limit(Action.from_array(a), s, PERIOD_S, envelope)
            for a, s in zip(requested.astype(float), sent, strict=True)
        ]
        np.testing.assert_allclose(env.features[:, -2:].numpy(), [a.to_array() for a in sent], atol=1e-6)
    assert max(abs(a.throttle) for a in sent) > 0.3


L_SHAPED_ARENA = ((-1.0, -1.5), (2.0, -1.5), (2.0, 0.5), (0.5, 0.5), (0.5, -0.5), (-1.0, -0.5))
"""A rectangle without one corner."""


@pytest.mark.parametrize("arena_m", [rectangle(-1.0, 2.0, -1.5, 0.5), L_SHAPED_ARENA])
def test_episode_terminates_where_the_safety_gate_stops_the_car(arena_m) -> None:
    """It is a termination, not a truncation: a stopped car earns no further reward."""
    envelope = SafetyEnvelope(max_speed_mps=2.5, arena_m=arena_m)
    rng = np.random.default_rng(0)
    states = rng.uniform([-1.0, -1.5, -math.pi, -3.0, -1.0, -4.0], [2.0, 0.5, math.pi, 3.0, 1.0, 4.0], (600, 6))
    states[::10] = [2.1, 0.0, 0.3, 0.0, 0.0, 0.0]  # outside of the arena
    env = ModelEnv(StationaryCar(), TASK, 400, recorded=rows_of(states), from_recorded=1.0, envelope=envelope)
    env.reset()
    now = [CarState.from_array(state_of(row)) for row in env.features.numpy().astype(np.float64)]
    _, _, done, infos = env.step(np.zeros((400, 2), np.float32))
    expected = [
        s.speed_mps > 2.5 or not can_stop_inside(envelope.arena_m, s, envelope.reaction_s, envelope.deceleration_mps2)
        for s in now
    ]
    assert done.tolist() == expected
    assert 50 < sum(expected) < 350
    assert all(info["TimeLimit.truncated"] is False for info, ended in zip(infos, done, strict=True) if ended)
    assert all(info == {} for info, ended in zip(infos, done, strict=True) if not ended)


def test_arena_of_the_task_applies_without_an_arena_of_the_car() -> None:
    outside, inside = np.array([[2.9, 0.0, 0, 0, 0, 0]]), np.array([[2.7, 0.0, 0, 0, 0, 0]])
    for states, expected in ((outside, True), (inside, False)):
        env = ModelEnv(StationaryCar(), TASK, 1, recorded=rows_of(states), from_recorded=1.0)
        env.reset()
        assert bool(env.step(np.zeros((1, 2), np.float32))[2][0]) is expected


def test_episode_is_truncated_after_the_ticks_of_the_task() -> None:
    task = replace(TASK, max_ticks=7)
    env = ModelEnv(DelayedCar(), task, 200, seed=0)
    env.reset()
    commands = np.full((200, 2), 0.3, np.float32)
    ended = np.zeros(200, dtype=int)
    for tick in range(14):
        driven = [reference_step(state_of(f), f[9:11]) for f in env.features.numpy().astype(np.float64)]
        past = np.hstack([env.features.numpy()[:, 9:11], commands])
        observations, _, done, infos = env.step(commands)
        ended += done
        if tick == 0:
            assert 10 < done.sum() < 60, "initial episodes end at different ticks"
        if tick == 6:
            assert (ended == 1).all()
        final = policy_inputs(rows_of(np.array(driven), past))
        for k in np.flatnonzero(done):
            assert infos[k]["TimeLimit.truncated"] is True
            np.testing.assert_allclose(infos[k]["terminal_observation"], final[k], atol=1e-5)
            assert np.all(observations[k][7:] == 0.0), "a new start has zero past commands"
            assert abs(observations[k][0] * 2 - 1.42) < 0.1 + 1e-6
    assert (ended == 2).all()


def test_parked_car_terminates_the_episode_if_the_task_does() -> None:
    states = np.array([[0.05, 0.0, 0.1, 0.0, 0.0, 0.0]])
    for stop, task in ((True, TERMINATING), (False, TASK)):
        env = ModelEnv(StationaryCar(), task, 1, recorded=rows_of(states), from_recorded=1.0)
        env.reset()
        _, _, done, infos = env.step(np.zeros((1, 2), np.float32))
        assert bool(done[0]) is stop
        if stop:
            assert infos[0]["TimeLimit.truncated"] is False
            assert infos[0]["terminal_observation"][0] == pytest.approx(0.025)


def test_parking_at_the_last_tick_is_not_a_truncation() -> None:
    task = replace(TERMINATING, max_ticks=1)
    env = ModelEnv(StationaryCar(), task, 1, recorded=rows_of(np.zeros((1, 6))), from_recorded=1.0)
    env.reset()
    assert env.step(np.zeros((1, 2), np.float32))[3][0]["TimeLimit.truncated"] is False


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_given_share_of_starts_is_recorded(share: float) -> None:
    rng = np.random.default_rng(0)
    recorded = rng.uniform(-0.5, 0.5, (10, WIDTH))
    env = ModelEnv(StationaryCar(), TASK, 4000, recorded=recorded, from_recorded=share, seed=3)
    env.reset()
    rows = env.features.numpy()
    distance = np.abs(rows[:, None] - recorded[None]).max(axis=2)
    is_recorded = distance.min(axis=1) < 1e-6
    assert is_recorded.mean() == pytest.approx(share, abs=4 * math.sqrt(share * (1 - share) / 4000))
    if share:
        counts = np.bincount(distance.argmin(axis=1)[is_recorded], minlength=10)
        assert counts.min() > 0.6 * counts.mean()
    fresh = rows[~is_recorded]
    if share < 1:
        assert np.all(fresh[:, 7:] == 0.0)
        assert np.ptp(fresh[:, 0]) == pytest.approx(0.2, abs=0.01)
        assert fresh[:, 1].mean() == pytest.approx(-1.04, abs=0.01)
        yaw = np.angle(np.exp(1j * (np.arctan2(fresh[:, 2], fresh[:, 3]) - math.pi)))
        assert np.abs(yaw).max() == pytest.approx(0.1 * math.pi, abs=0.01)


def test_all_starts_are_those_of_the_task_without_recordings() -> None:
    env = ModelEnv(StationaryCar(), TASK, 100, recorded=np.zeros((0, WIDTH)), from_recorded=1.0)
    env.reset()
    assert np.all(np.abs(env.features[:, 0].numpy() - 1.42) <= 0.1 + 1e-6)


def test_rollout_sums_rewards_of_each_car_until_its_episode_ends() -> None:
    """The cars hold different throttles from one start; some leave the arena."""
    task = replace(TASK, start_spread=(0, 0, 0), start_velocity_std=(0, 0, 0), max_ticks=60)
    throttle = np.linspace(-0.5, 0.6, 12)
    envelope = SafetyEnvelope(arena_m=task.arena_m)
    recorded = rows_of(np.array([[0.1, 0.2, 0.3, 0.0, 0.0, 0.0]]))
    env = ModelEnv(DelayedCar(), task, 12, recorded=recorded, from_recorded=1.0, envelope=envelope)
    commands = np.stack([np.full(12, 0.3), throttle], axis=1).astype(np.float32)
    views: list[np.ndarray] = []

    def act(observations: np.ndarray) -> np.ndarray:
        views.append(observations.copy())
        return commands

    total, _, last = env.roll_out(act)
    assert len(views) == 60
    assert views[0].shape == (12, WIDTH)
    lengths = []
    for k in range(12):
        state, command, reward, ticks = np.array([1.42, -1.04, math.pi, 0, 0, 0]), np.zeros(2), 0.0, 0
        for _ in range(60):
            state, command, ticks = reference_step(state, command), commands[k].astype(float), ticks + 1
            reward += parking_reward(state, command)
            if not can_stop_inside(task.arena_m, CarState.from_array(state), 0.15, 3.0):
                break
        lengths.append(ticks)
        assert float(total[k]) == pytest.approx(reward, abs=1e-3)
        np.testing.assert_allclose(last[k].numpy()[:7], rows_of(state[None])[0, :7], atol=1e-3)
    assert len(set(lengths)) > 3
    assert max(lengths) == 60
    env.reset()
    np.testing.assert_allclose(env.features.numpy(), np.repeat(recorded, 12, axis=0), atol=1e-6)


def test_rollout_ends_for_a_parked_car() -> None:
    for task, ticks in ((TERMINATING, 1), (TASK, 9)):
        at_goal = replace(
            task, start_pose=(0.1, 0.0, 0.0), start_spread=(0, 0, 0), start_velocity_std=(0, 0, 0), max_ticks=9
        )
        total, *_ = ModelEnv(StationaryCar(), at_goal, 3).roll_out(lambda observations: np.zeros((3, 2), np.float32))
        assert total.tolist() == pytest.approx([ticks] * 3), "each tick is rewarded"


class UndefinedReward(ParkingTask):
    """A task whose reward is not a number from a speed of 1 m/s on."""

    def reward(self, features, action, next_features):
        return super().reward(features, action, next_features) * torch.sqrt(1.0 - next_features[..., 4])


class FastCar(StationaryCar):
    """A learned car that gains a given speed [m/s] in each step."""

    def __init__(self, gain_mps: float) -> None:
        self.gain_mps = gain_mps

    def sample(self, inputs: Tensor, generator: torch.Generator) -> Tensor:
        return torch.tensor([0.0, 0.0, 0.0, self.gain_mps, 0.0, 0.0]).expand(len(inputs), 6)


UNDEFINED_REWARD = r"gives a reward or cost that is not finite, in the learned car at .* vx 1.5 m/s"


def test_reward_that_is_not_finite_in_a_plausible_state_is_an_error() -> None:
    env = ModelEnv(FastCar(1.5), UndefinedReward(history_length=HISTORY), 2)
    env.reset()
    env.step_async(np.zeros((2, 2), dtype=np.float32))
    with pytest.raises(ConfigError, match=UNDEFINED_REWARD):
        env.step_wait()
    with pytest.raises(ConfigError, match=UNDEFINED_REWARD):
        env.roll_out(lambda seen: np.zeros((2, 2), dtype=np.float32))


def test_reward_in_a_learned_car_that_has_diverged_is_no_error_of_the_task() -> None:
    env = ModelEnv(FastCar(1e6), UndefinedReward(history_length=HISTORY), 2)
    env.reset()
    env.step_async(np.zeros((2, 2), dtype=np.float32))
    _, rewards, ended, _ = env.step_wait()
    assert np.isnan(rewards).all()
    assert ended.all()


def test_error_of_the_task_in_training_is_no_divergence() -> None:
    task = UndefinedReward(history_length=HISTORY)
    object.__setattr__(task, "name", "manoeuvre_nan")
    agent = SacAgent(SacSettings(hidden=(8,), cars=4, warm_up=8), seed=0)
    with pytest.raises(ConfigError, match="The task manoeuvre_nan gives a reward or cost that is not finite"):
        agent.train(ModelEnv(FastCar(1.5), task, 4), 1)


@dataclass(frozen=True)
class OtherTrainingStart(ParkingTask):
    """Starts of a training lie at (-1, 0); the x coordinate costs."""

    history_length: int = HISTORY
    max_ticks: int = 5

    def sample_training_start(self, rng: np.random.Generator) -> CarState:
        return CarState(-1.0)

    def cost(self, next_features: Tensor) -> Tensor:
        return next_features[..., 0]


def test_rollouts_start_as_the_car_does_and_sum_the_constraint_cost() -> None:
    env = ModelEnv(StationaryCar(), OtherTrainingStart(), 8, seed=0)
    env.reset()
    assert env.features[:, 0].tolist() == [-1.0] * 8
    drives = env.roll_out(lambda observations: np.zeros((8, 2), np.float32))
    assert drives.final[:, 0].min() > 1.3
    torch.testing.assert_close(drives.costs, 5.0 * drives.final[:, 0])


def test_equal_seeds_give_equal_starts() -> None:
    first, second, other = (ModelEnv(DelayedCar(), TASK, 30, seed=s) for s in (4, 4, 5))
    assert np.array_equal(first.reset(), second.reset())
    assert not np.array_equal(first.reset(), other.reset())
    first.seed(8)
    second.seed(8)
    assert np.array_equal(first.reset(), second.reset())


def test_sac_trains_in_the_environment_with_correct_terminal_observations() -> None:
    """For a stationary car the replay's next observation equals the observation, also at episode ends."""
    rng = np.random.default_rng(0)
    states = rng.uniform([-1, -1, -3, 0, 0, 0], [1, 1, 3, 0, 0, 0], (500, 6))
    env = ModelEnv(StationaryCar(), replace(TASK, max_ticks=5), 8, recorded=rows_of(states), from_recorded=1.0)
    agent = FastSac(
        "MlpPolicy", env, policy_kwargs={"net_arch": [8]}, learning_starts=40, buffer_size=4000, batch_size=16,
        train_freq=(2, "step"), gradient_steps=3, seed=0, device="cpu",
    )  # fmt: skip
    agent.learn(400)
    assert agent.num_timesteps == 400
    assert agent._n_updates == 3 * (400 - 48) // 16 + 3
    replay = agent.replay_buffer
    assert replay is not None
    ends = replay.dones[:50].astype(bool)
    assert ends.mean() == pytest.approx(0.2, abs=0.02)
    assert np.array_equal(replay.timeouts[:50].astype(bool), ends)
    np.testing.assert_allclose(replay.next_observations[:50, :, :7], replay.observations[:50, :, :7], atol=1e-6)


def test_policy_inputs_are_scaled_and_clipped() -> None:
    features = np.array([[1.0, -3.0, 0.6, -0.8, 2.0, 0.5, 8.0, 0.1, -1.0], [500.0, -500.0, 0, 1, 100.0, 0, 0, 0, 0]])
    before = features.copy()
    observations = policy_inputs(features)
    assert observations.dtype == np.float32
    assert observations[0].tolist() == pytest.approx([0.5, -1.5, 0.6, -0.8, 1.0, 0.5, 2.0, 0.1, -1.0])
    assert observations[1].tolist() == [10.0, -10.0, 0.0, 1.0, 10.0, 0.0, 0.0, 0.0, 0.0]
    assert np.array_equal(features, before), "policy_inputs must not modify its argument"
    assert np.array_equal(policy_inputs(features[0]), observations[0])
