"""Orders of a training: which files travel, and how the service of the cluster trains them."""

from __future__ import annotations

import json
import shutil
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from learning_runs import ENVELOPE, small_plan

from carlab.core.errors import ConfigError, DataError
from carlab.core.safety import SafetyEnvelope
from carlab.core.task import ParkingTask
from carlab.core.task_choice import choose_task
from carlab.core.version import VERSION
from carlab.experiment.campaign.training_process import TrainingDiedError
from carlab.experiment.cluster.link import run_order
from carlab.experiment.cluster.link_protocol import LinkEvent, LinkRequest
from carlab.experiment.cluster.order import RESULT_FILES, TrainingOrder
from carlab.experiment.cluster.service import TrainingService, sha256
from carlab.experiment.cluster.settings import LinkSettings
from carlab.jobs.child_jobs import write_files
from carlab.recording.run_folder import RunDirectory


def test_order_is_read_as_it_was_sent(run: RunDirectory, tmp_path: Path) -> None:
    numpy_corner = (np.int64(1), np.float32(0.5))  # of a user's task
    envelope = SafetyEnvelope(max_throttle=0.3, arena_m=((0.0, 0.0), numpy_corner, (0.0, 2.0)))
    sent = TrainingOrder(small_plan(seed=4), run.models, tuple(run.recordings()), envelope)
    files = sent.files()
    assert set(files) == {"order.json", "episodes/0001.mcap", "models/0001/dynamics.npz", "models/0001/policy.npz"}
    assert not [name for name, content in files.items() if b".pkl" in content], "no file contains a pickle"
    write_files(tmp_path / "order", files)
    read = TrainingOrder.read(tmp_path / "order")
    assert (read.plan, read.envelope, read.number) == (sent.plan, envelope, 2)
    assert read.recordings[0].read_bytes() == run.recordings()[0].read_bytes()
    for name in ("dynamics.pt", "policy.npz"):
        assert (read.models / "0001" / name).read_bytes() == (run.models / "0001" / name).read_bytes()


