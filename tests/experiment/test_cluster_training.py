"""Trainer on a cluster: what is checked on arrival, and what a lost link causes."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from learning_runs import ENVELOPE, small_plan

from carlab.core.clock import SimulatedClock
from carlab.core.errors import ConfigError, DataError
from carlab.experiment.campaign.training import TrainingRequest, train
from carlab.experiment.campaign.training_plan import TrainingPlan
from carlab.experiment.cluster.link_protocol import LinkEvent, LinkRequest
from carlab.experiment.cluster.order import TrainingOrder
from carlab.experiment.cluster.settings import LinkSettings
from carlab.experiment.cluster.trainer import ClusterTrainer
from carlab.jobs.child_jobs import write_files
from carlab.recording.run_folder import RunDirectory
from tests.learning.test_files_run_no_code import Payload

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

    def __call__(self, request: TrainingRequest, *others: Any) -> dict[str, Any] | None:
        self.plans.append(request.plan)
        return {"trained": "here"}


def trainer_of(link: FakeLink) -> tuple[ClusterTrainer, list[str], Here]:
    said: list[str] = []
    here = Here()
    return ClusterTrainer("ray://box:10001", link, said.append, SETTINGS, here, link.clock), said, here


def start(trainer: ClusterTrainer, run: RunDirectory, **options: Any) -> dict[str, Any] | None:
    return trainer(TrainingRequest(small_plan(), run.models, run.recordings(), ENVELOPE), lambda *what: None, **options)


DONE = [(1.0, LEARNING), (3.0, LinkEvent("done"))]


def test_result_of_the_cluster_is_the_model_of_the_run(trained: RunDirectory, run: RunDirectory, sent: Path) -> None:
    link = FakeLink(DONE, result=sent)
    trainer, said, here = trainer_of(link)
    progress: list[tuple[str, int, int]] = []
    figures = trainer(
        TrainingRequest(small_plan(), run.models, run.recordings(), ENVELOPE),
        lambda *what: progress.append(what),
        lambda: False,
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
    assert link.sent_s == pytest.approx([0.0, 21.0], abs=0.5), "the connection is opened again meanwhile"
    assert link.calls[-1] == "cut"


def test_restored_link_is_used_within_the_wait(run: RunDirectory, sent: Path) -> None:
    link = FakeLink([(1.0, LEARNING)], [(2.0, LinkEvent("connected")), *DONE], result=sent)
    trainer, said, here = trainer_of(link)
    figures = start(trainer, run)
    assert figures is not None
    assert figures["episode"] == 2
    assert here.plans == []
    assert said[1:] == ["The cluster ray://box:10001 answers again; the training before episode 2 runs there."]


def test_connection_that_takes_longer_than_a_file_is_not_cut(run: RunDirectory, sent: Path) -> None:
    """After a worker is lost, a busy cluster needs 30 s for the next connection; a file has ``reconnect_s``."""
    lost = [(1.0, LEARNING), (1.0, LinkEvent("lost worker", "killed"))]
    slow = [(30.0, LinkEvent("connected")), (45.0, LEARNING), (46.0, LinkEvent("done"))]
    link = FakeLink(lost, slow, result=sent)
    trainer, _, here = trainer_of(link)
    assert start(trainer, run) is not None
    assert (len(link.sent_s), here.plans) == (2, [])


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
    trainer(
        TrainingRequest(small_plan(device="cuda"), run.models, run.recordings(), ENVELOPE),
        lambda *what: None,
        lambda: False,
    )
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


def other_history(folder: Path, created: Path) -> None:
    order = TrainingOrder(small_plan(history=3), folder.parent / "other", (), ENVELOPE)
    train(TrainingRequest(order.plan, order.models, [], ENVELOPE), lambda *what: None)
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


def without_rows(folder: Path, created: Path) -> None:
    figures = json.loads((folder / "training.json").read_text())
    (folder / "training.json").write_text(json.dumps(figures | {"rows": None}))


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
    "figures without a number": (without_rows, "rows is None, not a count"),
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


def test_missing_file_of_the_run_is_named(run: RunDirectory) -> None:
    (run.models / "0001" / "policy.npz").unlink()
    trainer, _, here = trainer_of(FakeLink())
    with pytest.raises(DataError, match=r"policy\.npz cannot be read \(No such file or directory\)"):
        start(trainer, run)
    assert here.plans == []
