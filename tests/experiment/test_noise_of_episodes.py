"""The sensor noise of an episode follows from the seed of the run and the number of the episode."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from learning_runs import TICKS, small_plan

from carlab.cars import choose_car
from carlab.core.episode_data import EpisodeData
from carlab.experiment.campaign.campaign import Campaign
from carlab.experiment.campaign.quick_check import check_path
from carlab.recording.run_folder import RunDirectory


def run_with_models(trained: RunDirectory, folder: Path) -> RunDirectory:
    """A run with the models of two episodes and no recording; its quick checks count as done."""
    run = RunDirectory.create(folder, "learn")
    for number in (1, 2):
        shutil.copytree(trained.models / f"{number:04d}", run.models / f"{number:04d}")
        check_path(run, number).touch()
    return run


def driven(run: RunDirectory, dry_run: bool) -> list[EpisodeData]:
    """The episodes up to the second, on a car that is opened now."""
    choice = choose_car("sim", dry_run=dry_run)
    with choice.car:
        campaign = Campaign(choice, small_plan(), 2, run, max_ticks=TICKS, record_rerun=False)
        return [result.data for result in campaign.run_episodes()]


@pytest.mark.parametrize("dry_run", [False, True])
def test_resumed_run_has_the_noise_of_an_uninterrupted_one(
    trained: RunDirectory, tmp_path: Path, dry_run: bool
) -> None:
    run, resumed = (run_with_models(trained, tmp_path / name) for name in ("run", "resumed"))
    first, second = driven(run, dry_run)
    shutil.copy(run.episode_path(1), resumed.episode_path(1))
    (repeated,) = driven(resumed, dry_run)
    assert repeated.poses[:, 1:] == pytest.approx(second.poses[:, 1:], abs=1e-9)
    changes = [np.diff(episode.poses[:10, 1:], axis=0) for episode in (first, repeated)]
    assert np.abs(changes[0] - changes[1]).max() > 1e-4, "the noise differs between the episodes"
