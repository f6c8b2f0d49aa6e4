"""A live view shows what a run emits, and never delays it."""

from __future__ import annotations

import functools
import os
import queue
import socket
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from learning_runs import TICKS, drive, hang

import carlab
from carlab.core.documents import EpisodeStarted, Tick
from carlab.core.errors import ConfigError, NotReadyError
from carlab.experiment.campaign import live_view
from carlab.experiment.campaign.figures import predict_ahead
from carlab.experiment.campaign.live_view import LiveSettings, LiveView, show
from carlab.recording.mcap.source import read_documents, read_episode
from carlab.recording.rerun.viewer import check_viewer
from learning.rollouts import StatelessModel
from tests.helpers.rerun_files import cells, tabs
from tests.helpers.waiting import until


def save_to(stream: Any, path: Path) -> None:
    stream.save(path)


def test_view_shows_all_episodes_that_were_emitted(tmp_path: Path) -> None:
    run = drive(tmp_path, TICKS, episodes=2)
    messages: queue.Queue[Any] = queue.Queue()
    messages.put("learning the car")
    messages.put("learning the car")
    documents = [read_documents(path) for path in run.recordings()]
    messages.put(documents[0][5])  # Its start was lost: it is omitted.
    for document in (*documents[0], *documents[1], None):
        messages.put(document)
    file = tmp_path / "live.rrd"
    show(LiveSettings(run.path, 2, False, functools.partial(save_to, path=file)), messages)  # type: ignore[arg-type]
    rows = [(n, c[0]) for n, c in cells(file, "Scalars:scalars", "episode")["car/state/vx_mps"] if c[0] == c[0]]
    for number, path in enumerate(run.recordings(), start=1):
        np.testing.assert_array_equal([v for n, v in rows if n == number], read_episode(path).states[:, 3])
    assert [cell for _, cell in cells(file, "TextLog:text", "car_time")["log"]] == [["learning the car"]]
    assert set(tabs(file)) == {"Drive by episode", "Latency and health"}


def test_hanging_viewer_loses_documents_and_does_not_block(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live_view, "CLOSE_TIMEOUT_S", 0.1)
    with LiveView(LiveSettings(tmp_path, 1, False, hang), capacity=5) as view:
        for step in range(50):
            view.report_activity("driving", step, 50)
            view.emit(step)  # type: ignore[arg-type]
        assert view.dropped >= 45


def test_view_has_a_low_priority_and_its_own_session(tmp_path: Path) -> None:
    """A session that mixes priorities can keep the sender from the processors."""
    before = os.getpriority(os.PRIO_PROCESS, 0)
    with LiveView(LiveSettings(tmp_path, 1, False, hang)) as view:
        pid = view._process.pid
        until(lambda: os.getpriority(os.PRIO_PROCESS, pid) == min(before + live_view.NICENESS, 19))
        assert os.getsid(pid) == pid
    assert os.getpriority(os.PRIO_PROCESS, 0) == before


def test_invalid_viewers_are_refused_before_the_car_moves(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigError, match="give the address of a viewer"):
        carlab.drive(viewer="localhost:9876", out=tmp_path)
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    with pytest.raises(NotReadyError, match="has no screen; name a viewer on another one with --viewer"):
        carlab.learn(live=True, out=tmp_path)
    assert not list(tmp_path.iterdir())


def test_documents_of_a_drive_reach_a_listener(tmp_path: Path) -> None:
    documents: list[Any] = []
    run = carlab.drive(
        ticks=5, out=tmp_path, rerun=False, picture=False, hooks=carlab.RunHooks(on_document=documents.append)
    )
    assert isinstance(documents[0], EpisodeStarted)
    recorded = [d.step for d in read_documents(run.recordings[0]) if isinstance(d, Tick)]
    assert [d.step for d in documents if isinstance(d, Tick)] == recorded == list(range(5))


class Drifting(StatelessModel):
    """A car that moves by its action along x, and to the left by Gaussian noise of 0.01 m a step."""

    history = 0

    def step(self, features: torch.Tensor, action: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        after = features.clone()
        after[:, 0] += action[:, 0]
        after[:, 1] += 0.01 * torch.randn(len(features), generator=generator)
        return after


def test_predicted_path_follows_the_policy_with_the_spread_of_the_model() -> None:
    start = np.array([[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], [2.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0]])
    mean, across_std = predict_ahead(
        Drifting(), lambda inputs: np.full((len(inputs), 2), 3.0, np.float32), start, 0.1, n_samples=4000
    )
    steps = np.arange(11)
    np.testing.assert_allclose(mean[:, :, 0], [steps, 2.0 + steps], atol=1e-5, err_msg="commands are clipped to 1")
    np.testing.assert_allclose(across_std, [0.01 * np.sqrt(steps)] * 2, rtol=0.06, atol=1e-6)


@pytest.mark.parametrize(
    "address", ["localhost:9876", "http://h:1/proxy", "rerun+http://h:99999/proxy", "rerun+http:///proxy"]
)
def test_text_that_is_no_address_of_a_viewer_is_refused(address: str) -> None:
    with pytest.raises(ConfigError, match="give the address of a viewer"):
        check_viewer(address)


def test_address_where_no_viewer_listens_is_refused_before_the_drive(tmp_path: Path) -> None:
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{unused.getsockname()[1]}"
        with pytest.raises(NotReadyError, match=f"no viewer listens at {address}"):
            carlab.drive(viewer=f"rerun+http://{address}/proxy", out=tmp_path)
        unused.listen()
        check_viewer(f"rerun+http://{address}/proxy")
    assert list(tmp_path.iterdir()) == []
