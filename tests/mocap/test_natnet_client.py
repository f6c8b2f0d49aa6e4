"""The client against the emulated server: handshake, versions, reconnection, faults."""

from __future__ import annotations

import socket
from collections.abc import Callable, Mapping
from typing import Any

import pytest

from mocap.config import MocapConfig
from mocap.emulators.faults import ServerFaults
from mocap.emulators.natnet_server import NatNetServer
from mocap.emulators.scene import EmulatedBody
from mocap.natnet.bitstream_switch import BitstreamSwitch
from mocap.natnet.descriptions import decode_model_def
from mocap.natnet.frames import decode_frame, encode_frame
from mocap.natnet.messages import encode_connect, encode_message, encode_request, split_message
from mocap.natnet.models import (
    FRAME_BITSTREAM_CHANGED,
    SERVED_BITSTREAMS,
    BitstreamVersion,
    Frame,
    MessageId,
    RigidBody,
    RigidBodyDescription,
)
from mocap.natnet_client import NatNetClient
from tests.helpers.waiting import until

pytestmark = pytest.mark.realtime

Serve = Callable[..., NatNetServer]
Configure = Callable[..., MocapConfig]
V30, V40, V41, V42 = (BitstreamVersion(*v) for v in ((3, 0), (4, 0), (4, 1), (4, 2)))


class Received:
    """A listener that records all frames."""

    def __init__(self) -> None:
        self.frames: list[tuple[Frame, int, float, float]] = []

    def __call__(self, frame: Frame, sequence: int, capture_s: float, received_s: float) -> None:
        self.frames.append((frame, sequence, capture_s, received_s))

    @property
    def sequences(self) -> list[int]:
        return [sequence for _, sequence, _, _ in self.frames]

    def errors_s(self, start: int = 0) -> list[float]:
        """Capture time minus the true time, which x holds modulo 16 s."""
        differences = [capture_s - frame.rigid_bodies[0].x_m for frame, _, capture_s, _ in self.frames[start:]]
        return [(d + 8.0) % 16.0 - 8.0 for d in differences]


class Peer:
    """A minimal client: one socket."""

    def __init__(self, server: NatNetServer) -> None:
        self.to = ("127.0.0.1", server.command_port)
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.settimeout(30.0)
        self.address = self.socket.getsockname()

    def send(self, message_id: int, payload: bytes = b"") -> None:
        self.socket.sendto(encode_message(message_id, payload), self.to)

    def receive(self, expected_id: int) -> bytes:
        while True:
            message_id, payload = split_message(self.socket.recv(65536))
            if message_id == expected_id:
                return payload

    def __enter__(self) -> Peer:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.socket.close()


