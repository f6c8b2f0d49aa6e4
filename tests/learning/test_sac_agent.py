"""Test the SAC agent in an environment with a known optimal policy: training, selection, files, driving."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from carlab.core.errors import DataError, DivergedError
from carlab.core.policy import Policy, PolicyInput
from carlab.core.quantities import CarState, Observation
from carlab.core.task import ParkingTask
from learning.policy.sac_agent import AGENT_FILE, SacAgent, SacPolicy, SacSettings
from learning.world.model_env import ModelEnv, policy_inputs
from tests.helpers.step_in_body import StepInBody

HISTORY = 1
SETTINGS = SacSettings(hidden=(32,), cars=32, warm_up=512, batch=128, discount=0.5, learning_rate=3e-3, temperature=0.3)
SMALL = SacSettings(hidden=(8,), cars=16, warm_up=64, batch=32)
X_M = np.array([-1.2, -0.6, 0.6, 1.2])


@dataclass
class ConstantChange(StepInBody):
    """A learned car whose state changes by a constant per step; zero means standstill."""

    history: int = HISTORY
    change: float = 0.0

    def sample(self, inputs: Tensor, generator: torch.Generator) -> Tensor:
        return torch.full((len(inputs), 6), self.change)


@dataclass(frozen=True)
class SignTask(ParkingTask):
    """The optimum is steering -1 and throttle equal to the sign of x."""

    start_pose: tuple[float, float, float] = (0.0, 0.0, 0.0)
    start_spread: tuple[float, float, float] = (1.4, 0.3, 0.1)
    history_length: int = HISTORY
    max_ticks: int = 10

    def reward(self, features: Any, action: Any, next_features: Any) -> Any:
        return torch.sign(features[:, 0]) * action[:, 1] - action[:, 0]


def world(cars: int = 32, seed: int = 0, change: float = 0.0) -> ModelEnv:
    return ModelEnv(ConstantChange(change=change), SignTask(), cars, seed=seed)


def features(x_m: np.ndarray) -> np.ndarray:
    found = np.zeros((len(x_m), 7 + 2 * HISTORY))
    found[:, 0], found[:, 3] = x_m, 1.0
    return found


def actions_of(agent: SacAgent) -> np.ndarray:
    return agent.act(policy_inputs(features(X_M)))


@pytest.fixture(scope="module")
def trained() -> SacAgent:
    agent = SacAgent(SETTINGS, seed=0)
    agent.train(world(), 640)
    return agent


def test_training_finds_the_known_optimal_policy(trained: SacAgent) -> None:
    steering, throttle = actions_of(trained).T
    assert np.all(steering < -0.8)
    assert np.all(throttle * np.sign(X_M) > 0.3)
    total, *_ = world(64, seed=3).roll_out(trained.act)
    assert float(total.mean()) > 15.0, "the maximum return of ten ticks is 20"


def test_environments_with_different_seeds_differ() -> None:
    final_features = []
    for seed in (1, 2):
        env = world(16, seed)
        SacAgent(SMALL, 0).train(env, 32)
        final_features.append(env.features.numpy())
    assert not np.array_equal(*final_features)


def test_training_makes_the_requested_steps_and_reports_progress() -> None:
    reported_steps: list[int] = []
    figures = SacAgent(SMALL, 0).train(world(16), 160, reported_steps.append)
    assert figures["train/n_updates"] == 160
    assert reported_steps[0] == 0
    assert reported_steps[-1] == 160
    assert reported_steps == sorted(reported_steps)
    assert all(np.isfinite(v) for v in figures.values())


def test_loaded_agent_acts_identically_and_continues_learning(trained: SacAgent, tmp_path: Path) -> None:
    trained.save(tmp_path)
    loaded = SacAgent.load(tmp_path, SETTINGS, seed=1)
    np.testing.assert_array_equal(actions_of(loaded), actions_of(trained))
    loaded.train(world(seed=5), 32)
    assert not np.array_equal(actions_of(loaded), actions_of(trained))
    fresh = SacAgent(SETTINGS, seed=1)
    fresh.train(world(seed=5), 32)
    loaded_return, fresh_return = (float(world(64, seed=3).roll_out(a.act)[0].mean()) for a in (loaded, fresh))
    assert loaded_return > 15.0 > fresh_return + 3.0


@pytest.mark.parametrize(("values", "best_index"), [((5, 4, 3, 2), 0), ((1, 2, 3, 4), 3), ((0, 7, 2, 7), 1)])
def test_policy_with_the_best_evaluation_is_restored(
    values: tuple[float, ...], best_index: int, tmp_path: Path
) -> None:
    evaluated: list[np.ndarray] = []
    folders = [tmp_path / str(k) for k in range(5)]

    def evaluate(agent: SacAgent) -> float:
        folders[len(evaluated)].mkdir()
        agent.save(folders[len(evaluated)])
        evaluated.append(actions_of(agent))
        return values[len(evaluated) - 1]

    agent = SacAgent(SMALL, 0)
    agent.train(world(16), 256, evaluate=evaluate, n_evaluations=4)
    assert len(evaluated) == 4
    assert all(not np.array_equal(a, b) for a, b in pairwise(evaluated))
    np.testing.assert_array_equal(actions_of(agent), evaluated[best_index])
    folders[4].mkdir()
    agent.save(folders[4])
    restored, best = (dict(np.load(folders[k] / AGENT_FILE)) for k in (4, best_index))
    assert {"log_temperature", "actor/square", "critics/steps"} < restored.keys()
    for name, value in best.items():
        np.testing.assert_array_equal(restored[name], value)


def test_earlier_policy_is_kept_if_the_training_makes_it_worse() -> None:
    agent = SacAgent(SMALL, 0)
    agent.train(world(16), 64)
    before = actions_of(agent)
    scores = iter((5.0, 4.0, 3.0))
    agent.train(world(16), 64, evaluate=lambda agent: next(scores), n_evaluations=2)
    np.testing.assert_array_equal(actions_of(agent), before)


def test_loaded_agent_trains_bit_identically(tmp_path: Path) -> None:
    agent = SacAgent(SMALL, 3)
    agent.train(world(16), 64)
    agent.save(tmp_path)
    loaded = SacAgent.load(tmp_path, SMALL, 3)
    states = []
    for trained_agent in (agent, loaded):
        trained_agent.train(world(16, seed=2), 64)
        assert trained_agent._sac is not None
        states.append(trained_agent._sac.learned_state())
    assert int(states[0]["actor/steps"]) == 128
    for name, value in states[0].items():
        np.testing.assert_array_equal(states[1][name], value, err_msg=name)


def test_evaluation_loses_no_step_of_the_replay() -> None:
    """A constant speed change per tick appears in each row of the replay."""
    agent = SacAgent(SMALL, 0)
    agent.train(world(16, change=0.01), 256, evaluate=lambda agent: 0.0, n_evaluations=4)
    assert agent._sac is not None
    replay = agent._sac.replay_buffer
    assert replay is not None
    rows, speed = replay.pos, 4
    assert rows > 30
    speed_change = replay.next_observations[:rows, :, speed] - replay.observations[:rows, :, speed]
    np.testing.assert_allclose(speed_change, speed_change[0, 0], atol=1e-5)
    assert speed_change[0, 0] > 1e-3


@pytest.mark.parametrize("cause", ["learning rate too large", "NaN dynamics"])
def test_diverged_training_is_reported_and_keeps_the_earlier_policy(cause: str) -> None:
    agent = SacAgent(SMALL, 0)
    agent.train(world(16), 64)
    before = actions_of(agent)
    env = world(16, change=float("nan") if cause == "NaN dynamics" else 0.0)
    if cause == "learning rate too large":
        agent._settings = replace(SMALL, learning_rate=1e20)
    with pytest.raises(DivergedError, match="diverged") as error:
        agent.train(env, 256)
    assert "\n" not in str(error.value)
    np.testing.assert_array_equal(actions_of(agent), before)


def test_interrupted_training_keeps_the_earlier_policy() -> None:
    def stop(agent: SacAgent) -> float:
        raise KeyboardInterrupt

    agent = SacAgent(SMALL, 0)
    agent.train(world(16), 64)
    before = actions_of(agent)
    with pytest.raises(KeyboardInterrupt):
        agent.train(world(16), 64, evaluate=stop)
    np.testing.assert_array_equal(actions_of(agent), before)


def view(row: np.ndarray) -> PolicyInput:
    observation = Observation(CarState(), 0.0, 0.0, 0)
    return PolicyInput(row, observation, 0, 0.0)


def test_policy_on_the_car_uses_the_mean_action_within_limits(trained: SacAgent) -> None:
    policy = trained.policy()
    assert isinstance(policy, SacPolicy)
    assert isinstance(policy, Policy)
    policy.reset()
    for row, expected in zip(features(X_M), actions_of(trained), strict=True):
        np.testing.assert_allclose(policy.act(view(row)).to_array(), expected, atol=1e-6)  # one row, many rows
    extreme_features = np.random.default_rng(0).normal(size=(40, 7 + 2 * HISTORY)) * 1e4
    actions = np.array([policy.act(view(row)).to_array() for row in extreme_features])
    assert np.abs(actions).max() <= 1.0
    assert np.ptp(actions) > 0.5


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("saved")
    agent = SacAgent(SMALL, 0)
    agent.train(world(16), 32)
    agent.save(folder)
    return folder


@pytest.mark.parametrize("kind", ["missing", "empty", "cut short", "text", "a folder"])
def test_invalid_agent_file_is_refused_with_the_remedy(saved: Path, tmp_path: Path, kind: str) -> None:
    file_bytes, path = (saved / AGENT_FILE).read_bytes(), tmp_path / AGENT_FILE
    if kind == "a folder":
        path.mkdir()
    elif kind != "missing":
        path.write_bytes({"empty": b"", "cut short": file_bytes[: len(file_bytes) // 2], "text": b"rubbish\n"}[kind])
    with pytest.raises(DataError, match=r"remove the folder to train again\.$") as error:
        SacAgent.load(tmp_path, SMALL, 0)
    assert "\n" not in str(error.value)


WEIGHT = "policy/actor.mu.weight"


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({WEIGHT: None}, "actor.mu.weight is missing"),
        ({WEIGHT: np.zeros((3, 8), np.float32)}, r"shape \(3, 8\), not float32 of shape \(2, 8\)"),
        ({WEIGHT: np.zeros((2, 8))}, "is float64 of shape"),
        ({WEIGHT: np.full((2, 8), np.nan, np.float32)}, "not finite"),
        ({WEIGHT: np.array("text")}, "no numbers"),
        ({"actor/mean": np.zeros((1, 3), np.float32)}, "actor/mean is float32 of shape"),
        ({"critics/steps": np.array(-1)}, "critics/steps is not a non-negative integer"),
        ({"critics/steps": np.array(1.5)}, "critics/steps is not a non-negative integer"),
        ({"log_temperature": np.array(["a"])}, "no numbers"),
        ({"version": np.array(7)}, "it has version 7"),
        ({"observation_size": np.array(10**12)}, "1000000000000 features"),
        ({"observation_size": None}, "observation_size is not a non-negative integer"),
        ({"extra": np.zeros(70_000_000, np.float32)}, "more than 256 MB"),
    ],
    ids=lambda v: None if isinstance(v, str) else next(iter(v)),
)
def test_inconsistent_agent_file_is_refused_in_one_sentence(
    saved: Path, tmp_path: Path, changed: dict[str, Any], message: str
) -> None:
    content = dict(np.load(saved / AGENT_FILE)) | changed
    np.savez_compressed(tmp_path / AGENT_FILE, **{k: v for k, v in content.items() if v is not None})
    with pytest.raises(DataError, match=rf"{message}.*to train again\.$") as error:
        SacAgent.load(tmp_path, SMALL, 0)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("kind", ["other layers", "another history"])
def test_agent_of_another_shape_is_refused(saved: Path, kind: str) -> None:
    """Either loading or further training refuses it."""
    settings, history = (replace(SMALL, hidden=(12,)), HISTORY) if kind == "other layers" else (SMALL, HISTORY + 2)
    env = ModelEnv(ConstantChange(history), SignTask(history_length=history), 16)
    with pytest.raises(DataError, match="to train again"):
        SacAgent.load(saved, settings, 0).train(env, 32)


def test_moments_of_a_widened_agent_stay_with_their_weights() -> None:
    """Each first-layer moment of a wider agent is that of the same input; moments of new inputs are 0."""
    agent = SacAgent(SMALL, 0)
    agent.train(ModelEnv(ConstantChange(), SignTask(), 16), 0)
    narrow = agent.policy().sac
    state = narrow.learned_state()
    inputs = 7 + 2 * HISTORY
    for name, width in (("actor", inputs), ("critics", inputs + 2)):
        weights = narrow.layers_of(f"{name}/mean", state[f"{name}/mean"])[0]
        weights.copy_(torch.arange(1.0, width + 1.0)[None, :, None].expand_as(weights))
    narrow.load_learned_state(state)
    agent.widen(inputs + 4)
    wide = agent.policy().sac
    for name, width in (("actor", inputs), ("critics", inputs + 2)):
        weights = wide.layers_of(f"{name}/mean", wide.learned_state()[f"{name}/mean"])[0]
        expected = [*range(1, 8), 0, 0, 0, 0, *range(8, width + 1)]
        assert weights.shape[1] == len(expected)
        torch.testing.assert_close(weights, torch.tensor(expected).float()[None, :, None].expand_as(weights))


def test_agent_with_more_past_commands_acts_as_before_and_learns(tmp_path: Path) -> None:
    trained_agent = SacAgent(SMALL, 0)
    trained_agent.train(ModelEnv(ConstantChange(), SignTask(), 16), 8)
    trained_agent.save(tmp_path)
    wider = SacAgent.load(tmp_path, SMALL, 0)
    wider.widen(7 + 2 * 3)
    seen = np.random.default_rng(0).normal(size=(20, 7 + 2 * 3)).astype(np.float32)
    own = np.concatenate([seen[:, :7], seen[:, -2 * HISTORY :]], axis=1)
    np.testing.assert_allclose(wider.act(seen), trained_agent.act(own), atol=1e-6)
    wider.train(ModelEnv(ConstantChange(history=3), SignTask(history_length=3), 16), 8)
    changed = seen.copy()
    changed[:, 7:11] += 1.0
    assert np.abs(wider.act(changed) - wider.act(seen)).max() > 1e-6, "training uses the new commands"
