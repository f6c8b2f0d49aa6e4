"""Training between episodes: velocity delay, history length, failed fits and recordings without usable rows."""

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
from linear_cars import linear_car

from carlab.cars import choose_car
from carlab.core.episode_data import EpisodeData
from carlab.core.errors import DataError, DivergedError
from carlab.core.geofence import can_stop_inside
from carlab.core.observation import encode
from carlab.core.quantities import CarState
from carlab.experiment.campaign import predicted_return, training
from carlab.experiment.campaign.child_process import ChildError
from carlab.experiment.campaign.training import SUCCESS_BONUS, TrainingRequest, train
from carlab.experiment.campaign.training_plan import TrainingPlan
from carlab.experiment.campaign.training_process import TrainingDiedError, train_in_subprocess
from carlab.prediction.learned import drive_windows, recorded_windows
from carlab.recording.mcap.source import read_episode
from carlab.recording.run_folder import RunDirectory
from learning.policy.sac_agent import SacAgent
from learning.priors.simulator_model import CarModel
from learning.transitions import Transitions, transitions_of
from learning.world import car_fit, model_env
from learning.world.car_dynamics import CarDynamics
from learning.world.car_fit import CarFitSettings
from learning.world.disturbance_fit import rollout_errors
from learning.world.history import HistoryChoice
from sim_backends import SimulatorConfig
from tests.helpers import recorded_drives

pytestmark = pytest.mark.usefixtures("short_inference")


