"""The rigid bodies of the server change while a source is open."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import pytest

from mocap.config import MocapConfig
from mocap.emulators.faults import ServerFaults
from mocap.emulators.natnet_server import MODELS_CHANGED_S, NatNetServer
from mocap.emulators.scene import EmulatedBody, RigidBodySample
from mocap.rigid_body import RigidBodyPoseSource
from tests.helpers.waiting import until

pytestmark = pytest.mark.realtime

Serve = Callable[..., NatNetServer]
Configure = Callable[..., MocapConfig]

PLACES_M = {"car": 1.0, "lorry": 2.0}


def test_changed_ids_are_noticed_if_every_frame_with_the_flag_is_lost(serve: Serve, configure: Configure) -> None:
    names = ["car", "lorry"]

    def bodies() -> list[EmulatedBody]:
        return [EmulatedBody(name, number) for number, name in enumerate(names, 1)]

    def poses(t_s: float) -> list[RigidBodySample]:
        return [RigidBodySample.planar(t_s, PLACES_M[name], 0.0, 0.0) for name in names]

    server = serve(poses, bodies=bodies())
    with RigidBodyPoseSource(configure(server, body="car")) as source:
        server.faults = ServerFaults(no_frames=True)
        names.reverse()
        server.set_bodies(bodies())
        start = server.frames
        until(lambda: server.frames > start + 1.2 * MODELS_CHANGED_S * server.rate_hz)
        server.faults = ServerFaults()
        until(lambda: source.client.models is not None and source.client.models[0][:2] == ("lorry", 1))
        newest = source.latest()
        assert newest is not None
        later = source.wait_for(newest.sequence + 5, 30.0)
        assert later is not None
        assert later.tracked
        assert later.x_m == PLACES_M["car"]


@pytest.mark.parametrize(
    ("bodies", "reason"),
    [
        ((EmulatedBody("car", 1), EmulatedBody("car", 2)), "several rigid bodies have the name 'car'; set body_id in"),
        ((EmulatedBody("lorry", 1), EmulatedBody("car", 1)), "'lorry' and 'car' have the same streaming id 1"),
        ((EmulatedBody("lorry", 1), EmulatedBody("truck", 2)), "define it again in Motive under the same name"),
    ],
)
def test_reason_why_the_body_has_become_unknown_is_named(
    serve: Serve, configure: Configure, bodies: Sequence[Any], reason: str
) -> None:
    before = (EmulatedBody("car", 1), EmulatedBody("lorry", 2))
    server = serve(lambda t_s: [RigidBodySample.planar(t_s, 1.0, 0.0, 0.0)] * 2, bodies=before)
    with RigidBodyPoseSource(configure(server, body="car")) as source:
        server.set_bodies(bodies)
        until(lambda: bool(source.problems()))
        (text,) = source.problems()
        assert reason in text
        assert "has no rigid body" not in text
