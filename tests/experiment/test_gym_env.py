"""The Gymnasium environments: environment checkers, action history, seeds and end reasons."""

import warnings
from collections.abc import Iterator

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check
from stable_baselines3.common.env_checker import check_env as sb3_check
from terminating_parking import TerminatingParking

import carlab.experiment.episodes.gym_registration  # noqa: F401
from carlab.cars import default_car
from carlab.core.errors import ConfigError
from carlab.core.task import ParkingTask
from carlab.experiment.episodes.gym_env import CarEnv, make_env


@pytest.fixture(params=["carlab/Parking-v0", "carlab/Path-v0"])
def env(request: pytest.FixtureRequest) -> Iterator[gym.Env]:
    new_env = gym.make(request.param)
    yield new_env
    new_env.close()


def test_environment_checkers_pass_without_a_warning(env: gym.Env) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        gymnasium_check(env.unwrapped, skip_render_check=True)
        sb3_check(env.unwrapped, warn=True)


def test_observation_ends_with_the_last_sent_actions(env: gym.Env) -> None:
    env.reset(seed=1)
    sent = [np.zeros(2, dtype=np.float32)] * 3
    rng = np.random.default_rng(0)
    for _ in range(12):
        action = rng.uniform(-0.6, 0.6, 2).astype(np.float32)
        observation, *_ = env.step(action)
        sent = [*sent[1:], action]
        # Oldest action first.
        np.testing.assert_allclose(observation[7:], np.concatenate(sent), atol=1e-6)


def test_episodes_are_identical_for_one_seed_and_differ_between_seeds() -> None:
    def rollout(seed: int) -> np.ndarray:
        env = gym.make("carlab/Parking-v0")
        rows = [env.reset(seed=seed)[0]]
        rows += [env.step(np.array([0.3, -0.4], dtype=np.float32))[0] for _ in range(30)]
        env.close()
        return np.stack(rows)

    assert rollout(5).tobytes() == rollout(5).tobytes()
    assert not np.array_equal(rollout(5), rollout(6))


def test_parking_episode_has_100_steps_and_reports_its_end() -> None:
    env = gym.make("carlab/Parking-v0")
    env.reset(seed=0)
    for step in range(100):
        _, _, terminated, truncated, info = env.step(np.zeros(2, dtype=np.float32))
        assert not terminated
        assert truncated == (step == 99)
    assert info["end_reason"] == "COMPLETED"
    assert set(info["summary"]) == {"distance_m", "yaw_error_rad", "speed_mps", "success"}
    env.close()


def test_leaving_the_arena_truncates_with_reason_geofence() -> None:
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


def test_step_before_reset_is_refused() -> None:
    env = gym.make("carlab/Parking-v0").unwrapped
    assert isinstance(env, CarEnv)
    with pytest.raises(gym.error.ResetNeeded):
        env.step(np.zeros(2, dtype=np.float32))


def test_environment_of_a_task_object_and_a_car_file() -> None:
    task = TerminatingParking(max_ticks=7)
    env = make_env(task, vehicle=default_car().with_values({"timing.control_period": 0.05}))
    gymnasium_check(env, skip_render_check=True)
    env.reset(seed=0)
    steps = 1
    while not env.step(np.zeros(2, dtype=np.float32))[3]:
        steps += 1
    assert steps == task.at_period(0.05).max_ticks
    env.close()


@pytest.mark.parametrize(
    ("task", "message"), [("drift", "--task drift: choose one of"), (ParkingTask, "it is a class")]
)
def test_unknown_task_is_refused(task: object, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make_env(task)  # type: ignore[arg-type]