def test_model_uses_the_velocity_delay_of_the_recordings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A line fitted to the poses of the last 50 ms at 100 Hz gives the velocity of 25 ms before."""
    plan, run = tiny_plan(choose_car("sim")), drive(tmp_path, TICKS)
    delays_s: list[float] = []

    def stop_fit(plan: TrainingPlan, model: CarModel, *rest: Any) -> None:
        delays_s.append(model.velocity_delay_s)
        raise DataError("fit is not needed")

    monkeypatch.setattr(training, "_fitted", stop_fit)
    with pytest.raises(DataError, match="fit is not needed"):
        train(TrainingRequest(plan, tmp_path / "none", [], ENVELOPE), lambda *what: None)
    with pytest.raises(DataError, match="fit is not needed"):
        train(TrainingRequest(plan, tmp_path / "some", run.recordings(), ENVELOPE), lambda *what: None)
    assert delays_s == pytest.approx([0.025, 0.025], abs=1e-3)
    with_delays = replace(
        read_episode(run.episode_path(1)), extra={"velocity_delay_s": np.array([0.01, 0.02, np.nan, 0.04])}
    )
    assert training.velocity_delay_s([with_delays]) == 0.02
    assert training.velocity_delay_s([replace(with_delays, extra={})]) == 0.025, (
        "the default for recordings without the column"
    )


def test_particles_of_the_plan_correct_the_prior_simulator(tmp_path: Path) -> None:
    """In two trainings, of which the second continues with the networks of the first and fits rollouts."""
    plan = replace(tiny_plan(choose_car("sim"), model_steps=20, updates=8), particles="simulator")
    recordings, models = drive(tmp_path, TICKS).recordings(), tmp_path / "models"
    for count in (0, 1):
        train(TrainingRequest(plan, models, recordings[:count], ENVELOPE), lambda *what: None)
        car = car_fit.load_car(training.model_folder(models, count + 1) / training.DYNAMICS_FILE)
        assert car.posterior.simulator is not None
        assert car.posterior.simulator.model.config.kind == "kinematic"
        assert len(car.posterior.simulator.parameters) == len(car.posterior.parameters)


def test_history_length_is_selected_after_three_episodes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    episode_counts: list[int] = []

    def find(episodes: list[EpisodeData]) -> HistoryChoice:
        episode_counts.append(len(episodes))
        return HistoryChoice(6, {3: -1.0, 6: -2.0})

    monkeypatch.setattr(training, "find_history", find)
    plan = tiny_plan(choose_car("sim"), model_steps=20, updates=8)
    recordings = drive(tmp_path, TICKS, episodes=3).recordings()
    figures = [
        train(TrainingRequest(plan, tmp_path / str(n), recordings[:n], ENVELOPE), lambda *what: None) for n in (2, 3)
    ]
    assert episode_counts == [3]
    assert [f.get("supported_history") for f in figures] == [None, 6]
    assert "supports 6 past commands" in figures[1]["history_message"]


def test_diverged_training_is_repeated_with_a_smaller_learning_rate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    rates: dict[str, list[float]] = {"model": [], "policy": []}
    original_fit, original_train = car_fit.fit_car, SacAgent.train
    diverging = {"model", "policy"}

    def fit_car(rows: Any, model: Any, settings: Any, **others: Any) -> Any:
        rates["model"].append(settings.learning_rate)
        if len(rates["model"]) == 1:
            raise DivergedError("The fit diverged.")
        return original_fit(rows, model, settings, **others)

    def train_policy(self: SacAgent, *arguments: Any) -> dict[str, float]:
        rates["policy"].append(self._settings.learning_rate)
        if len(rates["policy"]) == 1 or "always" in diverging:
            raise DivergedError("The policy diverged.")
        return original_train(self, *arguments)

    monkeypatch.setattr(training, "fit_car", fit_car)
    monkeypatch.setattr(SacAgent, "train", train_policy)
    plan = tiny_plan(choose_car("sim"), model_steps=20, updates=8)
    (tmp_path / "models").mkdir()
    train(TrainingRequest(plan, tmp_path / "models", [], ENVELOPE), lambda *what: None)
    assert all(second == 0.25 * first for first, second in rates.values())
    assert "The model diverged" in caplog.text
    assert "The policy diverged" in caplog.text
    diverging.add("always")
    (tmp_path / "other").mkdir()
    with pytest.raises(DivergedError, match="with a smaller learning rate") as error:
        train(TrainingRequest(plan, tmp_path / "other", [], ENVELOPE), lambda *what: None)
    assert "\n" not in str(error.value)
    assert list((tmp_path / "other").iterdir()) == []


def test_car_is_fitted_to_rollouts_of_long_enough_episodes() -> None:
    """A linear car with biased steps predicts its recordings better afterwards; short episodes leave it as it is."""
    steps = CarFitSettings(steps=700)
    long, short = (recorded_drives.drive(SimulatorConfig(), seconds, 1) for seconds in (20.0, 1.2))
    rows = transitions_of([long], HISTORY)
    bias = np.array([0.0, 0.0, 0.0, 0.06, 0.0, 0.15])
    car = linear_car(None, replace(rows, targets=rows.targets + bias), len(rows), 0)

    def fitted(episode: EpisodeData) -> CarDynamics:
        own = transitions_of([episode], HISTORY)
        return training._fitted_to_rollouts(car, [episode], own, steps, 1.0, lambda *stage: None)

    windows = drive_windows(recorded_windows([long], 1.0, 0.5), HISTORY)
    before, after = (float(rollout_errors(c, windows).error.square().mean()) for c in (car, fitted(long)))
    assert after < 0.5 * before
    assert fitted(short) is car


def test_too_short_episode_gives_no_training_rows(tmp_path: Path) -> None:
    run = drive(tmp_path, HISTORY)
    stages: list[str] = []
    plan = tiny_plan(choose_car("sim"), model_steps=20, updates=8)
    figures = train(
        TrainingRequest(plan, run.models, run.recordings(), ENVELOPE), lambda stage, done, total: stages.append(stage)
    )
    assert figures["rows"] == 0
    assert "last_episode_nll" not in figures
    assert json.loads((run.models / "0002" / "training.json").read_text()) == figures
    assert list(dict.fromkeys(stages)) == ["reading the recordings", "learning the car", "learning to drive"]


def test_training_has_a_larger_stopping_margin_and_a_parking_bonus_and_the_prediction_has_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At 2 m/s the geofence needs 0.97 m; with this margin alone a policy is stopped as soon as the car slides more."""
    envs: list[model_env.ModelEnv] = []

    class CountedEnv(model_env.ModelEnv):
        def __init__(self, *arguments: Any, **options: Any) -> None:
            super().__init__(*arguments, **options)
            envs.append(self)

    for module in (training, predicted_return):
        monkeypatch.setattr(module, "ModelEnv", CountedEnv)
    (tmp_path / "models").mkdir()
    plan = tiny_plan(choose_car("sim"), model_steps=20, updates=8)
    train(TrainingRequest(plan, tmp_path / "models", [], ENVELOPE), lambda *what: None)
    edge_m = max(x for x, _ in ENVELOPE.arena_m)
    history = np.zeros((HISTORY, 2))
    training_env, evaluation_env, prediction_env, _drawn_cars = envs
    for env in (training_env, evaluation_env, prediction_env):
        # The predicted return is that of the real car's gate.
        for margin_m, stopped in ((1.1, env is not prediction_env), (1.4, False)):
            state = CarState(edge_m - margin_m, 0.0, 0.0, 2.0, 0.0, 0.0)
            assert can_stop_inside(ENVELOPE.arena_m, state, ENVELOPE.reaction_s, ENVELOPE.deceleration_mps2)
            row = torch.from_numpy(encode(state.to_array()[None], history[None])).float()
            assert env._stopped(row).tolist() == [stopped]
    features = torch.from_numpy(encode(np.diag([0.0, 1.0, 0.0, 0.0, 0.0, 0.0])[:2], np.zeros((2, HISTORY, 2)))).float()
    assert training_env._bonus is not None
    assert training_env._bonus(features).tolist() == pytest.approx([SUCCESS_BONUS, 0.0])
    assert evaluation_env._bonus is None
    assert prediction_env._bonus is None, "the predicted return is the task's reward alone"


