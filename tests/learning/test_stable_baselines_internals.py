"""Test that stable-baselines3 has the undocumented attributes that carlab uses."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
import stable_baselines3
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.sac import policies

from learning.policy.sac import FastSac


class SpacesOnlyEnv(gym.Env[np.ndarray, np.ndarray]):
    """An environment with spaces and without dynamics."""

    observation_space = gym.spaces.Box(-1.0, 1.0, (3,), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)


@pytest.fixture(scope="module")
def owners() -> dict[str, object]:
    agent = FastSac(
        "MlpPolicy", SpacesOnlyEnv(), policy_kwargs={"net_arch": [4]}, n_steps=2, buffer_size=8, device="cpu"
    )
    return {
        "SAC": agent,
        "SAC.policy": agent.policy,
        "SAC.policy.actor": agent.policy.actor,
        "SAC.policy.critic": agent.policy.critic,
        "SAC.replay_buffer": agent.replay_buffer,
        "BaseCallback": BaseCallback,
        "VecEnv": VecEnv,
        "sac.policies": policies,
    }


@pytest.mark.parametrize(
    ("owner", "names"),
    [
        ("SAC", "_setup_model _n_updates _current_progress_remaining _vec_normalize_env"),
        (
            "SAC",
            "log_ent_coef lr_schedule replay_buffer target_entropy target_update_interval set_logger n_envs n_steps",
        ),
        ("SAC", "observation_space action_space gradient_steps use_sde gamma tau device"),
        ("SAC.policy", "features_extractor_class activation_fn critic_target actor critic"),
        ("SAC.policy.actor", "mu log_std latent_pi"),
        ("SAC.policy.critic", "q_networks"),
        ("SAC.replay_buffer", "sample"),
        ("BaseCallback", "_on_rollout_start _on_step"),
        ("VecEnv", "_get_indices"),
        ("sac.policies", "LOG_STD_MAX LOG_STD_MIN"),
    ],
)
def test_stable_baselines_has_each_attribute_used(owners: dict[str, object], owner: str, names: str) -> None:
    missing = [name for name in names.split() if not hasattr(owners[owner], name)]
    assert not missing, (
        f"stable-baselines3 {stable_baselines3.__version__} has no {owner}.{', '.join(missing)}, which learning/policy "
        "uses; adapt FastSac and SacAgent, or lower the upper bound in pyproject.toml."
    )


def test_n_step_sample_has_discounts() -> None:
    from stable_baselines3.common.type_aliases import ReplayBufferSamples

    fields = ("observations", "actions", "next_observations", "dones", "rewards", "discounts")
    assert ReplayBufferSamples._fields == fields, (
        f"stable-baselines3 {stable_baselines3.__version__} samples {ReplayBufferSamples._fields} from its replay "
        f"buffer and not {fields}, which FastSac.train uses; adapt it, or lower the upper bound in pyproject.toml."
    )
