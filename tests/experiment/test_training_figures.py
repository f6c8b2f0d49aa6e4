"""Figures of a training and of an episode: damaged files and wrong tasks are refused in one sentence."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pytest
from learning_runs import drive

from carlab.core.errors import ConfigError
from carlab.core.task import ParkingTask
from carlab.experiment.campaign.figures import figures_of
from carlab.experiment.episodes.session import result_of
from carlab.recording.mcap.source import read_episode

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
