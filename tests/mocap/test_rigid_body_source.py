"""One rigid body as a pose source: axes and offsets against scipy, times, sequences, error messages."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from carlab.core.errors import NotReadyError
from carlab.core.pose_source import PoseSource
from carlab.core.quantities import PoseSample
from mocap import axes
from mocap.config import MocapConfig
from mocap.emulators.faults import ServerFaults
from mocap.emulators.natnet_server import NatNetServer
from mocap.emulators.scene import EmulatedBody, RigidBodySample
from mocap.natnet.models import BitstreamVersion, MarkerSetDescription, RigidBodyDescription
from mocap.natnet.sockets import udp_socket
from mocap.rigid_body import RigidBodyPoseSource, select_body
from tests.helpers.waiting import until

pytestmark = pytest.mark.realtime

Serve = Callable[..., NatNetServer]
Configure = Callable[..., MocapConfig]

# Y up to Z up: a rotation by 90 degrees about x.
UP = Rotation.from_euler("x", 90, degrees=True)
numbers = st.floats(-3.0, 3.0)
vectors = st.tuples(numbers, numbers, numbers)
rotations = st.tuples(numbers, numbers, numbers).map(Rotation.from_rotvec)


# -- axes, against scipy --------------------------------------------------------------------------------------------


@given(vectors, rotations)
@settings(max_examples=100, deadline=None)
def test_axes_agree_with_scipy(vector: Any, rotation: Rotation) -> None:
    q = tuple(map(float, rotation.as_quat()))
    assert axes.rotate(q, vector) == pytest.approx(rotation.apply(vector), abs=1e-9)  # type: ignore[arg-type]
    assert axes.z_up_vector(vector) == pytest.approx(UP.apply(vector), abs=1e-9)
    assert axes.y_up_vector(axes.z_up_vector(vector)) == vector
    rotated = Rotation.from_quat(axes.z_up_quaternion(q))  # type: ignore[arg-type]
    assert (rotated * (UP * rotation * UP.inv()).inv()).magnitude() < 1e-7
    assert axes.y_up_quaternion(axes.z_up_quaternion(q)) == q  # type: ignore[arg-type]
    tilt_rad = math.acos(np.clip(rotation.apply([0.0, 0.0, 1.0])[2], -1.0, 1.0))
    assert axes.tilt_rad(q) == pytest.approx(tilt_rad, abs=1e-6)  # type: ignore[arg-type]


@given(vectors, rotations, st.floats(-math.pi, math.pi), vectors)
@settings(max_examples=100, deadline=None)
def test_base_link_agrees_with_scipy(position: Any, rotation: Rotation, yaw_offset_rad: float, pivot: Any) -> None:
    q = tuple(map(float, rotation.as_quat()))
    origin, yaw_rad = axes.base_link_pose(position, q, yaw_offset_rad, pivot)  # type: ignore[arg-type]
    base = rotation * Rotation.from_euler("z", yaw_offset_rad)
    # The pivot, transformed from the found base_link, is at the body's position.
    assert np.asarray(origin) + base.apply(pivot) == pytest.approx(position, abs=1e-9)
    forward = base.apply([1.0, 0.0, 0.0])
    assert math.hypot(*forward[:2]) * math.cos(yaw_rad) == pytest.approx(forward[0], abs=1e-9)
    assert math.hypot(*forward[:2]) * math.sin(yaw_rad) == pytest.approx(forward[1], abs=1e-9)


# -- over the wire --------------------------------------------------------------------------------------------------


def standing(x_m: float = 1.0, y_m: float = -2.0, yaw_rad: float = 0.5) -> Callable[[float], list[RigidBodySample]]:
    return lambda t_s: [RigidBodySample.planar(t_s, x_m, y_m, yaw_rad, 0.25)]


def pose(sample: PoseSample | None) -> tuple[float, ...]:
    assert sample is not None
    return sample.x_m, sample.y_m, sample.z_m, sample.yaw_rad


@pytest.mark.parametrize("up_axis", ["y", "z"])
def test_pose_of_base_link_includes_yaw_offset_and_pivot(serve: Serve, configure: Configure, up_axis: str) -> None:
    base, yaw_rad = np.array([1.5, -0.75, 0.0]), 2.5
    pivot, yaw_offset_rad = (0.1, 0.02, 0.06), -1.2
    heading = Rotation.from_euler("z", yaw_rad)
    body = heading * Rotation.from_euler("z", -yaw_offset_rad)
    position_m = base + heading.apply(pivot)
    sample = RigidBodySample(0.0, tuple(position_m), tuple(body.as_quat()))
    server = serve(lambda t_s: [RigidBodySample(t_s, sample.position_m, sample.quaternion)], up_axis=up_axis)
    config = configure(server, up_axis=up_axis, yaw_offset_rad=yaw_offset_rad, pivot_in_base_link_m=pivot)
    with RigidBodyPoseSource(config) as source:
        assert isinstance(source, PoseSource)
        assert pose(source.latest()) == pytest.approx((*base, yaw_rad), abs=1e-6)
        assert source.problems() == ()


def test_wrong_up_axis_is_reported(serve: Serve, configure: Configure) -> None:
    def tilted(t_s: float) -> list[RigidBodySample]:
        return [RigidBodySample(t_s, (0.0, 0.0, 0.5), tuple(Rotation.from_euler("x", 60, degrees=True).as_quat()))]

    with RigidBodyPoseSource(configure(serve(tilted))) as source:
        until(lambda: source.statistics()["tracked"] >= 5.0)
        until(lambda: len(source.problems()) == 1)
        (text,) = source.problems()
        assert "tilted" in text
        assert 'up_axis = "z"' in text

    def driving(t_s: float) -> list[RigidBodySample]:
        return [RigidBodySample.planar(t_s, 0.0, 5.0 * math.sin(5.0 * t_s), 0.0)]

    server = serve(driving, up_axis="y")
    with RigidBodyPoseSource(configure(server, up_axis="z")) as source:
        until(lambda: bool(source.problems()))
        assert 'up_axis = "y"' in source.problems()[0]


@pytest.mark.parametrize(
    ("markers_m", "position_m"),
    [(((120.0, 0.0, 30.0), (-100.0, 50.0, 20.0)), (0.0, 0.0, 30.0)), ((), (1200.0, -800.0, 30.0))],
)
def test_millimetres_are_reported(
    serve: Serve, configure: Configure, markers_m: Any, position_m: tuple[float, float, float]
) -> None:
    server = serve(lambda t_s: [RigidBodySample(t_s, position_m)], bodies=(EmulatedBody("car", 1, markers_m),))
    with RigidBodyPoseSource(configure(server)) as source:
        until(lambda: len(source.problems()) == 1)
        (text,) = source.problems()
        assert "the server does not seem to stream metres; set its unit of length to metres." in text


def test_carried_car_is_no_problem_once_it_stands_level(serve: Serve, configure: Configure) -> None:
    tilts_deg, height_m, y_m = [60.0], [0.0], [0.0]

    def carried(t_s: float) -> list[RigidBodySample]:
        quaternion = tuple(Rotation.from_euler("x", tilts_deg[0], degrees=True).as_quat())
        return [RigidBodySample(t_s, (0.0, y_m[0], height_m[0]), quaternion)]

    with RigidBodyPoseSource(configure(serve(carried))) as source:
        until(lambda: any("tilted" in text for text in source.problems()))
        tilts_deg[0] = 0.0
        until(lambda: source.problems() == ())
        height_m[0] = 0.5
        until(lambda: any("vertically" in text for text in source.problems()))
        y_m[0] = 0.3
        until(lambda: source.problems() == ())


@pytest.mark.parametrize("version", ["3.0", "4.1"])
def test_capture_times_equal_the_true_times(serve: Serve, configure: Configure, version: str) -> None:
    """The x of a pose encodes its true time of exposure on the host's monotonic clock."""
    server = serve(version=version, faults=ServerFaults(clock_offset_s=-321.0, clock_drift_ppm=30.0, latency_s=0.02))
    before_s = time.monotonic()
    with RigidBodyPoseSource(configure(server)) as source:
        until(lambda: source.statistics()["tracked"] >= 100.0)
        samples = source.since(-1)
        half_trip_s = 0.5e-3 * source.statistics()["round_trip_min_ms"]
    errors_s = sorted(abs((s.t_capture_s - s.x_m + 8.0) % 16.0 - 8.0) for s in samples)
    assert errors_s[len(errors_s) // 2] < max(1e-3, half_trip_s)
    assert before_s - 1.0 < samples[0].t_capture_s < samples[0].t_receive_s <= time.monotonic()
    assert all(s.t_receive_s - s.t_capture_s > 0.02 for s in samples)


def test_latest_since_and_wait_for_return_new_samples(serve: Serve, configure: Configure) -> None:
    source = RigidBodyPoseSource(configure(serve()), max_samples=16)
    assert source.latest() is None
    assert source.since(-1) == ()
    assert source.wait_for(0, 0.0) is None
    with source:
        newest = source.latest()
        assert newest is not None
        later = source.wait_for(newest.sequence, 30.0)
        assert later is not None
        assert later.sequence > newest.sequence
        until(lambda: source.statistics()["tracked"] >= 50.0)
        kept = source.since(-1)
        assert len(kept) == 16
        sequences = [s.sequence for s in kept]
        assert sequences == sorted(set(sequences))
        assert [s.sequence for s in source.since(sequences[-4])][:3] == sequences[-3:]
        assert source.wait_for(10**9, 0.01) is None
    assert source.latest() is not None  # received samples stay readable


def test_several_threads_can_wait_for_a_pose(serve: Serve, configure: Configure) -> None:
    with RigidBodyPoseSource(configure(serve())) as source:
        samples: list[PoseSample | None] = []
        threads = [threading.Thread(target=lambda: samples.append(source.wait_for(20, 30.0))) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert len(samples) == 4
    assert all(sample is not None and sample.sequence > 20 for sample in samples)


def test_last_pose_is_kept_while_tracking_is_lost(serve: Serve, configure: Configure) -> None:
    server = serve(standing())
    with RigidBodyPoseSource(configure(server)) as source:
        assert source.latest() is not None
        server.faults = ServerFaults(occlusion=1.0)
        until(lambda: not source.latest().tracked)  # type: ignore[union-attr]
        assert pose(source.latest()) == pytest.approx((1.0, -2.0, 0.25, 0.5), abs=1e-6)
        count = source.statistics()["untracked"]
        until(lambda: source.statistics()["untracked"] > count)
        server.faults = ServerFaults()
        until(lambda: source.latest().tracked)  # type: ignore[union-attr]


def test_invalid_pose_is_not_tracked(serve: Serve, configure: Configure) -> None:
    quaternion = [(0.0, 0.0, 0.0, 1.0)]
    place = [(1.0, 2.0, 0.0)]
    server = serve(lambda t_s: [RigidBodySample(t_s, place[0], quaternion[0])])
    with RigidBodyPoseSource(configure(server)) as source:
        quaternion[0] = (0.0, 0.0, 0.0, 0.5)
        until(lambda: source.statistics()["unusable"] > 3.0)
        quaternion[0], place[0] = (0.0, 0.0, 0.0, 1.0), (float("nan"), 0.0, 0.0)
        count = source.statistics()["unusable"]
        until(lambda: source.statistics()["unusable"] > count + 3.0)
        assert pose(source.latest()) == pytest.approx((1.0, 2.0, 0.0, 0.0), abs=1e-6)
        assert not source.latest().tracked  # type: ignore[union-attr]
        until(lambda: bool(source.problems()))
        assert "invalid pose" in source.problems()[0]
        place[0] = (1.0, 2.0, 0.0)
        until(lambda: source.problems() == ())
        assert source.statistics()["unusable"] > count, "past invalid frames stay counted"


def test_body_that_disappears_is_reported_and_found_again(serve: Serve, configure: Configure) -> None:
    server = serve(standing())
    with RigidBodyPoseSource(configure(server, body="car")) as source:
        server.set_bodies((EmulatedBody("lorry", 5),))
        until(lambda: source.statistics()["missing"] > 0.0 and bool(source.problems()))
        assert "no longer has the body" in source.problems()[0]
        assert not source.latest().tracked  # type: ignore[union-attr]
        server.set_bodies((EmulatedBody("car", 8),))
        until(lambda: source.latest().tracked)  # type: ignore[union-attr]
        assert source.problems() == ()


def test_body_that_is_added_later_does_not_replace_the_only_one(serve: Serve, configure: Configure) -> None:
    servers: list[NatNetServer] = []

    def poses(t_s: float) -> Sequence[RigidBodySample]:
        n_bodies = len(servers[0]._scene.bodies) if servers else 1
        return [RigidBodySample.planar(t_s, 1.0, 2.0, 0.1)] * n_bodies

    server = serve(poses)
    servers.append(server)
    with RigidBodyPoseSource(configure(server)) as source:
        server.set_bodies((EmulatedBody("tripod", 7), EmulatedBody()))
        until(lambda: len(source.client.models or ()) == 5)
        sequence = source.latest().sequence  # type: ignore[union-attr]
        sample = source.wait_for(sequence + 20, 5.0)
        assert sample is not None
        assert sample.tracked
        assert source.problems() == ()


def test_body_is_selected_by_name_or_id(serve: Serve, configure: Configure) -> None:
    bodies = (EmulatedBody("car", 3), EmulatedBody("trailer", 4))

    def poses(t_s: float) -> Sequence[RigidBodySample]:
        return [RigidBodySample.planar(t_s, 1.0, 0.0, 0.0), RigidBodySample.planar(t_s, 2.0, 0.0, 0.0)]

    server = serve(poses, bodies=bodies)
    for choice, x_m in (({"body": "car"}, 1.0), ({"body": "trailer"}, 2.0), ({"body_id": 4}, 2.0)):
        with RigidBodyPoseSource(configure(server, **choice)) as source:
            assert pose(source.latest())[0] == x_m
    for choice, named in (({"body": "truck"}, "'truck'"), ({"body_id": 77}, "77"), ({}, "several rigid bodies")):
        source = RigidBodyPoseSource(configure(server, **choice))
        with pytest.raises(NotReadyError) as caught:
            source.open()
        text = str(caught.value)
        for word in (named, "'car' (id 3)", "'trailer' (id 4)", "[hardware.mocap]"):
            assert word in text


def test_missing_body_and_duplicate_names_are_reported() -> None:
    with pytest.raises(NotReadyError, match="streams no rigid body; create one in Motive"):
        select_body((MarkerSetDescription("all", ()),), MocapConfig())
    twins = (RigidBodyDescription("car", 1), RigidBodyDescription("car", 2))
    with pytest.raises(NotReadyError, match="set body_id"):
        select_body(twins, MocapConfig(body="car"))
    assert select_body(twins, MocapConfig(body_id=2)) is twins[1]


def test_two_bodies_with_one_streaming_id_are_refused() -> None:
    """Frames have no names: the first body with the id would be taken for the car."""
    bodies = (RigidBodyDescription("lorry", 1), RigidBodyDescription("car", 1), RigidBodyDescription("tripod", 2))
    for config in (MocapConfig(body="car"), MocapConfig(body_id=1)):
        with pytest.raises(NotReadyError, match="'lorry' and 'car' have the same streaming id 1"):
            select_body(bodies, config)
    assert select_body(bodies, MocapConfig(body="tripod")) is bodies[2]


def test_source_can_be_closed_and_opened_again(serve: Serve, configure: Configure) -> None:
    source = RigidBodyPoseSource(configure(serve(standing())))
    source.close()
    for _ in range(3):
        source.open()
        source.open()
        first = source.latest()
        assert first is not None
        assert first.tracked
        source.close()
        source.close()


def reason_for_missing_pose(config: MocapConfig) -> str:
    source = RigidBodyPoseSource(config)
    with pytest.raises(NotReadyError) as caught:
        source.open()
    source.close()  # safe after a failed open
    assert len(caught.value.reasons) == 1
    return caught.value.reasons[0]


def test_missing_pose_is_reported_with_the_reason(serve: Serve, configure: Configure) -> None:
    server = serve(faults=ServerFaults(no_frames=True))
    assert "no frame came within 0.3 s" in reason_for_missing_pose(configure(server, timeout_s=0.3))
    server.faults = ServerFaults(frame_version=BitstreamVersion(3, 0))
    text = reason_for_missing_pose(configure(server, timeout_s=0.5))
    for word in ("3.0, 3.1 or 4.0", "not 4.1", "2.6 to 4.1", "Motive's Data Streaming pane", 'bitstream = "3.0"'):
        assert word in text
    server.faults = ServerFaults()
    with RigidBodyPoseSource(configure(server)) as source:
        assert source.latest() is not None


def test_frames_from_another_address_are_named(serve: Serve, configure: Configure) -> None:
    """A computer with two addresses: it answers from one and sends frames from the other."""
    server = serve(rate_hz=100.0)
    assert server._data is not None
    port = server._data.getsockname()[1]
    server._data.close()
    server._data = udp_socket("127.0.0.3", port)
    text = reason_for_missing_pose(configure(server, timeout_s=0.5))
    assert "127.0.0.3" in text
    assert "server_address" in text


def test_failed_receiver_is_reported_as_a_problem(
    serve: Serve, configure: Configure, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing_sample(*arguments: object) -> None:
        raise RuntimeError("out of order")

    with RigidBodyPoseSource(configure(serve())) as source:
        monkeypatch.setattr(source, "_sample", failing_sample)
        until(lambda: bool(source.problems()))
        assert "out of order" in source.problems()[0]
        assert "open it again" in source.problems()[0]
