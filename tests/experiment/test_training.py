"""What is trained between episodes: what the model gets of the recordings, and what happens where a fit fails."""

from __future__ import annotations

import json
import multiprocessing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from learning_runs import ENVELOPE, HISTORY, TICKS, drive, names, tiny_plan

from carlab.cars import choose_car
from carlab.core.episode_data import EpisodeData
from carlab.core.errors import DataError, DivergedError
from carlab.core.geofence import can_stop_inside
from carlab.core.observation import encode
from carlab.core.quantities import CarState
from carlab.experiment.campaign import training
from carlab.experiment.campaign.training import PARKED_BONUS, TrainingPlan, train
from carlab.experiment.campaign.training_process import train_in_subprocess
from carlab.recording.mcap.source import read_episode
from carlab.recording.run_folder import RunDirectory
from learning.policy.sac_agent import SacAgent
from learning.priors.simulator_model import CarModel
from learning.world import car_fit, model_env
from learning.world.history import HistoryChoice


def test_the_model_is_told_by_how_much_recorded_velocities_are_late(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A line through the poses of 50 ms, 100 of them a second, has its slope 25 ms ago."""
    plan, run = tiny_plan(choose_car("sim")), drive(tmp_path, TICKS)
    told: list[float] = []

    def fitted(plan: TrainingPlan, model: CarModel, *rest: Any) -> None:
        told.append(model.velocity_delay_s)
        raise DataError("seen enough")

    monkeypatch.setattr(training, "_fitted", fitted)
    with pytest.raises(DataError, match="seen enough"):
        train(plan, tmp_path / "none", [], ENVELOPE, lambda *what: None)
    with pytest.raises(DataError, match="seen enough"):
        train(plan, tmp_path / "some", run.recordings(), ENVELOPE, lambda *what: None)
    assert told == pytest.approx([0.025, 0.025], abs=1e-3)
    late = replace(read_episode(run.episode_path(1)), extra={"velocity_delay_s": np.array([0.01, 0.02, np.nan, 0.04])})
    assert training.velocity_delay_s([late]) == 0.02
    assert training.velocity_delay_s([replace(late, extra={})]) == 0.025, "of recordings that do not say"


def test_after_three_episodes_it_is_found_how_many_commands_count(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[int] = []

    def find(episodes: list[EpisodeData]) -> HistoryChoice:
        asked.append(len(episodes))
        return HistoryChoice(6, {3: -1.0, 6: -2.0})

    monkeypatch.setattr(training, "find_history", find)
    plan = tiny_plan(choose_car("sim"), model_steps=20, updates=8)
    recordings = drive(tmp_path, TICKS, episodes=3).recordings()
    found = [train(plan, tmp_path / str(n), recordings[:n], ENVELOPE, lambda *what: None) for n in (2, 3)]
    assert asked == [3]
    assert [f.get("history_asked") for f in found] == [None, 6]
    assert "supports 6 past commands" in found[1]["history_words"]


def test_what_diverged_is_learned_again_with_smaller_steps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    rates: dict[str, list[float]] = {"model": [], "policy": []}
    fit, teach = car_fit.fit_car, SacAgent.train
    broken = {"model", "policy"}

    def fit_car(rows: Any, model: Any, settings: Any, **others: Any) -> Any:
        rates["model"].append(settings.learning_rate)
        if len(rates["model"]) == 1:
            raise DivergedError("The fit diverged.")
        return fit(rows, model, settings, **others)

    def taught(self: SacAgent, *arguments: Any) -> dict[str, float]:
        rates["policy"].append(self._settings.learning_rate)
        if len(rates["policy"]) == 1 or "always" in broken:
            raise DivergedError("The policy diverged.")
        return teach(self, *arguments)

    monkeypatch.setattr(car_fit, "fit_car", fit_car)
    monkeypatch.setattr(SacAgent, "train", taught)
    plan = tiny_plan(choose_car("sim"), model_steps=20, updates=8)
    (tmp_path / "models").mkdir()
    train(plan, tmp_path / "models", [], ENVELOPE, lambda *what: None)
    assert all(second == 0.25 * first for first, second in rates.values())
    assert "The model diverged" in caplog.text
    assert "The policy diverged" in caplog.text
    broken.add("always")
    (tmp_path / "other").mkdir()
    with pytest.raises(DivergedError, match="with a smaller learning rate") as error:
        train(plan, tmp_path / "other", [], ENVELOPE, lambda *what: None)
    assert "\n" not in str(error.value)
    assert list((tmp_path / "other").iterdir()) == []


def test_from_an_episode_that_is_too_short_nothing_is_learned_but_the_prior(tmp_path: Path) -> None:
    run = drive(tmp_path, HISTORY)
    told: list[str] = []
    plan = tiny_plan(choose_car("sim"), model_steps=20, updates=8)
    figures = train(plan, run.models, run.recordings(), ENVELOPE, lambda what, done, total: told.append(what))
    assert figures["rows"] == 0
    assert "last_episode_nll" not in figures
    assert json.loads((run.models / "0002" / "training.json").read_text()) == figures
    assert list(dict.fromkeys(told)) == ["reading the recordings", "learning the car", "learning to drive"]


def test_the_learned_car_keeps_more_room_and_is_paid_for_standing_in_its_spot(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At 2 m/s the gate asks for 0.97 m; a policy that lives on just that is stopped as soon as the car slides more."""
    made: list[model_env.ModelEnv] = []

    class Kept(model_env.ModelEnv):
        def __init__(self, *arguments: Any, **options: Any) -> None:
            super().__init__(*arguments, **options)
            made.append(self)

    monkeypatch.setattr(model_env, "ModelEnv", Kept)
    (tmp_path / "models").mkdir()
    plan = tiny_plan(choose_car("sim"), model_steps=20, updates=8)
    train(plan, tmp_path / "models", [], ENVELOPE, lambda *what: None)
    edge_m = max(x for x, _ in ENVELOPE.arena_m)
    history = np.zeros((HISTORY, 2))
    for world in made:
        for left_m, stopped in ((1.1, True), (1.4, False)):
            rushing = CarState(edge_m - left_m, 0.0, 0.0, 2.0, 0.0, 0.0)
            assert can_stop_inside(ENVELOPE.arena_m, rushing, ENVELOPE.reaction_s, ENVELOPE.deceleration_mps2)
            row = torch.from_numpy(encode(rushing.to_array()[None], history[None])).float()
            assert world._stopped(row).tolist() == [stopped]
    trained, judged = made
    there = torch.from_numpy(encode(np.diag([0.0, 1.0, 0.0, 0.0, 0.0, 0.0])[:2], np.zeros((2, HISTORY, 2)))).float()
    assert trained._bonus is not None
    assert trained._bonus(there).tolist() == pytest.approx([PARKED_BONUS, 0.0])
    assert judged._bonus is None, "the predicted return is the task's reward alone"


def test_an_episode_that_ended_before_its_first_tick_is_no_obstacle(tmp_path: Path) -> None:
    """Somebody put the car down outside the arena: the gate ends the episode at once, and the next may follow."""
    run = drive(tmp_path, TICKS, CarState(5.0, 5.0))
    assert len(run.recordings()) == 1
    plan = tiny_plan(choose_car("sim"), model_steps=20, updates=8)
    assert train(plan, run.models, run.recordings(), ENVELOPE, lambda *what: None)["rows"] == 0


@pytest.mark.parametrize(
    ("recording", "changes", "said"),
    [(b"rubbish", {}, "not an MCAP file"), (None, {"threads": 0}, "Training failed: RuntimeError")],
)
def test_what_goes_wrong_in_the_other_process_is_said_in_a_sentence(
    tmp_path: Path, recording: bytes | None, changes: dict[str, Any], said: str
) -> None:
    run = RunDirectory.create(tmp_path, "wrong")
    if recording is not None:
        run.episode_path(1).write_bytes(recording)
    plan = tiny_plan(choose_car("sim"), model_steps=1, **changes)
    with pytest.raises(DataError, match=said) as error:
        train_in_subprocess(plan, run.models, run.recordings(), ENVELOPE, lambda *what: None)
    assert "\n" not in str(error.value)
    assert names(run) == ([] if recording is None else ["episodes/0001.mcap"])
    assert multiprocessing.active_children() == []
