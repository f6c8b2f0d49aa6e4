"""A policy that is trained in a world whose best commands are evident; kept, judged, saved and driven with."""

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
from learning.world.car_dynamics import StepInBody
from learning.world.model_env import ModelEnv, policy_inputs

HISTORY = 1
SETTINGS = SacSettings(hidden=(32,), cars=32, warm_up=512, batch=128, discount=0.5, learning_rate=3e-3, temperature=0.3)
SMALL = SacSettings(hidden=(8,), cars=16, warm_up=64, batch=32)
X_M = np.array([-1.2, -0.6, 0.6, 1.2])


@dataclass
class Still(StepInBody):
    """A car that changes by this number in everything; by default it stands."""

    history: int = HISTORY
    change: float = 0.0

    def sample(self, inputs: Tensor, generator: torch.Generator) -> Tensor:
        return torch.full((len(inputs), 6), self.change)


@dataclass(frozen=True)
class Sides(ParkingTask):
    """Steer right always; push to the side that the car stands on."""

    start_pose: tuple[float, float, float] = (0.0, 0.0, 0.0)
    start_spread: tuple[float, float, float] = (1.4, 0.3, 0.1)
    history_length: int = HISTORY
    max_ticks: int = 10

    def reward(self, features: Any, action: Any, next_features: Any) -> Any:
        return torch.sign(features[:, 0]) * action[:, 1] - action[:, 0]


def world(cars: int = 32, seed: int = 0, change: float = 0.0) -> ModelEnv:
    return ModelEnv(Still(change=change), Sides(), cars, seed=seed)


def features(x_m: np.ndarray) -> np.ndarray:
    found = np.zeros((len(x_m), 7 + 2 * HISTORY))
    found[:, 0], found[:, 3] = x_m, 1.0
    return found


def answers(agent: SacAgent) -> np.ndarray:
    return agent.act(policy_inputs(features(X_M)))


@pytest.fixture(scope="module")
def trained() -> SacAgent:
    agent = SacAgent(SETTINGS, seed=0)
    agent.train(world(), 640)
    return agent


def test_it_learns_what_is_evident(trained: SacAgent) -> None:
    steering, throttle = answers(trained).T
    assert np.all(steering < -0.8)
    assert np.all(throttle * np.sign(X_M) > 0.3)
    total, _ = world(64, seed=3).roll_out(trained.act)
    assert float(total.mean()) > 15.0, "20 are to be had in ten ticks"


def test_worlds_of_other_seeds_are_other_worlds() -> None:
    ends = []
    for seed in (1, 2):
        env = world(16, seed)
        SacAgent(SMALL, 0).train(env, 32)
        ends.append(env.features.numpy())
    assert not np.array_equal(*ends)


def test_training_makes_as_many_steps_as_it_was_told_and_tells_them() -> None:
    told: list[int] = []
    figures = SacAgent(SMALL, 0).train(world(16), 160, told.append)
    assert figures["train/n_updates"] == 160
    assert told[0] == 0
    assert told[-1] == 160
    assert told == sorted(told)
    assert all(np.isfinite(v) for v in figures.values())


def test_a_policy_that_was_read_acts_alike_and_learns_on_from_there(trained: SacAgent, tmp_path: Path) -> None:
    trained.save(tmp_path)
    again = SacAgent.load(tmp_path, SETTINGS, seed=1)
    np.testing.assert_array_equal(answers(again), answers(trained))
    again.train(world(seed=5), 32)
    assert not np.array_equal(answers(again), answers(trained))
    fresh = SacAgent(SETTINGS, seed=1)
    fresh.train(world(seed=5), 32)
    learned, new = (float(world(64, seed=3).roll_out(a.act)[0].mean()) for a in (again, fresh))
    assert learned > 15.0 > new + 3.0


@pytest.mark.parametrize(("values", "kept"), [((5, 4, 3, 2), 0), ((1, 2, 3, 4), 3), ((0, 7, 2, 7), 1)])
def test_the_best_judged_policy_is_kept_whole(values: tuple[float, ...], kept: int, tmp_path: Path) -> None:
    judged: list[np.ndarray] = []
    folders = [tmp_path / str(k) for k in range(5)]

    def judge(agent: SacAgent) -> float:
        folders[len(judged)].mkdir()
        agent.save(folders[len(judged)])
        judged.append(answers(agent))
        return values[len(judged) - 1]

    agent = SacAgent(SMALL, 0)
    agent.train(world(16), 256, evaluate=judge, n_evaluations=4)
    assert len(judged) == 4
    assert all(not np.array_equal(a, b) for a, b in pairwise(judged))
    np.testing.assert_array_equal(answers(agent), judged[kept])
    folders[4].mkdir()
    agent.save(folders[4])
    found, then = (dict(np.load(folders[k] / AGENT_FILE)) for k in (4, kept))
    assert {"log_temperature", "actor/square", "critics/steps"} < found.keys()
    for name, value in then.items():
        np.testing.assert_array_equal(found[name], value)


