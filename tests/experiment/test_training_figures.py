"""Figures of a training and of an episode: damaged files and wrong tasks are refused in one sentence."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from pathlib import Path

import pytest
from learning_runs import drive, small_plan

from carlab.cars import choose_car
from carlab.core.errors import ConfigError, DataError
from carlab.core.task import ParkingTask
from carlab.experiment.campaign.campaign import Campaign
from carlab.experiment.campaign.figures import figures_of
from carlab.experiment.campaign.report import learning_curve, restore_missing_rows
from carlab.experiment.campaign.training import training_figures
from carlab.experiment.episodes.result import result_of
from carlab.recording.mcap.source import read_episode
from carlab.recording.run_folder import RunDirectory

TRAINING = {
    "episode": 1,
    "rows": 0,
    "model_seconds": 1.5,
    "policy_seconds": 2.0,
    "updates": 30,
    "predicted_return": 4.0,
    "return_in_model": 5.0,
}


class Silent(ParkingTask):
    """Parking without a goal distance in its outcome."""

    def outcome(self, summary: Mapping[str, float]) -> str:
        raise SystemExit(f"{int(summary['distance_m'] * float('nan'))} m")


def test_error_of_an_outcome_names_the_task_and_the_recording(tmp_path: Path) -> None:
    (path,) = drive(tmp_path, 3).recordings()
    result = result_of(1, read_episode(path), ParkingTask(), path)
    assert figures_of(result, TRAINING, ParkingTask()).outcome == "parked"
    with pytest.raises(ConfigError, match=r"The task parking cannot state the outcome of .*0001\.mcap \(ValueError"):
        figures_of(result, TRAINING, Silent())


def write_figures(run: RunDirectory, content: str) -> None:
    (run.models / "0001").mkdir(parents=True, exist_ok=True)
    (run.models / "0001" / "training.json").write_text(content, encoding="utf-8")


DAMAGED = {
    "empty": ("{}", "it has no episode"),
    "no object": ("[]", "it is not a JSON object"),
    "null": (json.dumps(TRAINING | {"rows": None}), "rows is None, not a count"),
    "list": (json.dumps(TRAINING | {"updates": [1]}), r"updates is \[1\], not a count"),
    "negative": (json.dumps(TRAINING | {"rows": -1}), "rows is -1, not a count"),
    "text": (json.dumps(TRAINING | {"model_seconds": "1"}), "model_seconds is '1', not a number"),
    "boolean": (json.dumps(TRAINING | {"return_in_model": True}), "return_in_model is True, not a number"),
    "optional": (json.dumps(TRAINING | {"predicted_low": {}}), "predicted_low is {}, not a number"),
    "message": (json.dumps(TRAINING | {"history_message": 3}), "history_message is 3, not a text"),
    "other episode": (json.dumps(TRAINING | {"episode": 2}), "is of episode 2, not 1"),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_damaged_figures_of_a_training_are_refused_before_the_drive(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, name: str
) -> None:
    content, message = DAMAGED[name]
    run = RunDirectory.create(tmp_path, "damaged")
    write_figures(run, content)
    with pytest.raises(DataError, match=rf"{message}\)?; remove the folder to train again\.$"):
        list(Campaign(choose_car("sim"), small_plan(), 1, run).run_episodes())
    assert run.recordings() == [], "the car has not been opened"
    driven = drive(tmp_path, 3)
    write_figures(driven, content)
    with caplog.at_level(logging.WARNING):
        restore_missing_rows(driven, ParkingTask())
    assert "The row of episode 1 in learn.json cannot be restored: " in caplog.text
    assert learning_curve(driven) == []


def test_figures_of_a_training_are_read_as_they_were_written(tmp_path: Path) -> None:
    run = RunDirectory.create(tmp_path, "whole")
    figures = TRAINING | {"last_episode_nll": -3.0, "needed_ticks": 150, "train/actor_loss": -4.5, "rows": 2**40}
    write_figures(run, json.dumps(figures))
    assert training_figures(run, 1) == figures