@pytest.mark.parametrize("rate_hz", [30.0, 60.0, 15.0])
def test_horizon_and_bonus_of_a_second_are_the_same_at_each_rate(
    monkeypatch: pytest.MonkeyPatch, rate_hz: float
) -> None:
    choice = choose_car("sim")
    simulator = replace(choice.simulator, control_period_s=round(1.0 / rate_hz, 10))
    plan = tiny_plan(replace(choice, simulator=simulator))
    discounts: list[float] = []

    def train_policy(self: SacAgent, *arguments: Any) -> None:
        discounts.append(self._settings.discount)
        raise DataError("policy is not needed")

    monkeypatch.setattr(SacAgent, "train", train_policy)
    rows = Transitions(np.zeros((1, 5 + 2 * HISTORY)), np.zeros((1, 6)), np.zeros(1), np.zeros(1), HISTORY)
    env, *_ = training._environments(plan, linear_car(None, rows, 1, 0), [], ENVELOPE, 0)
    with pytest.raises(DataError, match="policy is not needed"):
        training._trained_policy(plan, env, env, None, 1, lambda *what: None)
    assert discounts == [pytest.approx(0.99 ** (30.0 / rate_hz))]
    assert rate_hz != 30.0 or discounts == [0.99]
    parked = torch.from_numpy(encode(np.zeros((1, 6)), np.zeros((1, HISTORY, 2)))).float()
    assert env._bonus is not None
    assert rate_hz * float(env._bonus(parked)) == pytest.approx(30.0 * SUCCESS_BONUS)


def test_training_accepts_an_episode_without_a_tick(tmp_path: Path) -> None:
    """The car stands outside the arena: the geofence ends the episode at once."""
    run = drive(tmp_path, TICKS, CarState(5.0, 5.0))
    assert len(run.recordings()) == 1
    plan = tiny_plan(choose_car("sim"), model_steps=20, updates=8)
    assert train(TrainingRequest(plan, run.models, run.recordings(), ENVELOPE), lambda *what: None)["rows"] == 0


@pytest.mark.parametrize(
    ("recording", "changes", "message"),
    [(b"rubbish", {}, "not an MCAP file"), (None, {"threads": 0}, "Training failed: RuntimeError")],
)
def test_error_in_the_training_process_is_reported_in_one_sentence(
    tmp_path: Path, recording: bytes | None, changes: dict[str, Any], message: str
) -> None:
    run = RunDirectory.create(tmp_path, "wrong")
    if recording is not None:
        run.episode_path(1).write_bytes(recording)
    plan = tiny_plan(choose_car("sim"), model_steps=1, **changes)
    with pytest.raises(DataError, match=message) as error:
        train_in_subprocess(TrainingRequest(plan, run.models, run.recordings(), ENVELOPE), lambda *what: None)
    assert "\n" not in str(error.value)
    assert names(run) == ([] if recording is None else ["episodes/0001.mcap"])
    assert multiprocessing.active_children() == []


@pytest.mark.parametrize(
    ("recordings", "expected"),
    [
        ([], "The training process died (exit code 1; -9 often means too little memory). Start the run again."),
        (
            [Path("0001.mcap")],
            "The training process died (exit code 1; -9 often means too little memory); the recordings remain. "
            "Resume the run with --resume.",
        ),
    ],
    ids=["before the first episode", "after an episode"],
)
def test_death_of_the_training_process_names_the_next_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, recordings: list[Path], expected: str
) -> None:
    def die(*_: object, **__: object) -> None:
        raise ChildError("died", "exit code 1")

    monkeypatch.setattr("carlab.experiment.campaign.training_process.run_in_child", die)
    plan = tiny_plan(choose_car("sim"))
    with pytest.raises(TrainingDiedError) as error:
        train_in_subprocess(TrainingRequest(plan, tmp_path, recordings, ENVELOPE), lambda *what: None)
    assert str(error.value) == expected
