"""A restarted server gives other streaming ids to its rigid bodies."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from mocap.config import MocapConfig
from mocap.emulators.natnet_server import NatNetServer
from mocap.emulators.scene import EmulatedBody, RigidBodySample
from mocap.natnet.models import MessageId
from mocap.rigid_body import RigidBodyPoseSource
from tests.helpers.waiting import until

pytestmark = pytest.mark.realtime

Serve = Callable[..., NatNetServer]
Configure = Callable[..., MocapConfig]


class LateModels(NatNetServer):
    """A server that answers requests for its rigid bodies half a second after it has started."""

    def _answer(self, message_id: int, payload: bytes, address: Any, now_s: float) -> tuple[int, bytes] | None:
        is_early = now_s < self._start_s + 0.5
        if message_id == MessageId.REQUEST_MODELDEF and is_early:
            return None
        return super()._answer(message_id, payload, address, now_s)


@pytest.mark.parametrize("mode", ["unicast", "multicast"])
def test_pose_of_another_body_is_not_used_after_a_restart_of_the_server(
    serve: Serve, configure: Configure, monkeypatch: pytest.MonkeyPatch, mode: str
) -> None:
    """The server gives the streaming ids anew when it starts."""
    monkeypatch.setattr("mocap.natnet.message_schedule.RECONNECT_PERIOD_S", 0.3)
    places = {"car": 1.0, "lorry": 2.0}

    def bodies(first: str, second: str) -> dict[str, Any]:
        names = (first, second)
        return {
            "poses": lambda t_s: [RigidBodySample.planar(t_s, places[name], 0.0, 0.0) for name in names],
            "bodies": [EmulatedBody(name, number) for number, name in enumerate(names, 1)],
            "mode": mode,
        }

    server = serve(**bodies("car", "lorry"))
    ports = {"command_port": server.command_port, "data_port": server.data_port}
    with RigidBodyPoseSource(configure(server, body="car")) as source:
        source.wait_for(source.latest().sequence + 150, 5.0)  # type: ignore[union-attr]
        server.close()
        serve(**bodies("lorry", "car"), kind=LateModels, **ports)
        until(lambda: source.statistics()["restarts"] == 1.0)
        until(lambda: source._body is not None and source._body.id == 2 and source.latest().tracked)  # type: ignore[union-attr]
        assert {sample.x_m for sample in source.since(-1)} == {1.0}
