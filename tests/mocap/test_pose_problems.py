"""Problems of a pose source that prevent arming although poses arrive: a recorded take, late poses, no clock."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable
from typing import Any

import pytest

from carlab.core.quantities import PoseSample
from mocap.config import MocapConfig
from mocap.emulators.faults import ServerFaults
from mocap.emulators.natnet_server import NatNetServer
from mocap.emulators.scene import RigidBodySample
from mocap.natnet.models import BitstreamVersion, MessageId, ServerMode
from mocap.natnet_client import NatNetClient
from mocap.rigid_body import RigidBodyPoseSource
from tests.helpers.waiting import until

pytestmark = pytest.mark.realtime

Serve = Callable[..., NatNetServer]
Configure = Callable[..., MocapConfig]


class ServerWithoutEcho(NatNetServer):
    """A server whose answers to clock echoes are lost."""

    def _answer(self, message_id: int, payload: bytes, address: Any, now_s: float) -> tuple[int, bytes] | None:
        return None if message_id == MessageId.ECHOREQUEST else super()._answer(message_id, payload, address, now_s)


@pytest.mark.parametrize("server_mode", [1, 2, 3])
def test_recorded_take_is_a_problem(serve: Serve, configure: Configure, server_mode: int) -> None:
    server = serve()
    with RigidBodyPoseSource(configure(server)) as source:
        until(lambda: source.client.server_mode == 0)
        assert source.problems() == ()
        server.faults = ServerFaults(server_mode=server_mode)
        until(lambda: source.client.server_mode == server_mode)
        assert source.problems() == ("Motive is in Edit mode and streams a recorded take; switch it to Live mode.",)
        until(lambda: not newest(source).tracked)
        server.faults = ServerFaults()
        until(lambda: source.problems() == ())
        until(lambda: newest(source).tracked)


def newest(source: RigidBodyPoseSource) -> PoseSample:
    sample = source.latest()
    assert sample is not None
    return sample


def test_frames_that_have_become_unreadable_are_a_problem(serve: Serve, configure: Configure) -> None:
    server = serve()
    with RigidBodyPoseSource(configure(server)) as source:
        assert source.problems() == ()
        server.faults = ServerFaults(frame_version=BitstreamVersion(3, 0))
        until(lambda: bool(source.problems()))
        (text,) = source.problems()
        assert text.startswith("no frame can be read: ")
        assert "3.0" in text
        server.faults = ServerFaults()
        until(lambda: source.problems() == ())


def test_late_poses_are_a_problem(serve: Serve, configure: Configure) -> None:
    server = serve(faults=ServerFaults(latency_s=0.3))
    with RigidBodyPoseSource(configure(server)) as source:
        until(lambda: bool(source.problems()))
        (text,) = source.problems()
        assert "more than 100 ms after their exposure" in text
    with RigidBodyPoseSource(configure(serve(faults=ServerFaults(latency_s=0.02)))) as source:
        until(lambda: source.statistics()["frames"] >= 50)
        assert source.problems() == ()


def test_poses_that_have_become_late_are_a_problem_at_once(serve: Serve, configure: Configure) -> None:
    server = serve()
    with RigidBodyPoseSource(configure(server)) as source:
        until(lambda: source.statistics()["frames"] >= 600)
        assert source.problems() == ()
        frames = source.statistics()["frames"]
        server.faults = ServerFaults(latency_s=0.3)
        until(lambda: "after their exposure" in "".join(source.problems()))
        assert source.statistics()["frames"] - frames < 300


def test_frames_that_are_being_recorded_are_live() -> None:
    client = NatNetClient(MocapConfig())
    client.server_mode = ServerMode.RECORDING_OR_EDIT
    assert not client.is_live
    client._is_recording = True
    assert client.is_live


def test_missing_clock_echo_is_a_problem_of_a_server_with_a_clock_only(
    serve: Serve, configure: Configure, monkeypatch: pytest.MonkeyPatch
) -> None:
    with RigidBodyPoseSource(configure(serve(kind=ServerWithoutEcho), timeout_s=0.5)) as source:
        (text,) = source.problems()
        assert "clock echo" in text
    monkeypatch.setattr("mocap.emulators.natnet_server.CLOCK_HZ", 0)
    with RigidBodyPoseSource(configure(serve(kind=ServerWithoutEcho), timeout_s=0.5)) as source:
        assert source.problems() == ()


@pytest.mark.parametrize("outlier_m", [(1.0, -2.0, 2.0), (1.0, 8.0, 0.1)])
def test_outliers_neither_cause_nor_hide_the_message_about_the_vertical_axis(
    serve: Serve, configure: Configure, outlier_m: tuple[float, float, float]
) -> None:
    numbers = itertools.count()
    is_lifted = threading.Event()

    def poses(t_s: float) -> list[RigidBodySample]:
        position_m = (1.0, -2.0, 2.0) if is_lifted.is_set() else (1.0, -2.0, 0.1)
        return [RigidBodySample(t_s, outlier_m if next(numbers) in (50, 51, 70) else position_m)]

    with RigidBodyPoseSource(configure(serve(poses))) as source:
        until(lambda: source.statistics()["tracked"] >= 100.0)
        received = [(sample.x_m, sample.y_m, sample.z_m) for sample in source.since(-1)]
        assert pytest.approx(outlier_m) in received
        assert source.problems() == ()
        is_lifted.set()
        until(lambda: "has moved vertically by more than 0.3 m and hardly in y" in "".join(source.problems()))