def test_a_policy_that_was_saved_and_read_trains_on_bit_for_bit_alike(tmp_path: Path) -> None:
    agent = SacAgent(SMALL, 3)
    agent.train(world(16), 64)
    agent.save(tmp_path)
    read = SacAgent.load(tmp_path, SMALL, 3)
    states = []
    for trained_on in (agent, read):
        trained_on.train(world(16, seed=2), 64)
        assert trained_on._sac is not None
        states.append(trained_on._sac.learned_state())
    assert int(states[0]["actor/steps"]) == 128
    for name, value in states[0].items():
        np.testing.assert_array_equal(states[1][name], value, err_msg=name)


def test_where_the_policy_was_judged_no_tick_of_the_world_is_lost() -> None:
    """A car that gains as much in each tick has gained as much in each row of the replay."""
    agent = SacAgent(SMALL, 0)
    agent.train(world(16, change=0.01), 256, evaluate=lambda agent: 0.0, n_evaluations=4)
    assert agent._sac is not None
    replay = agent._sac.replay_buffer
    assert replay is not None
    rows, speed = replay.pos, 4
    assert rows > 30
    gained = replay.next_observations[:rows, :, speed] - replay.observations[:rows, :, speed]
    np.testing.assert_allclose(gained, gained[0, 0], atol=1e-5)
    assert gained[0, 0] > 1e-3


@pytest.mark.parametrize("how", ["a rate far too large", "a world that is no number"])
def test_a_policy_that_diverges_is_told_and_the_earlier_one_kept(how: str) -> None:
    agent = SacAgent(SMALL, 0)
    agent.train(world(16), 64)
    before = answers(agent)
    env = world(16, change=float("nan") if how == "a world that is no number" else 0.0)
    if how == "a rate far too large":
        agent._settings = replace(SMALL, learning_rate=1e20)
    with pytest.raises(DivergedError, match="diverged") as error:
        agent.train(env, 256)
    assert "\n" not in str(error.value)
    np.testing.assert_array_equal(answers(agent), before)


def test_whatever_stops_the_training_the_earlier_policy_is_kept() -> None:
    def stop(agent: SacAgent) -> float:
        raise KeyboardInterrupt

    agent = SacAgent(SMALL, 0)
    agent.train(world(16), 64)
    before = answers(agent)
    with pytest.raises(KeyboardInterrupt):
        agent.train(world(16), 64, evaluate=stop)
    np.testing.assert_array_equal(answers(agent), before)


def view(row: np.ndarray) -> PolicyInput:
    seen = Observation(CarState(), 0.0, 0.0, 0)
    return PolicyInput(row, seen, 0, 0.0)


def test_on_the_car_it_drives_by_its_mean_action_within_the_limits(trained: SacAgent) -> None:
    policy = trained.policy()
    assert isinstance(policy, SacPolicy)
    assert isinstance(policy, Policy)
    policy.reset()
    for row, wanted in zip(features(X_M), answers(trained), strict=True):
        np.testing.assert_allclose(policy.act(view(row)).to_array(), wanted, atol=1e-6)  # one row, many rows
    wild = np.random.default_rng(0).normal(size=(40, 7 + 2 * HISTORY)) * 1e4
    actions = np.array([policy.act(view(row)).to_array() for row in wild])
    assert np.abs(actions).max() <= 1.0
    assert np.ptp(actions) > 0.5


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("saved")
    agent = SacAgent(SMALL, 0)
    agent.train(world(16), 32)
    agent.save(folder)
    return folder


@pytest.mark.parametrize("kind", ["not there", "empty", "cut short", "text", "a folder"])
def test_broken_files_are_refused_with_what_to_do(saved: Path, tmp_path: Path, kind: str) -> None:
    whole, path = (saved / AGENT_FILE).read_bytes(), tmp_path / AGENT_FILE
    if kind == "a folder":
        path.mkdir()
    elif kind != "not there":
        path.write_bytes({"empty": b"", "cut short": whole[: len(whole) // 2], "text": b"rubbish\n"}[kind])
    with pytest.raises(DataError, match=r"remove the folder to train again\.$") as error:
        SacAgent.load(tmp_path, SMALL, 0)
    assert "\n" not in str(error.value)


WEIGHT = "policy/actor.mu.weight"


@pytest.mark.parametrize(
    ("changed", "words"),
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
def test_arrays_that_do_not_fit_are_refused_in_a_sentence(
    saved: Path, tmp_path: Path, changed: dict[str, Any], words: str
) -> None:
    content = dict(np.load(saved / AGENT_FILE)) | changed
    np.savez_compressed(tmp_path / AGENT_FILE, **{k: v for k, v in content.items() if v is not None})
    with pytest.raises(DataError, match=rf"{words}.*to train again\.$") as error:
        SacAgent.load(tmp_path, SMALL, 0)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("kind", ["other layers", "another history"])
def test_an_agent_of_another_shape_is_refused(saved: Path, kind: str) -> None:
    """Where it is read, or at the latest where it is to go on learning."""
    settings, history = (replace(SMALL, hidden=(12,)), HISTORY) if kind == "other layers" else (SMALL, HISTORY + 2)
    env = ModelEnv(Still(history), Sides(history_length=history), 16)
    with pytest.raises(DataError, match="to train again"):
        SacAgent.load(saved, settings, 0).train(env, 32)
