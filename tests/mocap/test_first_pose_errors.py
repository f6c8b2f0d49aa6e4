"""Reasons for which a pose source gets no first pose although frames arrive."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from carlab.core.errors import NotReadyError
from mocap.config import MocapConfig
from mocap.emulators.natnet_server import NatNetServer
from mocap.emulators.scene import EmulatedBody, RigidBodySample
from mocap.natnet.models import RigidBodyDescription
from mocap.rigid_body import RigidBodyPoseSource, select_body

pytestmark = pytest.mark.realtime

Serve = Callable[..., NatNetServer]
Configure = Callable[..., MocapConfig]
BODY = EmulatedBody("car", 7)


@pytest.mark.parametrize(
    ("is_tracked", "reason"),
    [
        (False, "the cameras do not see the body 'car'; check its markers and the capture volume."),
        (True, "every pose of the body 'car' is invalid (NaN or no unit quaternion); restart streaming in Motive."),
    ],
)
def test_body_that_is_in_the_frames_but_has_no_pose(
    serve: Serve, configure: Configure, is_tracked: bool, reason: str
) -> None:
    """Motive can set the pose of a body that it does not see to zeros, which are no quaternion."""
    zeros = RigidBodySample(0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0))
    visible = [is_tracked]

    def poses(t_s: float) -> list[RigidBodySample | None]:
        return [zeros if visible[0] else None]

    server = serve(poses, bodies=(BODY,))
    server._scene._last[BODY.id] = zeros
    source = RigidBodyPoseSource(configure(server, body="car", timeout_s=2.0))
    with pytest.raises(NotReadyError) as caught:
        source.open()
    assert caught.value.reasons == (reason,)


def test_one_of_several_bodies_must_be_named() -> None:
    bodies = (RigidBodyDescription("car", 1), RigidBodyDescription("tripod", 2))
    with pytest.raises(NotReadyError, match=r"several rigid bodies; set body in .* 2."):
        select_body(bodies, MocapConfig())
