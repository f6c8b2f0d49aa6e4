"""An independent client, ``natnet`` 0.3.0 from PyPI, receives the frames of the emulated server.

Limits of that client, which shape these tests:

* It cannot request a version when it connects. Its ``protocol_version`` setter decodes frames in flight in the new
  version at once and raises in its receiving thread for an old one; so each version is the server's native version.
* In 4.1 it reads the frame's parameters from the precision timestamp, which it does not know, so its ``is_recording``
  and ``tracked_models_changed`` are invalid; all fields before are decoded.
* It does not check lengths or the end-of-data tag, and measures no latency.
"""

from __future__ import annotations

import threading
from collections.abc import Callable

import numpy as np
import pytest
from natnet import DataDescriptions, DataFrame
from natnet import NatNetClient as OtherClient
from scipy.spatial.transform import Rotation

from mocap.emulators.natnet_server import CLOCK_HZ, NatNetServer
from mocap.emulators.scene import EmulatedBody, RigidBodySample
from mocap.natnet.models import SERVED_BITSTREAMS, BitstreamVersion

FRAMES = 240
BODIES = (EmulatedBody("car", 7), EmulatedBody("trailer", 9))


def receive(server: NatNetServer, mode: str, version: BitstreamVersion) -> tuple[list[DataFrame], DataDescriptions]:
    """Frames and descriptions that the independent client received."""
    frames: list[DataFrame] = []
    models: list[DataDescriptions] = []
    done, described = threading.Event(), threading.Event()

    def on_frame(frame: DataFrame) -> None:
        frames.append(frame)
        if len(frames) >= FRAMES:
            done.set()

    def on_models(descriptions: DataDescriptions) -> None:
        models.append(descriptions)
        described.set()

    client = OtherClient(
        command_port=server.command_port, data_port=server.data_port, use_multicast=mode == "multicast"
    )
    client.on_data_frame_received_event.handlers.append(on_frame)
    client.on_data_description_received_event.handlers.append(on_models)
    with client:
        client.run_async()
        client.request_modeldef()
        assert described.wait(30.0)
        assert done.wait(30.0)
        client.stop_async()
        assert client.protocol_version.components[:2] == tuple(version)
        assert client.server_info.application_name == "carlab emulator"
    return frames, models[0]


def check_frame(frame: DataFrame, truth: list[RigidBodySample | None], server: NatNetServer) -> None:
    """The frame holds the poses that the server sent under its number."""
    number = frame.prefix.frame_number
    car, trailer = frame.rigid_bodies
    first = truth[0]
    assert first is not None
    assert (car.id_num, trailer.id_num) == (7, 9)
    assert car.tracking_valid
    assert trailer.tracking_valid == (number % 5 != 0)
    # Y up on the wire: (x, y, z) of the map is (x, z, -y).
    assert car.pos == pytest.approx((0.001 * number, 0.125, 1.5), abs=1e-6)
    heading = Rotation.from_quat(car.rot).apply([1.0, 0.0, 0.0])
    expected_heading = Rotation.from_euler("y", 0.01 * (number % 300)).apply([1.0, 0.0, 0.0])
    assert heading == pytest.approx(expected_heading, abs=1e-5)
    suffix = frame.suffix
    assert suffix.stamp_camera_mid_exposure == server.ticks(first.t_capture_s)
    assert suffix.stamp_camera_mid_exposure <= suffix.stamp_data_received <= suffix.stamp_transmit
    assert suffix.timestamp == pytest.approx(number / 240.0, abs=1e-9)
    assert len(frame.labeled_markers) == 8


@pytest.mark.realtime
@pytest.mark.parametrize("mode", ["unicast", "multicast"])
@pytest.mark.parametrize("version", SERVED_BITSTREAMS, ids=str)
def test_independent_client_receives_the_frames(
    serve: Callable[..., NatNetServer], mode: str, version: BitstreamVersion
) -> None:
    sent: dict[int, list[RigidBodySample | None]] = {}

    def poses(t_s: float) -> list[RigidBodySample | None]:
        number = server.frames
        car = RigidBodySample.planar(t_s - 0.004, 0.001 * number, -1.5, 0.01 * (number % 300), 0.125)
        trailer = None if number % 5 == 0 else RigidBodySample.planar(t_s - 0.004, 2.0, 0.5, -0.5)
        sent[number] = [car, trailer]
        return sent[number]

    opened = threading.Event()
    server: NatNetServer

    def first(t_s: float) -> list[RigidBodySample | None]:
        opened.wait()
        return poses(t_s)

    server = serve(first, bodies=BODIES, rate_hz=240.0, mode=mode, version=version)
    opened.set()
    frames, models = receive(server, mode, version)

    assert [(b.name, b.id_num) for b in models.rigid_bodies] == [("car", 7), ("trailer", 9)]
    assert [s.name for s in models.marker_sets] == ["car", "trailer", "all"]

    numbers = [frame.prefix.frame_number for frame in frames]
    assert numbers == sorted(set(numbers))
    between = [n for n in list(sent) if numbers[0] <= n <= numbers[-1]]
    assert len(numbers) > 0.95 * len(between)
    # The median interval: a pause of the machine is one long interval.
    intervals_s = np.diff([frame.suffix.stamp_camera_mid_exposure for frame in frames]) / CLOCK_HZ
    assert 100.0 < 1.0 / np.median(intervals_s) < 260.0, "the server skips frames on a busy machine"

    for frame in frames:
        check_frame(frame, sent[frame.prefix.frame_number], server)
