"""Training on a cluster: which files travel, what is checked on arrival, and what a lost link causes."""

from __future__ import annotations

import json
import shutil
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from learning_runs import ENVELOPE, TICKS, drive, tiny_plan

from carlab.cars import choose_car
from carlab.core.clock import SimulatedClock
from carlab.core.errors import ConfigError, DataError
from carlab.core.safety import SafetyEnvelope
from carlab.core.task import ParkingTask
from carlab.core.task_choice import choose_task
from carlab.core.version import VERSION
from carlab.experiment.campaign.training import train
from carlab.experiment.campaign.training_plan import TrainingPlan
from carlab.experiment.campaign.training_process import TrainingDiedError
from carlab.experiment.cluster.link import run_order
from carlab.experiment.cluster.link_protocol import LinkEvent, LinkRequest
from carlab.experiment.cluster.order import RESULT_FILES, TrainingOrder
from carlab.experiment.cluster.service import TrainingService, sha256
from carlab.experiment.cluster.settings import LinkSettings
from carlab.experiment.cluster.trainer import ClusterTrainer
from carlab.jobs.child_jobs import write_files
from carlab.recording.run_folder import RunDirectory

SETTINGS = LinkSettings(
    connect_s=40.0,
    wait_s=60.0,
    lost_wait_s=10.0,
    message_s=5.0,
    reconnect_s=20.0,
    pause_s=2.0,
    poll_s=0.05,
    max_lost_workers=3,
)
LEARNING = LinkEvent("answer", activity=("learning the car", 10, 60))


def small_plan(**changes: Any) -> TrainingPlan:
    return tiny_plan(choose_car("sim"), model_steps=20, updates=8, **changes)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> RunDirectory:
    """A run with one recording, and the models before its first and second episode."""
    run = drive(tmp_path_factory.mktemp("trained"), TICKS)
    for recordings in ([], run.recordings()):
        train(small_plan(), run.models, recordings, ENVELOPE, lambda *what: None)
    return run


