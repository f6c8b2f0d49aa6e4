"""Test the explicit gradient step of SAC against stable-baselines3, which uses autograd."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3 import SAC
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from carlab.core.errors import ConfigError
from learning.policy.sac import FastSac

WIDTH, BATCH = 5, 32


class LinearRewardEnv(gym.Env[np.ndarray, np.ndarray]):
    """An environment whose reward is the first action."""

    def __init__(self) -> None:
        self.observation_space = gym.spaces.Box(-5.0, 5.0, (WIDTH,), np.float32)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        return np.zeros(WIDTH, np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        return np.full(WIDTH, action.sum(), np.float32), float(action[0]), False, False, {}


def batches(count: int, *, n_step_returns: bool = False) -> list[ReplayBufferSamples]:
    """Return replay batches; with ``n_step_returns`` each row has its own discount."""
    generator = torch.Generator().manual_seed(3)
    found = []
    for _ in range(count):
        observations, next_observations = (torch.randn((BATCH, WIDTH), generator=generator) for _ in range(2))
        action = torch.rand((BATCH, 2), generator=generator) * 2.0 - 1.0
        done = (torch.rand((BATCH, 1), generator=generator) < 0.2).float()
        reward = torch.randn((BATCH, 1), generator=generator)
        discounts = 0.9 ** torch.randint(1, 6, (BATCH, 1), generator=generator) if n_step_returns else None
        found.append(ReplayBufferSamples(observations, action, next_observations, done, reward, discounts))
    return found


def agent(kind: type[SAC], **others: object) -> SAC:
    return kind(
        "MlpPolicy", LinearRewardEnv(), policy_kwargs={"net_arch": [16, 24]}, ent_coef="auto_0.3", learning_rate=1e-3,
        tau=0.05, gamma=0.9, seed=5, device="cpu", **others,
    )  # fmt: skip


def replace_replay(learner: SAC, material: list[ReplayBufferSamples]) -> None:
    """Make the replay buffer return these batches in order."""
    rows = iter(material)

    def sample(batch_size: int, env: object = None) -> ReplayBufferSamples:
        parts = [next(rows) for _ in range(batch_size // BATCH)]
        fields = (None if parts[0][k] is None else torch.cat([p[k] for p in parts]) for k in range(6))
        return ReplayBufferSamples(*fields)

    learner.replay_buffer.sample = sample


def trained(kind: type[SAC], material: list[ReplayBufferSamples]) -> SAC:
    found = agent(kind)
    with torch.no_grad():  # Beyond the bound of the log standard deviation the gradient is zero.
        found.actor.log_std.bias.copy_(torch.tensor([1.9, -0.5]))
    replace_replay(found, material)
    found.set_logger(_quiet())
    torch.manual_seed(11)
    found.train(len(material), BATCH)
    return found


def _quiet() -> object:
    from stable_baselines3.common.logger import Logger

    return Logger(None, [])


@pytest.mark.parametrize("n_step_returns", [False, True])
@pytest.mark.parametrize("steps", [1, 40])
def test_training_steps_equal_stable_baselines(steps: int, n_step_returns: bool) -> None:
    stock, fast = (trained(kind, batches(steps, n_step_returns=n_step_returns)) for kind in (SAC, FastSac))
    fresh = agent(SAC).policy.state_dict()
    for name, expected in stock.policy.state_dict().items():
        found = fast.policy.state_dict()[name]
        torch.testing.assert_close(found, expected, rtol=2e-3, atol=2e-5 * steps, msg=lambda m, n=name: f"{n}: {m}")
        if "log_std.bias" not in name:
            assert not torch.equal(expected, fresh[name]), name
    assert float(fast.log_ent_coef.detach()) == pytest.approx(float(stock.log_ent_coef.detach()), abs=1e-5)
    for name in ("train/ent_coef", "train/actor_loss", "train/critic_loss") if steps == 1 else ():
        assert fast.logger.name_to_value[name] == pytest.approx(stock.logger.name_to_value[name], rel=1e-3), name


def test_agent_with_a_loaded_state_acts_and_trains_identically() -> None:
    material = batches(20)
    first = trained(FastSac, material)
    restored = agent(FastSac)
    restored.load_learned_state(first.learned_state())
    observations = np.random.default_rng(0).normal(size=(7, WIDTH)).astype(np.float32)
    original_result, restored_result = (a.predict(observations, deterministic=True)[0] for a in (first, restored))
    np.testing.assert_array_equal(original_result, restored_result)
    for a in (first, restored):
        replace_replay(a, batches(5))
        a.set_logger(_quiet())
        torch.manual_seed(1)
        a.train(5, BATCH)
    original_result, restored_result = (a.predict(observations, deterministic=True)[0] for a in (first, restored))
    np.testing.assert_array_equal(original_result, restored_result)
    original_result, restored_result = (a.learned_state() for a in (first, restored))
    assert all(
        torch.equal(torch.as_tensor(original_result[name]), torch.as_tensor(restored_result[name]))
        for name in original_result
    )


def test_learn_maximises_the_reward() -> None:
    """The reward is the first action, so the trained policy chooses it near one."""
    learner = agent(FastSac, learning_starts=50, batch_size=BATCH)
    learner.learn(600)
    assert learner.predict(np.zeros(WIDTH, np.float32), deterministic=True)[0][0] > 0.8


def test_unsupported_network_is_refused() -> None:
    with pytest.raises(ConfigError, match="use stable_baselines3"):
        FastSac("MlpPolicy", LinearRewardEnv(), policy_kwargs={"activation_fn": torch.nn.Tanh}, device="cpu")