def test_task_of_a_user_travels_as_its_file(run: RunDirectory, tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text("from carlab.core.task import ParkingTask\nclass Mine(ParkingTask): ...\n")
    plan = small_plan(task_choice=choose_task(f"{file}:Mine"))
    write_files(tmp_path / "order", TrainingOrder(plan, run.models, (), ENVELOPE).files())
    assert type(TrainingOrder.read(tmp_path / "order").plan.task).__name__ == "Mine"
    shutil.copytree(tmp_path / "order", tmp_path / "other")
    (tmp_path / "other" / "task.py").write_text("raise SystemExit")
    changed = TrainingOrder.read(tmp_path / "other").plan
    with pytest.raises(ConfigError, match="was changed"):
        assert changed.task


def test_task_object_is_refused(run: RunDirectory) -> None:
    plan = small_plan(task_choice=choose_task(ParkingTask()))
    with pytest.raises(ConfigError, match=r"name it as FILE\.py:CLASS"):
        TrainingOrder(plan, run.models, (), ENVELOPE).files()


@pytest.mark.parametrize("content", [b"rubbish", b"{}", b'{"plan": {}, "envelope": {}, "recordings": []}'])
def test_damaged_order_is_refused(tmp_path: Path, content: bytes) -> None:
    write_files(tmp_path, {"order.json": content})
    with pytest.raises(DataError, match="cannot be read"):
        TrainingOrder.read(tmp_path)


def wait(seconds: float) -> None:
    threading.Event().wait(seconds)


def served(service: TrainingService, order: TrainingOrder, tmp_path: Path) -> tuple[Path, list[LinkEvent]]:
    """Run an order on a service in this process."""
    events: list[LinkEvent] = []
    write_files(tmp_path / "order", order.files())
    request = LinkRequest(str(tmp_path / "order"), str(tmp_path / "result"))

    def call(method: str, *arguments: Any) -> Any:
        return getattr(service, method)(*arguments)

    run_order(call, request, events.append, LinkSettings(poll_s=0.05), wait)
    return tmp_path / "result", events


def test_training_of_the_service_equals_the_training_here(
    trained: RunDirectory, run: RunDirectory, tmp_path: Path
) -> None:
    """The same seed gives the same policy, bit for bit, from the files of the order alone."""
    service = TrainingService(VERSION)
    order = TrainingOrder(small_plan(), run.models, tuple(run.recordings()), ENVELOPE)
    result, events = served(service, order, tmp_path)
    assert [e.kind for e in events if e.activity is None] == ["answer"] * 7 + ["done"], "four files there, three back"
    assert {e.activity[0] for e in events if e.activity is not None} >= {"learning to drive"}
    assert {p.name for p in result.iterdir()} == RESULT_FILES
    with np.load(result / "policy.npz") as found, np.load(trained.models / "0002" / "policy.npz") as expected:
        assert set(found) == set(expected)
        assert all(np.array_equal(found[name], expected[name]) for name in expected)
    _, again = served(service, order, tmp_path)
    assert [e.kind for e in again] == ["done"], "a new link sends nothing again and finds the finished training"
    policy = (result / "policy.npz").read_bytes()
    (result / "policy.npz").write_bytes(policy[:100])
    assert [e.kind for e in served(service, order, tmp_path)[1]] == ["answer", "done"]
    assert (result / "policy.npz").read_bytes() == policy, "a file whose transfer broke off is fetched again"


def test_new_order_ends_the_running_one(monkeypatch: pytest.MonkeyPatch, run: RunDirectory) -> None:
    started: list[int] = []
    stopped: list[int] = []

    def train_until_stopped(order: TrainingOrder, progress: Any, stop: Any) -> None:
        started.append(order.plan.seed)
        while not stop():
            wait(0.01)
        stopped.append(order.plan.seed)

    monkeypatch.setattr("carlab.experiment.cluster.service.train_in_subprocess", train_until_stopped)
    service = TrainingService(VERSION)
    for seed in (1, 1, 2):
        files = TrainingOrder(small_plan(seed=seed), run.models, (), ENVELOPE).files()
        manifest = {name: sha256(content) for name, content in files.items()}
        for name in service.missing(manifest):
            service.receive(files[name])
        service.begin(manifest)
        while len(started) < seed:
            wait(0.01)
    assert (started, stopped) == ([1, 2], [1])
    service.stop()
    assert stopped == [1, 2]


@pytest.mark.parametrize(
    ("error", "kind"),
    [(TrainingDiedError("died"), "lost worker"), (DataError("diverged"), "failed"), (OSError("full"), "lost worker")],
)
def test_end_of_the_training_process_is_told_apart(
    monkeypatch: pytest.MonkeyPatch, run: RunDirectory, tmp_path: Path, error: Exception, kind: str
) -> None:
    def fail(*arguments: Any) -> None:
        raise error

    monkeypatch.setattr("carlab.experiment.cluster.service.train_in_subprocess", fail)
    _, events = served(TrainingService(VERSION), TrainingOrder(small_plan(), run.models, (), ENVELOPE), tmp_path)
    assert events[-1].kind == kind
    assert str(error) in events[-1].message


def test_service_of_another_version_is_refused() -> None:
    with pytest.raises(ConfigError, match="install the same version"):
        TrainingService("99.0")


def test_service_without_the_device_is_refused() -> None:
    if torch.cuda.is_available():
        pytest.skip("this computer has a CUDA device")
    with pytest.raises(ConfigError, match=r"^On the machine .* of the cluster: .* torch finds no CUDA device here"):
        TrainingService(VERSION, "cuda")


def test_plan_is_unchanged_in_an_order() -> None:
    plan = replace(small_plan(), task_choice=choose_task("laps"), device="cuda", model_steps=None)
    order = TrainingOrder(plan, Path("models"), (), ENVELOPE)
    assert json.loads(order.files()["order.json"])["plan"]["device"] == "cuda"
