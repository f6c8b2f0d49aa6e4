"""The Gymnasium environments: both checkers, the action history, and what an independent loop over the car sees."""

import warnings
from collections.abc import Iterator

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check
from stable_baselines3.common.env_checker import check_env as sb3_check

import carlab.experiment.episodes.gym_registration  # noqa: F401
from carlab.experiment.episodes.gym_env import CarEnv


@pytest.fixture(params=["carlab/Parking-v0", "carlab/Path-v0"])
def env(request: pytest.FixtureRequest) -> Iterator[gym.Env]:
    made = gym.make(request.param)
    yield made
    made.close()


def test_both_checkers_pass_without_a_warning(env: gym.Env) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        gymnasium_check(env.unwrapped, skip_render_check=True)
        sb3_check(env.unwrapped, warn=True)


def test_the_row_after_a_tick_ends_in_the_action_sent_at_it(env: gym.Env) -> None:
    env.reset(seed=1)
    sent = [np.zeros(2, dtype=np.float32)] * 3
    rng = np.random.default_rng(0)
    for _ in range(12):
        action = rng.uniform(-0.6, 0.6, 2).astype(np.float32)
        observation, *_ = env.step(action)
        sent = [*sent[1:], action]
        # Oldest first, newest last, whatever the car's state.
        np.testing.assert_allclose(observation[7:], np.concatenate(sent), atol=1e-6)


def test_seeded_episodes_are_identical_and_others_differ() -> None:
    def roll(seed: int) -> np.ndarray:
        env = gym.make("carlab/Parking-v0")
        rows = [env.reset(seed=seed)[0]]
        rows += [env.step(np.array([0.3, -0.4], dtype=np.float32))[0] for _ in range(30)]
        env.close()
        return np.stack(rows)

    assert roll(5).tobytes() == roll(5).tobytes()
    assert not np.array_equal(roll(5), roll(6))


def test_parking_lasts_as_long_as_the_paper_s_and_says_how_it_ended() -> None:
    env = gym.make("carlab/Parking-v0")
    env.reset(seed=0)
    for step in range(100):
        _, _, terminated, truncated, info = env.step(np.zeros(2, dtype=np.float32))
        assert not terminated
        assert truncated == (step == 99)
    assert info["end_reason"] == "COMPLETED"
    assert set(info["summary"]) == {"distance_m", "yaw_error_rad", "speed_mps", "parked"}
    env.close()


def test_leaving_the_arena_truncates_with_the_reason() -> None:
    env = gym.make("carlab/Parking-v0")
    env.reset(seed=0)
    info: dict[str, object] = {}
    truncated = False
    for _ in range(100):
        _, _, terminated, truncated, info = env.step(np.array([0.0, 1.0], dtype=np.float32))
        if truncated:
            break
    assert truncated
    assert not terminated
    assert info["end_reason"] == "GEOFENCE"
    env.close()


def test_stepping_before_reset_is_refused() -> None:
    env = gym.make("carlab/Parking-v0").unwrapped
    assert isinstance(env, CarEnv)
    with pytest.raises(gym.error.ResetNeeded):
        env.step(np.zeros(2, dtype=np.float32))
