"""A run that trained before two episodes, for the tests of training on a cluster, and signals that are not ignored."""

from __future__ import annotations

import shutil
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from learning_runs import ENVELOPE, TICKS, drive, small_plan

from carlab.experiment.campaign.training import TrainingRequest, train
from carlab.experiment.cluster.order import TrainingOrder
from carlab.jobs.child_jobs import write_files
from carlab.recording.run_folder import RunDirectory


@pytest.fixture
def default_hangup() -> Iterator[None]:
    """SIGHUP has its default action in this process and its children, also if nohup started the tests."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> RunDirectory:
    """A run with one recording, and the models before its first and second episode."""
    run = drive(tmp_path_factory.mktemp("trained"), TICKS)
    for recordings in ([], run.recordings()):
        train(TrainingRequest(small_plan(), run.models, recordings, ENVELOPE), lambda *what: None)
    return run


@pytest.fixture(scope="module")
def sent(trained: RunDirectory, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The second model as the cluster sends it."""
    folder = tmp_path_factory.mktemp("sent") / "0002"
    order = TrainingOrder(small_plan(), trained.models, tuple(trained.recordings()), ENVELOPE)
    write_files(folder, order.result())
    return folder


@pytest.fixture
def run(trained: RunDirectory, tmp_path: Path) -> RunDirectory:
    """A copy of the run without the second model, which is to be trained."""
    copy = RunDirectory(tmp_path / "run")
    shutil.copytree(trained.path, copy.path)
    shutil.rmtree(copy.models / "0002")
    return copy