@pytest.fixture(scope="module")
def sent(trained: RunDirectory, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The second model as it travels."""
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


class FakeLink:
    """A link with a script: the events that follow each request, with the seconds before each."""

    def __init__(self, *script: list[tuple[float, LinkEvent]], result: Path | None = None) -> None:
        self.clock = SimulatedClock()
        self.sent_s: list[float] = []
        self.calls: list[str] = []
        self._script = list(script)
        self._next: list[tuple[float, LinkEvent]] = []
        self._to = Path()
        self._result = result
        self._is_open = False

    def send(self, request: LinkRequest | None) -> None:
        self.calls.append("send")
        if not self._is_open or request is not None:
            now_s = self.clock.now_s()
            self.sent_s.append(now_s)
            self._next = [(now_s + after_s, event) for after_s, event in (self._script.pop(0) if self._script else [])]
        self._is_open = True
        if request is not None:
            self._to = Path(request.to)

    def poll(self, timeout_s: float) -> LinkEvent | None:
        end_s = self.clock.now_s() + timeout_s
        if not self._next or self._next[0][0] > end_s:
            self.clock.sleep_until(end_s)
            return None
        at_s, event = self._next.pop(0)
        self.clock.sleep_until(at_s)
        if event.kind == "done" and self._result is not None:
            shutil.copytree(self._result, self._to)
        return event

    def cut(self) -> None:
        self.calls.append("cut")
        self._next, self._is_open = [], False

    def close(self) -> None:
        self.calls.append("close")
        self._next, self._is_open = [], False


class Here:
    """A trainer on this computer that only remembers its plans."""

    def __init__(self) -> None:
        self.plans: list[TrainingPlan] = []

    def __call__(self, plan: TrainingPlan, *others: Any) -> dict[str, Any] | None:
        self.plans.append(plan)
        return {"trained": "here"}


def trainer_of(link: FakeLink) -> tuple[ClusterTrainer, list[str], Here]:
    said: list[str] = []
    here = Here()
    return ClusterTrainer("ray://box:10001", link, said.append, SETTINGS, here, link.clock), said, here


def start(trainer: ClusterTrainer, run: RunDirectory, **options: Any) -> dict[str, Any] | None:
    return trainer(small_plan(), run.models, run.recordings(), ENVELOPE, lambda *what: None, **options)


DONE = [(1.0, LEARNING), (3.0, LinkEvent("done"))]


def test_result_of_the_cluster_is_the_model_of_the_run(trained: RunDirectory, run: RunDirectory, sent: Path) -> None:
    link = FakeLink(DONE, result=sent)
    trainer, said, here = trainer_of(link)
    progress: list[tuple[str, int, int]] = []
    figures = trainer(
        small_plan(), run.models, run.recordings(), ENVELOPE, lambda *what: progress.append(what), lambda: False
    )
    assert figures == json.loads((trained.models / "0002" / "training.json").read_text())
    for name in ("dynamics.pt", "policy.npz", "prior.toml", "training.json"):
        found, expected = (models / "0002" / name for models in (run.models, trained.models))
        assert found.read_bytes() == expected.read_bytes()
    assert len(list((run.models / "0002").iterdir())) == 4
    assert progress == [("learning the car", 10, 60)]
    assert (said, here.plans) == ([], [])
    assert sorted(p.name for p in run.models.iterdir()) == ["0001", "0002"]


def test_lost_link_is_announced_and_then_the_training_runs_here(run: RunDirectory) -> None:
    link = FakeLink([(1.0, LEARNING)])
    trainer, said, here = trainer_of(link)
    assert start(trainer, run) == {"trained": "here"}
    assert said == [
        "The cluster ray://box:10001 has not answered for 5 s. The car stays in neutral; the run waits up to 60 s, "
        "then it trains on this computer.",
        "The cluster ray://box:10001 has not answered for 60 s; the training before episode 2 runs on this computer.",
    ]
    assert link.clock.now_s() == pytest.approx(61.0, abs=0.3)
    assert len(here.plans) == 1
    assert link.sent_s == pytest.approx([0.0, 21.0, 41.0], abs=0.5), "the connection is opened again meanwhile"
    assert link.calls[-1] == "cut"


def test_restored_link_is_used_within_the_wait(run: RunDirectory, sent: Path) -> None:
    link = FakeLink([(1.0, LEARNING)], [(2.0, LinkEvent("connected")), *DONE], result=sent)
    trainer, said, here = trainer_of(link)
    figures = start(trainer, run)
    assert figures is not None
    assert figures["episode"] == 2
    assert here.plans == []
    assert said[1:] == ["The cluster ray://box:10001 answers again; the training before episode 2 runs there."]


def test_next_training_tries_the_lost_cluster_again(run: RunDirectory, sent: Path) -> None:
    link = FakeLink(result=sent)
    trainer, said, here = trainer_of(link)
    start(trainer, run)
    first_s = link.clock.now_s()
    start(trainer, run)
    assert link.clock.now_s() - first_s == pytest.approx(SETTINGS.lost_wait_s, abs=0.3), "it waits a shorter time"
    assert [text.split(";")[0] for text in said[1:]] == [
        "The cluster ray://box:10001 has not answered for 60 s",
        "The cluster ray://box:10001 has not answered for 10 s",
    ]
    link._script = [DONE]
    figures = start(trainer, run)
    assert figures is not None
    assert figures["episode"] == 2
    assert said[-1] == "The cluster ray://box:10001 answers again; the training before episode 2 runs there."
    assert len(here.plans) == 2
    assert not trainer.is_lost


def test_link_that_connects_and_never_works_does_not_delay_the_run_forever(run: RunDirectory) -> None:
    flapping = [(1.0, LinkEvent("connected")), (0.5, LinkEvent("unreachable", "reset by peer"))]
    link = FakeLink(*[flapping] * 100)
    trainer, _, _ = trainer_of(link)
    assert start(trainer, run) == {"trained": "here"}
    assert link.clock.now_s() == pytest.approx(60.0, abs=0.3)
    assert 10 < len(link.sent_s) < 30


def test_cluster_that_loses_every_worker_is_given_up(run: RunDirectory) -> None:
    link = FakeLink(*[[(1.0, LEARNING), (1.0, LinkEvent("lost worker", "out of memory"))]] * 5)
    trainer, said, _ = trainer_of(link)
    assert start(trainer, run) == {"trained": "here"}
    assert len(link.sent_s) == 3
    assert said == ["The cluster ray://box:10001 lost 3 workers; the training before episode 2 runs on this computer."]


def test_failed_training_ends_the_run_as_here(run: RunDirectory) -> None:
    link = FakeLink([(1.0, LinkEvent("failed", "The model diverged twice."))])
    trainer, _, here = trainer_of(link)
    with pytest.raises(DataError, match=r"^The model diverged twice\.$"):
        start(trainer, run)
    assert here.plans == []


def test_stop_request_ends_the_training_on_the_cluster(run: RunDirectory) -> None:
    link = FakeLink([(1.0, LEARNING)])
    trainer, said, here = trainer_of(link)
    assert start(trainer, run, stop=lambda: link.clock.now_s() > 2.0) is None
    assert link.calls[-1] == "close"
    assert (said, here.plans) == ([], [])
    assert sorted(p.name for p in run.models.iterdir()) == ["0001"]


def test_training_here_uses_a_device_of_this_computer(run: RunDirectory) -> None:
    if torch.cuda.is_available():
        pytest.skip("this computer has a CUDA device")
    trainer, _, here = trainer_of(FakeLink())
    trainer(small_plan(device="cuda"), run.models, run.recordings(), ENVELOPE, lambda *what: None, lambda: False)
    assert [plan.device for plan in here.plans] == ["cpu"]


@pytest.mark.parametrize(
    ("events", "message"),
    [
        ([(1.0, LinkEvent("unreachable", "no Ray cluster answers"))], "no Ray cluster answers"),
        ([(1.0, LinkEvent("refused", "the cluster has no GPU"))], "the cluster has no GPU"),
        ([], "has not answered for 40 s; check that it has a free core"),
    ],
)
def test_cluster_that_cannot_be_used_is_refused_at_the_start(
    events: list[tuple[float, LinkEvent]], message: str
) -> None:
    link = FakeLink(events, events)
    with pytest.raises(ConfigError, match=message), trainer_of(link)[0]:
        pass
    assert link.calls[-1] == "close"


def test_first_connection_has_a_second_attempt() -> None:
    """The server of Ray's clients may fail while the cluster starts."""
    link = FakeLink([(1.0, LinkEvent("unreachable", "starting"))], [(1.0, LinkEvent("connected"))])
    with trainer_of(link)[0]:
        assert link.calls == ["send", "cut", "send"]


class Payload:
    """An object that creates a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __reduce__(self) -> tuple[Callable[..., object], tuple[Path]]:
        return Path.touch, (self._path,)


def other_history(folder: Path, created: Path) -> None:
    order = TrainingOrder(small_plan(history=3), folder.parent / "other", (), ENVELOPE)
    train(order.plan, order.models, [], ENVELOPE, lambda *what: None)
    files = order.result()
    write_files(folder, {name: files[name] for name in ("dynamics.npz", "policy.npz")})


def payload_in_the_model(folder: Path, created: Path) -> None:
    torch.save({"version": Payload(created)}, folder / "dynamics.npz")


def pickled_array_in_the_model(folder: Path, created: Path) -> None:
    with (folder / "dynamics.npz").open("wb") as file:
        np.savez(file, version=np.array([Payload(created)], dtype=object))


def payload_in_the_policy(folder: Path, created: Path) -> None:
    with (folder / "policy.npz").open("wb") as file:
        np.savez(file, version=np.array([Payload(created)], dtype=object))


def other_episode(folder: Path, created: Path) -> None:
    figures = json.loads((folder / "training.json").read_text())
    (folder / "training.json").write_text(json.dumps(figures | {"episode": 7}))


DAMAGES: dict[str, tuple[Callable[[Path, Path], object], str]] = {
    "missing": (lambda folder, created: (folder / "policy.npz").unlink(), "the files are"),
    "surplus": (lambda folder, created: (folder / "surplus.py").write_text("x"), "the files are"),
    "truncated": (lambda folder, created: (folder / "policy.npz").write_bytes(b"PK"), "The policy in"),
    "history": (other_history, "another number of past commands"),
    "episode": (other_episode, "of episode 7"),
    "figures": (lambda folder, created: (folder / "training.json").write_text("["), "training.json cannot be read"),
    "truncated model": (lambda folder, created: (folder / "dynamics.npz").write_bytes(b"PK"), "The learned car in"),
    "code in the model": (payload_in_the_model, "The learned car in"),
    "pickled array in the model": (pickled_array_in_the_model, "The learned car in"),
    "code in the policy": (payload_in_the_policy, "The policy in"),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_damaged_or_foreign_result_is_discarded_and_runs_no_code(
    sent: Path, run: RunDirectory, tmp_path: Path, name: str
) -> None:
    damage, message = DAMAGES[name]
    result, created = tmp_path / "result", tmp_path / "created"
    shutil.copytree(sent, result)
    damage(result, created)
    trainer, said, _ = trainer_of(FakeLink(DONE, result=result))
    assert start(trainer, run) == {"trained": "here"}
    assert len(said) == 1
    assert "The model from the cluster ray://box:10001 cannot be used" in said[0]
    assert message in said[0]
    assert said[0].endswith("; the training before episode 2 runs on this computer.")
    assert not created.exists()
    assert sorted(p.name for p in run.models.iterdir()) == ["0001"]


def test_order_is_read_as_it_was_sent(run: RunDirectory, tmp_path: Path) -> None:
    envelope = SafetyEnvelope(max_throttle=0.3, arena_m=((0.0, 0.0), (1.0, 0.5), (0.0, 2.0)))
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


def test_missing_file_of_the_run_is_named(run: RunDirectory) -> None:
    (run.models / "0001" / "policy.npz").unlink()
    trainer, _, here = trainer_of(FakeLink())
    with pytest.raises(DataError, match=r"policy\.npz cannot be read \(No such file or directory\)"):
        start(trainer, run)
    assert here.plans == []


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
    run_order(service, request, events.append, SETTINGS, wait)
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

    def train_until_stopped(plan: Any, models: Any, recordings: Any, envelope: Any, progress: Any, stop: Any) -> None:
        started.append(plan.seed)
        while not stop():
            wait(0.01)
        stopped.append(plan.seed)

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


def test_plan_is_unchanged_by_its_journey() -> None:
    plan = replace(small_plan(), task_choice=choose_task("laps"), device="cuda", model_steps=None)
    order = TrainingOrder(plan, Path("models"), (), ENVELOPE)
    assert json.loads(order.files()["order.json"])["plan"]["device"] == "cuda"
