"""``learn`` with the trainer in another process group whose link is cut and restored: neutral, and a complete run.

The service on the cluster is the same with and without Ray; without Ray it listens on a port of its own process.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import secrets
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from learning_runs import TICKS, tiny_plan
from tcp_link import TcpLink, free_port, wait_for_port

from carlab.cars import choose_car
from carlab.core.clock import MonotonicClock
from carlab.core.documents import Tick
from carlab.experiment.campaign.campaign import Campaign
from carlab.experiment.campaign.hooks import LearnHooks
from carlab.experiment.campaign.training import TrainingRequest
from carlab.experiment.campaign.training_process import train_in_subprocess
from carlab.experiment.cluster.link_process import LinkProcess
from carlab.experiment.cluster.settings import LinkSettings
from carlab.experiment.cluster.trainer import ClusterTrainer
from carlab.recording.run_folder import RunDirectory
from drivers.emulators.command_log import read_log

pytestmark = pytest.mark.realtime
SERVER = str(Path(__file__).parents[1] / "helpers" / "training_server.py")


@dataclass
class Cluster:
    """A cluster in a process group of its own, reached by a link that a test can cut.

    ``address`` is that of the near end of the link; ``program`` is the process of the link.
    """

    network: TcpLink
    address: str
    program: tuple[str, ...]
    settings: LinkSettings


@contextlib.contextmanager
def process_group(command: list[str]) -> Iterator[subprocess.Popen[bytes]]:
    process = subprocess.Popen(command, start_new_session=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    assert process.stdout is not None
    try:
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGTERM)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(10.0)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        process.stdout.close()


@contextlib.contextmanager
def cluster_without_ray(tmp_path: Path) -> Iterator[Cluster]:
    port = free_port()
    # A new process of the link imports for 4 s on an idle core, and several times as long beside other tests.
    settings = LinkSettings(wait_s=40.0, lost_wait_s=30.0, message_s=2.0, reconnect_s=10.0, pause_s=0.5)
    with process_group([sys.executable, SERVER, "serve", str(port)]):
        wait_for_port(port)
        with contextlib.closing(TcpLink(port)) as network:
            yield Cluster(network, str(network.port), (sys.executable, SERVER, "link"), settings)


@pytest.fixture(autouse=True)
def token(monkeypatch: pytest.MonkeyPatch) -> None:
    """A token of the clusters of these tests."""
    monkeypatch.setenv("RAY_AUTH_MODE", "token")
    monkeypatch.setenv("RAY_AUTH_TOKEN", secrets.token_hex(32))


@contextlib.contextmanager
def cluster_of_ray(tmp_path: Path) -> Iterator[Cluster]:
    pytest.importorskip("ray", reason="Ray is an extra: pip install -e '.[ray]'")
    ports = {name: free_port() for name in ("port", "ray-client-server-port", "dashboard-agent-listen-port")}
    command = [str(Path(sys.executable).with_name("ray")), "start", "--head", "--block", "--num-cpus=2"]
    command += ["--node-ip-address=127.0.0.1", "--include-dashboard=false", "--disable-usage-stats"]
    command += [f"--{name}={port}" for name, port in ports.items()]
    settings = LinkSettings(wait_s=40.0, lost_wait_s=25.0, message_s=2.0, reconnect_s=20.0, pause_s=0.5)
    with process_group(command) as head:
        assert head.stdout is not None
        assert any(b"Ray runtime started" in line for line in head.stdout)
        with contextlib.closing(TcpLink(ports["ray-client-server-port"])) as network:
            program = (sys.executable, "-m", "carlab.experiment.cluster.link")
            yield Cluster(network, f"ray://127.0.0.1:{network.port}", program, settings)


@dataclass
class LearningRun:
    """A run of four episodes on the emulated car, whose link is cut in the second and third training.

    Attributes:
        said: sentences about the link with the number of finished episodes.
        here: numbers of the episodes whose training ran on this computer.
        ticks_s: time of each tick, by episode.
        results: number of driven episodes.
        is_child_there: whether a process of the link was alive at each tick.
    """

    folder: RunDirectory
    said: list[tuple[int, str]] = field(default_factory=list)
    here: list[int] = field(default_factory=list)
    ticks_s: list[list[float]] = field(default_factory=list)
    results: int = 0


def learn_with_cuts(cluster: Cluster, tmp_path: Path) -> LearningRun:
    """Cut the link in the second training until it has been announced, and in the third until it has ended."""
    choice = choose_car("emulated", seed=0)
    run = LearningRun(RunDirectory.create(tmp_path, "cut"))
    choice.log_to(run.folder.path)
    clock = MonotonicClock()
    was_cut: set[int] = set()

    def say(sentence: str) -> None:
        run.said.append((run.results, sentence))
        if len(run.said) == 1:
            threading.Timer(3.0, cluster.network.restore).start()

    def on_training(activity: str, done: int, total: int) -> None:
        if run.results in (1, 2) and run.results not in was_cut and activity != "starting":
            was_cut.add(run.results)
            cluster.network.cut()

    def on_tick(tick: Tick) -> None:
        run.ticks_s[-1].append(clock.now_s())
        if run.results == 2:
            cluster.network.restore()

    def train_here(request: TrainingRequest, *others: Any) -> dict[str, Any] | None:
        run.here.append(request.number)
        return train_in_subprocess(request, *others)

    hooks = LearnHooks(
        on_tick=on_tick, on_episode=lambda number, ticks: run.ticks_s.append([]), on_training=on_training
    )
    link = LinkProcess(cluster.address, f"test {os.getpid()} {tmp_path.name}", "cpu", cluster.program)
    trainer = ClusterTrainer(cluster.address, link, say, cluster.settings, train_here)
    plan = tiny_plan(choice, model_steps=200)
    with trainer, choice.car:
        campaign = Campaign(choice, plan, 4, run.folder, hooks, max_ticks=TICKS, record_rerun=False, trainer=trainer)
        for _ in campaign.run_episodes():
            run.results += 1
    assert link.pid is None
    return run


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("cluster_of", [cluster_without_ray, cluster_of_ray])
def test_car_is_in_neutral_and_the_run_finishes_while_the_link_is_cut_and_restored(
    cluster_of: Callable[[Path], contextlib.AbstractContextManager[Cluster]], tmp_path: Path
) -> None:
    with cluster_of(tmp_path) as cluster:
        run = learn_with_cuts(cluster, tmp_path)
    assert run.results == 4
    assert [p.name for p in run.folder.recordings()] == [f"000{k}.mcap" for k in range(1, 5)]
    for number in range(1, 5):
        assert json.loads((run.folder.models / f"000{number}" / "training.json").read_text())["episode"] == number

    heads = [(results, sentence.split(cluster.address)[1].split(".")[0].strip()) for results, sentence in run.said]
    waits = [f"{s:.0f} s" for s in (cluster.settings.message_s, cluster.settings.wait_s)]
    assert heads == [
        (1, f"has not answered for {waits[0]}"),
        (1, "answers again; the training before episode 2 runs there"),
        (2, f"has not answered for {waits[0]}"),
        (2, f"has not answered for {waits[1]}; the training before episode 3 runs on this computer"),
        (3, "answers again; the training before episode 4 runs there"),
    ]
    assert run.here == [3], "the cluster trained before all other episodes"

    entries = read_log(run.folder.path / "firmware.jsonl")
    currents = [e for e in entries if e.name == "current"]
    for before, after in itertools.pairwise(run.ticks_s):
        waiting = [e for e in currents if before[-1] + 1.0 < e.t_s < after[0] - 1.0]
        assert len(waiting) > 20
        assert {e.value for e in waiting} == {0.0}, "the car is in neutral while it waits and trains"
        assert np.diff([e.t_s for e in waiting]).max() < 2.0, "the sender runs all the time; a busy host delays it"
    driving_s = (run.ticks_s[0][0], run.ticks_s[-1][-1])
    assert not [e for e in entries if e.name == "motor_timeout" and driving_s[0] < e.t_s < driving_s[1]]


@pytest.mark.timeout(300)
def test_training_of_a_killed_worker_starts_again(tmp_path: Path) -> None:
    """The process of the training service is killed during a training; Ray gets another one."""
    said: list[str] = []
    killed: list[int] = []
    choice = choose_car("sim", seed=0)
    run = RunDirectory.create(tmp_path, "kill")
    with cluster_of_ray(tmp_path) as cluster:
        link = LinkProcess(cluster.address, f"kill {os.getpid()}", "cpu", cluster.program)

        def on_training(activity: str, done: int, total: int) -> None:
            if not killed and activity == "learning the car":
                killed.extend(worker_processes(os.environ["RAY_AUTH_TOKEN"]))
                os.kill(killed[0], signal.SIGKILL)

        def train_here(*arguments: Any) -> None:
            pytest.fail("trained on this computer")

        trainer = ClusterTrainer(cluster.address, link, said.append, cluster.settings, train_here)
        with trainer, choice.car:
            campaign = Campaign(
                choice, tiny_plan(choice), 1, run, LearnHooks(on_training=on_training), max_ticks=TICKS,
                record_rerun=False, trainer=trainer,
            )  # fmt: skip
            assert len(list(campaign.run_episodes())) == 1
    assert len(killed) == 1
    assert [p.name for p in run.recordings()] == ["0001.mcap"]


def worker_processes(token: str) -> list[int]:
    """Processes of the training service of the cluster with a token."""
    found = []
    for folder in Path("/proc").iterdir():
        with contextlib.suppress(OSError):
            is_service = (folder / "cmdline").read_bytes().startswith(b"ray::TrainingService")
            if is_service and token.encode() in (folder / "environ").read_bytes():
                found.append(int(folder.name))
    return found


def test_stopped_link_process_is_a_slow_link_and_is_replaced(tmp_path: Path) -> None:
    """A process of the link that hangs is killed; the training is found again by the next one."""
    said: list[str] = []
    choice = choose_car("sim", seed=0)
    run = RunDirectory.create(tmp_path, "hang")
    with cluster_without_ray(tmp_path) as cluster:
        link = LinkProcess(cluster.address, "test", "cpu", cluster.program)
        pids: list[int] = []

        def on_training(activity: str, done: int, total: int) -> None:
            if not pids and activity != "starting" and link.pid is not None:
                pids.append(link.pid)
                os.kill(link.pid, signal.SIGSTOP)

        trainer = ClusterTrainer(
            cluster.address, link, said.append, cluster.settings, lambda *what: pytest.fail("here")
        )
        with trainer, choice.car:
            campaign = Campaign(
                choice, tiny_plan(choice), 1, run, LearnHooks(on_training=on_training), max_ticks=TICKS,
                record_rerun=False, trainer=trainer,
            )  # fmt: skip
            assert len(list(campaign.run_episodes())) == 1
            assert link.pid not in (None, pids[0])
    assert ["answers again" in sentence for sentence in said] == [False, True]
    with pytest.raises(ProcessLookupError):
        os.kill(pids[0], 0)