def median(values: list[float]) -> float:
    return sorted(values)[len(values) // 2]


def tolerance_s(numbers: Mapping[str, float]) -> float:
    """Tolerance [s]: a millisecond, or half the shortest round trip on a busy machine."""
    return max(1e-3, 0.5e-3 * numbers["round_trip_min_ms"])


# -- handshake and versions -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", ["unicast", "multicast"])
@pytest.mark.parametrize("version", SERVED_BITSTREAMS, ids=str)
def test_client_receives_models_and_frames_of_every_version(
    serve: Serve, configure: Configure, mode: str, version: BitstreamVersion
) -> None:
    server = serve(mode=mode, version=version)
    received = Received()
    with NatNetClient(configure(server), received) as client:
        info = client.server_info
        assert info is not None
        assert info.is_multicast == (mode == "multicast")
        assert client.models is not None
        assert client.models[0][:2] == ("car", 1)
        until(lambda: len(received.frames) >= 20)
        assert client.version == version
        assert client.statistics()["malformed"] == 0.0
        until(lambda: client.server_mode == 0)
    assert all(frame.rigid_bodies[0].is_tracked for frame, *_ in received.frames)


def test_client_requests_an_older_version_from_a_newer_server(serve: Serve, configure: Configure) -> None:
    server = serve(version="4.1")
    server.version = V42  # it encodes 4.1 and older only: a client of 4.2 would get no frames
    received = Received()
    with NatNetClient(configure(server), received) as client:
        until(lambda: len(received.frames) >= 5)
        assert client.version == V41
        assert set(server.clients.values()) == {V41}


class RequestOnlyServer(NatNetServer):
    """Ignores the version in CONNECT: a client must request it while frames of the native version arrive."""

    def _answer(self, message_id: int, payload: bytes, address: Any, now_s: float) -> Any:
        if message_id == MessageId.CONNECT:
            payload = encode_connect("without a version", options=False)
        return super()._answer(message_id, payload, address, now_s)


def test_bitstream_changes_while_frames_arrive(serve: Serve, configure: Configure) -> None:
    server = serve(kind=RequestOnlyServer, version="4.1", faults=ServerFaults(latency_s=0.05))
    received = Received()
    with NatNetClient(configure(server, bitstream="3.0"), received) as client:
        assert client.server_info is not None
        assert client.server_info.bitstream == V41
        until(lambda: client.version == V30)
        count = len(received.frames)
        until(lambda: len(received.frames) >= count + 20)
        assert set(server.clients.values()) == {V30}
        assert client.statistics()["malformed"] == 0.0
        assert isinstance(client.models and client.models[0], RigidBodyDescription)


@pytest.fixture
def short_reconnect_period(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mocap.natnet.message_schedule.RECONNECT_PERIOD_S", 0.5)


@pytest.mark.usefixtures("short_reconnect_period")
def test_version_is_requested_again_after_a_server_restart(serve: Serve, configure: Configure) -> None:
    server = serve(kind=RequestOnlyServer, version="4.1", client_timeout_s=0.6)
    received = Received()
    with NatNetClient(configure(server, bitstream="3.0"), received) as client:
        until(lambda: client.version == V30 and bool(received.frames))
        server.faults = ServerFaults(no_answers=True)
        until(lambda: not server.clients)  # it has dropped the client
        server.faults = ServerFaults()
        until(lambda: set(server.clients.values()) == {V30})
        count = len(received.frames)
        until(lambda: len(received.frames) >= count + 20)
        assert client.version == V30
    assert received.sequences == sorted(set(received.sequences))


def test_frames_in_flight_are_decoded_in_both_versions() -> None:
    frame = Frame(5, rigid_bodies=(RigidBody(1, 1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0, 0.0, 1),))
    switch = BitstreamSwitch(V41, pending=V30)
    assert switch.decode_frame(encode_frame(frame, V41)) == frame
    assert switch.version == V41
    assert switch.decode_frame(encode_frame(frame, V30)) == frame
    assert (switch.version, switch.pending) == (V30, None)
    equal_layouts = BitstreamSwitch(V40, pending=V30)
    assert equal_layouts.decode_frame(encode_frame(frame, V40)) == frame
    assert equal_layouts.version == V40
    equal_layouts.decode_frame(encode_frame(frame._replace(params=FRAME_BITSTREAM_CHANGED), V30))
    assert equal_layouts.version == V30


def test_first_frame_of_a_new_version_has_the_changed_flag(serve: Serve) -> None:
    server = serve(version="4.1")
    with Peer(server) as peer:
        peer.send(MessageId.CONNECT)
        assert decode_frame(peer.receive(MessageId.FRAMEOFDATA), V41).params == 0
        peer.send(MessageId.REQUEST, encode_request("Bitstream,3.0"))
        assert peer.receive(MessageId.RESPONSE) == bytes(4)
        assert decode_frame(peer.receive(MessageId.FRAMEOFDATA), V30).params == FRAME_BITSTREAM_CHANGED
        assert decode_frame(peer.receive(MessageId.FRAMEOFDATA), V30).params == 0
        peer.send(MessageId.REQUEST_MODELDEF)
        assert decode_model_def(peer.receive(MessageId.MODELDEF), V30)[0][:2] == ("car", 1)
        peer.send(MessageId.REQUEST, encode_request("Bitstream,9.9"))
        assert peer.receive(MessageId.RESPONSE) != bytes(4)


def test_clients_of_different_versions_receive_the_same_poses(serve: Serve, configure: Configure) -> None:
    server = serve(version="4.1")
    old, new = Received(), Received()
    with (
        NatNetClient(configure(server, bitstream="3.0"), old) as first,
        NatNetClient(configure(server), new) as second,
    ):
        until(lambda: len(old.frames) >= 50 and len(new.frames) >= 50)
        assert sorted(server.clients.values()) == [V30, V41]
        assert (first.version, second.version) == (V30, V41)
        assert first.statistics()["malformed"] == second.statistics()["malformed"] == 0.0
    poses_old = {frame.frame_number: frame.rigid_bodies for frame, *_ in old.frames}
    poses_new = {frame.frame_number: frame.rigid_bodies for frame, *_ in new.frames}
    both = poses_old.keys() & poses_new.keys()
    assert len(both) > 10
    assert all(poses_old[n] == poses_new[n] for n in both)


# -- connection upkeep ----------------------------------------------------------------------------------------------


def test_client_without_keepalives_is_dropped(serve: Serve, configure: Configure) -> None:
    server = serve(client_timeout_s=1.2)
    with Peer(server) as peer, NatNetClient(configure(server)):
        peer.send(MessageId.CONNECT)
        until(lambda: len(server.clients) == 2)
        until(lambda: len(server.clients) == 1)
        assert peer.address not in server.clients
        peer.send(MessageId.CONNECT)
        until(lambda: peer.address in server.clients)
        peer.send(MessageId.DISCONNECT)
        until(lambda: peer.address not in server.clients)
        assert len(server.clients) == 1
    until(lambda: not server.clients)  # close() disconnects


def test_changed_models_are_requested_again(serve: Serve, configure: Configure) -> None:
    server = serve()
    received_models: list[tuple[Any, ...]] = []
    with NatNetClient(configure(server), on_models=received_models.append) as client:
        assert client.models is not None
        server.set_bodies((EmulatedBody("lorry", 12),))
        until(lambda: client.models is not None and client.models[0][:2] == ("lorry", 12))
    assert [models[0].name for models in (received_models[0], received_models[-1])] == ["car", "lorry"]


def test_lost_requests_for_models_are_sent_again(serve: Serve, configure: Configure) -> None:
    server = serve()
    with NatNetClient(configure(server)) as client:
        server.faults = ServerFaults(no_answers=True)
        server.set_bodies((EmulatedBody("lorry", 12),))
        start = server.frames
        until(lambda: server.frames > start + 320)  # the flag has ended, and two requests were lost
        server.faults = ServerFaults()
        until(lambda: client.models is not None and client.models[0][:2] == ("lorry", 12))


@pytest.mark.usefixtures("short_reconnect_period")
@pytest.mark.parametrize("mode", ["unicast", "multicast"])
def test_client_reconnects_to_a_restarted_server(serve: Serve, configure: Configure, mode: str) -> None:
    received = Received()
    server = serve(mode=mode, rate_hz=500.0)
    ports = {"command_port": server.command_port, "data_port": server.data_port}
    with NatNetClient(configure(server), received) as client:
        until(lambda: len(received.frames) >= 400)
        server.close()
        gap = len(received.frames)
        serve(mode=mode, version="3.0", rate_hz=60.0, **ports)  # its frame numbers and its clock restart
        until(lambda: len(received.frames) >= gap + 50)
        assert client.version == V30
        numbers = client.statistics()
    assert numbers["restarts"] == 1.0
    assert numbers["clock_resets"] >= 1.0
    assert received.sequences == sorted(set(received.sequences))
    settled = received.errors_s(len(received.frames) - 25)
    assert abs(median(settled)) < tolerance_s(numbers)
    assert all(capture_s <= received_s + 5e-3 for _, _, capture_s, received_s in received.frames)


@pytest.mark.usefixtures("short_reconnect_period")
def test_group_is_joined_again_after_the_adapter_was_removed(serve: Serve, configure: Configure) -> None:
    received = Received()
    with NatNetClient(configure(serve(mode="multicast")), received) as client:
        until(lambda: bool(received.frames))
        assert client._data is not None
        membership = b"".join(socket.inet_aton(address) for address in client._group)
        client._data.setsockopt(socket.IPPROTO_IP, socket.IP_DROP_MEMBERSHIP, membership)
        count = len(received.frames)
        until(lambda: len(received.frames) > count + 100)


def test_clock_step_of_the_server_is_detected_and_no_pose_is_in_the_future(serve: Serve, configure: Configure) -> None:
    server = serve(faults=ServerFaults(clock_offset_s=10.0))
    received = Received()
    with NatNetClient(configure(server), received) as client:
        until(lambda: len(received.frames) >= 30)
        server.faults = ServerFaults(clock_offset_s=500.0)
        until(lambda: client.statistics()["clock_resets"] == 1.0)
        numbers = client.statistics()  # a later echo may have a shorter round trip than those of the frames
        count = len(received.frames)
        until(lambda: len(received.frames) >= count + 60)
        assert client.statistics()["mistimed"] > 0.0
    assert abs(median(received.errors_s(count + 10))) < tolerance_s(numbers)
    assert all(capture_s <= received_s + 5e-3 for _, _, capture_s, received_s in received.frames)


@pytest.mark.parametrize("mode", ["unicast", "multicast"])
def test_capture_times_equal_the_true_times(serve: Serve, configure: Configure, mode: str) -> None:
    server = serve(mode=mode, faults=ServerFaults(clock_offset_s=12345.0, clock_drift_ppm=30.0, jitter_s=0.004))
    received = Received()
    with NatNetClient(configure(server), received) as client:
        until(lambda: len(received.frames) >= 200)
        numbers = client.statistics()
    assert abs(median(received.errors_s())) < tolerance_s(numbers)
    assert 0.0 < numbers["round_trip_min_ms"] < 50.0
    assert numbers["latency_p50_ms"] >= 3.0  # the exposure is 3 ms before a frame is due
    assert numbers["latency_p50_ms"] - numbers["server_latency_p50_ms"] < 50.0
    assert numbers["latency_p50_ms"] <= numbers["latency_p99_ms"]


# -- faults --------------------------------------------------------------------------------------------------------


def test_network_faults_are_tolerated_and_counted(serve: Serve, configure: Configure) -> None:
    server = serve(
        rate_hz=500.0,
        seed=3,
        faults=ServerFaults(garbage=0.2, truncation=0.2, repetition=0.2, loss=0.2, jitter_s=0.01),
    )
    received = Received()
    with NatNetClient(configure(server), received) as client:
        until(lambda: client.statistics()["frames"] >= 150.0)
        numbers = client.statistics()
        assert client.failure is None
        assert client.last_error.endswith(".")
    for counter in ("malformed", "lost", "repeated", "out_of_order"):
        assert numbers[counter] > 0.0, counter
    assert received.sequences == sorted(set(received.sequences))
    for frame, *_ in received.frames:
        assert frame.rigid_bodies[0].y_m == 0.25


def test_foreign_datagrams_are_counted_and_ignored(serve: Serve, configure: Configure) -> None:
    server = serve(rate_hz=30.0)
    received = Received()
    foreign_frame = encode_message(MessageId.FRAMEOFDATA, encode_frame(Frame(10**6), V41))
    with NatNetClient(configure(server), received) as client:
        until(lambda: bool(received.frames))
        (address,) = server.clients
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as foreign_socket:
            foreign_socket.bind(("127.0.0.2", 0))
            foreign_socket.sendto(foreign_frame, address)
        until(lambda: client.statistics()["foreign"] == 1.0)
        assert client.foreign_address == "127.0.0.2"
        count = len(received.frames)
        until(lambda: len(received.frames) > count)
    assert all(frame.frame_number < 10**6 for frame, *_ in received.frames)


def test_error_in_a_listener_ends_reception_and_is_stored(serve: Serve, configure: Configure) -> None:
    server = serve()
    received = Received()
    errors: list[Exception] = []

    def listener(*arguments: Any) -> None:
        if errors:
            raise errors.pop()
        received(*arguments)

    client = NatNetClient(configure(server), listener)
    with client:
        errors.append(RuntimeError("the listener broke"))
        until(lambda: client.failure is not None)
        assert "the listener broke" in client.last_error
    with client:
        until(lambda: bool(received.frames))
        assert client.failure is None
