"""An emulated NatNet server: it streams poses from a callback to any NatNet client, by default on loopback.

Its behaviour meets the needs of the vendor's client library: SERVERINFO of 279 bytes, an answer to every echo, no
answer to keep-alives, frames from the data port to the source address of CONNECT, an end-of-data tag.
"""

from __future__ import annotations

import heapq
import logging
import random
import select
import socket
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from carlab.core.errors import ConfigError, NotOpenError, ProtocolError
from carlab.core.resource import Resource
from mocap.config import check_multicast_group
from mocap.emulators.faults import ServerFaults
from mocap.emulators.scene import EmulatedBody, EmulatedScene, RigidBodySample
from mocap.natnet.descriptions import encode_model_def
from mocap.natnet.frames import encode_frame
from mocap.natnet.messages import (
    ServerInfo,
    decode_connect,
    decode_echo_request,
    decode_text,
    encode_echo_response,
    encode_message,
    encode_response,
    encode_server_info,
    split_message,
)
from mocap.natnet.models import (
    FRAME_BITSTREAM_CHANGED,
    FRAME_MODELS_CHANGED,
    NEWEST_BITSTREAM,
    SERVED_BITSTREAMS,
    BitstreamVersion,
    Frame,
    MessageId,
)
from mocap.natnet.sockets import (
    DATAGRAM_BYTES,
    DEFAULT_COMMAND_PORT,
    DEFAULT_DATA_PORT,
    DEFAULT_GROUP,
    resolve,
    udp_socket,
)

_log = logging.getLogger(__name__)

CLOCK_HZ = 10_000_000
CLIENT_TIMEOUT_S = 10.0
MODELS_CHANGED_S = 0.5
"""Duration of the models-changed flag in frames [s], since a single frame may be lost."""
PROCESSING_S = 5e-4
"""Stamped time from data received to transmission [s], if the exposure was earlier."""
SERVER_NAME = "carlab emulator"

Address = tuple[str, int]
PoseCallback = Callable[[float], Sequence[RigidBodySample | None]]


@dataclass(slots=True)
class _Client:
    version: BitstreamVersion
    last_message_s: float
    changed: bool = False


def _check_servable(version: BitstreamVersion, rate_hz: float, mode: str) -> None:
    if version not in SERVED_BITSTREAMS:
        served = ", ".join(map(str, SERVED_BITSTREAMS))
        raise ConfigError(f"The emulated server cannot stream bitstream {version}; choose one of {served}.")
    if not rate_hz > 0.0:
        raise ConfigError(f"The emulated server's rate is {rate_hz} Hz; it must be above zero.")
    if mode not in ("unicast", "multicast"):
        raise ConfigError(f"The emulated server's mode is '{mode}'; choose unicast or multicast.")


class NatNetServer(Resource):
    """An emulated server. Constructing does nothing; ``open`` or ``with`` binds the ports and starts to serve.

    By default a thread serves. A process with its own loop calls ``open(threaded=False)`` and then ``step`` at each
    ``next_deadline_s``.

    Args:
        poses: Called at each frame's deadline t [s, host monotonic] from the serving thread; returns a sample, or
            None for occluded, for each of ``bodies``. Samples may have been captured before t.
        bodies: Rigid bodies of the model definitions.
        rate_hz: Frames per second.
        mode: Unicast to every client that connects, or multicast to the group.
        version: Native bitstream version. A unicast client may request an older one from a server of 4.0 or later.
        host: Interface to serve on.
        command_port: 0 for any free port; ``command_port`` holds it once open.
        data_port: Likewise; in multicast mode also the destination port of frames.
        multicast_group: Destination of multicast frames.
        up_axis: Up axis of the streamed data; ``poses`` have Z up.
        faults: Simulated faults; none by default.
        seed: Seed of the random faults.
        client_timeout_s: Time without a message after which a unicast client is dropped [s].
    """

    def __init__(
        self,
        poses: PoseCallback,
        bodies: Sequence[EmulatedBody] = (EmulatedBody(),),
        *,
        rate_hz: float = 240.0,
        mode: Literal["unicast", "multicast"] = "unicast",
        version: BitstreamVersion | str = NEWEST_BITSTREAM,
        host: str = "127.0.0.1",
        command_port: int = DEFAULT_COMMAND_PORT,
        data_port: int = DEFAULT_DATA_PORT,
        multicast_group: str = DEFAULT_GROUP,
        up_axis: Literal["y", "z"] = "y",
        faults: ServerFaults | None = None,
        seed: int = 0,
        client_timeout_s: float = CLIENT_TIMEOUT_S,
    ) -> None:
        self.version = BitstreamVersion.parse(version) if isinstance(version, str) else version
        _check_servable(self.version, rate_hz, mode)
        check_multicast_group(multicast_group, "The emulated server's multicast_group")
        self.rate_hz = rate_hz
        self.mode = mode
        self.host = host
        self.command_port = command_port
        self.data_port = data_port
        self.multicast_group = multicast_group
        self.client_timeout_s = client_timeout_s
        self.faults = faults or ServerFaults()
        self.frames = 0
        self.failure: Exception | None = None
        """Error that ended the serving thread before ``close``, for example from ``poses``."""
        self._poses = poses
        self._scene = EmulatedScene(tuple(bodies), up_axis)
        self._ports = (command_port, data_port)
        self._rng = random.Random(seed)
        self._clients: dict[Address, _Client] = {}
        self._command: socket.socket | None = None
        self._data: socket.socket | None = None
        self._thread: threading.Thread | None = None
        self._stop = threading.Event()
        self._lock = threading.Lock()
        self._waiting: list[tuple[float, int, Frame]] = []
        self._last_frame: Frame | None = None
        self._last_samples: list[RigidBodySample | None] = []
        self._models_changed_until_s = 0.0
        self._start_s = self._next_frame_s = 0.0

    def open(self, *, threaded: bool = True) -> None:
        """Bind both ports and start serving. Idempotent. Raises NotReadyError if a port is in use."""
        if self._command is not None:
            return
        self.failure = None
        try:
            address = resolve(self.host, "the emulated server's host")
            self._command = udp_socket(address, self._ports[0])
            # Other clients on this host may bind the same data port to receive multicast.
            self._data = udp_socket(address, self._ports[1], shared=self.mode == "multicast")
            if self.mode == "multicast":
                self._data.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(address))
                self._data.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_LOOP, 1)
        except BaseException:
            self.close()
            raise
        self.command_port = self._command.getsockname()[1]
        self.data_port = self._data.getsockname()[1]
        self.frames = 0
        self._clients.clear()
        self._waiting.clear()
        self._start_s = self._next_frame_s = time.monotonic()
        self._stop.clear()
        if threaded:
            self._thread = threading.Thread(target=self._serve, name="natnet-server", daemon=True)
            self._thread.start()

    def close(self) -> None:
        """Stop serving and free the ports. Idempotent."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        for sock in (self._command, self._data):
            if sock is not None:
                sock.close()
        self._command = self._data = None

    def _serve(self) -> None:
        try:
            while not self._stop.is_set():
                wait_s = min(max(self.next_deadline_s - time.monotonic(), 0.0), 0.05)
                if self._command is not None:
                    select.select([self._command], [], [], wait_s)
                self.step(time.monotonic())
        except Exception as error:
            _log.exception("The emulated NatNet server has failed.")
            self.failure = error

    @property
    def next_deadline_s(self) -> float:
        """Time at which ``step`` is due next [s, host monotonic]."""
        return min(self._next_frame_s, self._waiting[0][0]) if self._waiting else self._next_frame_s

    @property
    def clients(self) -> dict[Address, BitstreamVersion]:
        """Connected unicast clients with their bitstream versions."""
        with self._lock:
            return {address: client.version for address, client in self._clients.items()}

    def set_bodies(self, bodies: Sequence[EmulatedBody]) -> None:
        """Change the tracked bodies; a flag in the frames informs clients. ``poses`` must match from then on."""
        with self._lock:
            self._scene = EmulatedScene(tuple(bodies), self._scene.up_axis)
            self._models_changed_until_s = time.monotonic() + MODELS_CHANGED_S

    def ticks(self, t_s: float) -> int:
        """The server's clock at a host time [s, monotonic], with its faults."""
        since_s = t_s - self._start_s
        server_s = 1000.0 + since_s * (1.0 + self.faults.clock_drift_ppm * 1e-6) + self.faults.clock_offset_s
        return max(1, round(server_s * CLOCK_HZ))

    def step(self, now_s: float) -> None:
        """Answer received messages and send the frames due at ``now_s`` [s, host monotonic]. Never blocks.

        Raises NotOpenError before ``open``.
        """
        if self._command is None:
            raise NotOpenError("The NatNet server is not open; call open(threaded=False) before step().")
        with self._lock:
            self._answer_all()
            if now_s >= self._next_frame_s:
                self._make_frame(self._next_frame_s, now_s)
                # Absolute deadlines; missed frames are skipped, not sent in a burst.
                missed = int((now_s - self._next_frame_s) * self.rate_hz)
                self.frames += 1 + missed
                self._next_frame_s = self._start_s + self.frames / self.rate_hz
            while self._waiting and self._waiting[0][0] <= now_s:
                self._send_frame(heapq.heappop(self._waiting)[2], time.monotonic())

    def _make_frame(self, due_s: float, now_s: float) -> None:
        faults = self.faults
        samples = self._frozen(list(self._poses(due_s))) if faults.frozen else list(self._poses(due_s))
        self._last_samples = samples
        captured_s = min((s.t_capture_s for s in samples if s is not None), default=due_s)
        if self._rng.random() < faults.occlusion:
            samples = [None] * len(samples)
        frame = self._scene.frame(self.frames, samples)
        params = FRAME_MODELS_CHANGED if now_s < self._models_changed_until_s else 0
        stamped = frame._replace(
            timestamp_s=self.frames / self.rate_hz, mid_exposure_ticks=self.ticks(captured_s), params=params
        )
        for address in [a for a, c in self._clients.items() if now_s - c.last_message_s > self.client_timeout_s]:
            _log.info("NatNet client %s dropped after %g s of silence.", address, self.client_timeout_s)
            del self._clients[address]
        if not faults.no_frames:
            leaves_s = due_s + faults.latency_s + faults.jitter_s * self._rng.random()
            heapq.heappush(self._waiting, (leaves_s, self.frames, stamped))

    def _frozen(self, samples: list[RigidBodySample | None]) -> list[RigidBodySample | None]:
        """The last poses with the stamps of ``samples``."""
        return [
            replace(last, t_capture_s=sample.t_capture_s) if sample and last else sample
            for sample, last in zip(samples, self._last_samples or samples, strict=True)
        ]

    def _send_frame(self, frame: Frame, now_s: float) -> None:
        transmitted = self.ticks(now_s)
        received = max(frame.mid_exposure_ticks, transmitted - round(PROCESSING_S * CLOCK_HZ))
        frame = frame._replace(received_ticks=received, transmit_ticks=transmitted)
        self._last_frame = frame
        written: dict[tuple[BitstreamVersion, bool], bytes] = {}
        if self.mode == "multicast":
            targets = [((self.multicast_group, self.data_port), self.version, False)]
        else:
            targets = [(address, client.version, client.changed) for address, client in self._clients.items()]
        for address, version, changed in targets:
            if (version, changed) not in written:
                marked = frame._replace(params=frame.params | FRAME_BITSTREAM_CHANGED) if changed else frame
                payload = encode_frame(marked, self.faults.frame_version or version)
                written[version, changed] = encode_message(MessageId.FRAMEOFDATA, payload)
            for datagram in self.faults.apply(written[version, changed], self._rng):
                self._send(self._data, datagram, address)
        for client in self._clients.values():
            client.changed = False

    def _send(self, sock: socket.socket | None, datagram: bytes, address: Address) -> None:
        if sock is None:
            return
        try:
            sock.sendto(datagram, address)
        except OSError as error:  # full buffer or closed client: the datagram is lost, as on a real network
            _log.debug("Sending to %s failed: %s", address, error)

    def _answer_all(self) -> None:
        assert self._command is not None
        while True:
            try:
                datagram, address = self._command.recvfrom(DATAGRAM_BYTES)
            except BlockingIOError:
                return
            except ConnectionError:  # Windows reports a closed client here
                continue
            now_s = time.monotonic()
            if self.faults.no_answers:
                continue
            try:
                message_id, payload = split_message(datagram, lenient=True)
                answer = self._answer(message_id, payload, address, now_s)
            except ProtocolError as error:
                _log.debug("From %s: %s", address, error)
                continue
            if address in self._clients:
                self._clients[address].last_message_s = now_s
            if answer is not None:
                self._send(self._command, encode_message(*answer), address)

    def _answer(self, message_id: int, payload: bytes, address: Address, now_s: float) -> tuple[int, bytes] | None:
        known = self._clients.get(address)
        version = known.version if known else self.version
        match message_id:
            case MessageId.CONNECT:
                wanted = decode_connect(payload).bitstream
                version = self._negotiated_version(wanted) if wanted else version
                if self.mode == "unicast":
                    changed = known is not None and known.version != version
                    self._clients[address] = _Client(version, now_s, changed or version != self.version)
                return MessageId.SERVERINFO, self._server_info(version)
            case MessageId.DISCOVERY:
                return MessageId.SERVERINFO, self._server_info(self.version)
            case MessageId.ECHOREQUEST:
                stamp = decode_echo_request(payload)
                return MessageId.ECHORESPONSE, encode_echo_response(stamp, self.ticks(now_s))
            case MessageId.REQUEST_MODELDEF:
                return MessageId.MODELDEF, encode_model_def(self._scene.descriptions(), version)
            case MessageId.REQUEST_FRAMEOFDATA:
                return self._last_frame and (MessageId.FRAMEOFDATA, encode_frame(self._last_frame, version))
            case MessageId.REQUEST:
                return self._answer_request(decode_text(payload), known)
            case MessageId.KEEPALIVE:
                return None
            case MessageId.DISCONNECT:
                self._clients.pop(address, None)
                return None
        return MessageId.UNRECOGNIZED_REQUEST, b""

    def _answer_request(self, request: str, client: _Client | None) -> tuple[int, bytes]:
        command, _, argument = request.partition(",")
        values: dict[str, int | float | str] = {
            "FrameRate": float(self.rate_hz),
            "AnalogSamplesPerMocapFrame": 0,
            "UnitsToMillimeters": 1000.0,
            "CurrentMode": self.faults.server_mode,
            "Bitstream": f"Bitstream,{client.version if client else self.version}",
        }
        if command == "Bitstream" and argument:
            return MessageId.RESPONSE, encode_response(self._change_bitstream(argument, client))
        if command in values and not argument:
            return MessageId.RESPONSE, encode_response(values[command])
        return MessageId.UNRECOGNIZED_REQUEST, b""

    def _change_bitstream(self, argument: str, client: _Client | None) -> int:
        """Switch one client to another version: 0 for done, 1 for refused."""
        try:
            wanted = BitstreamVersion.parse(argument)
        except ProtocolError:
            return 1
        if client is None or self._negotiated_version(wanted) != wanted:
            return 1
        client.changed = client.changed or client.version != wanted
        client.version = wanted
        return 0

    def _negotiated_version(self, wanted: BitstreamVersion) -> BitstreamVersion:
        """Version for a client that requests ``wanted``; a change needs a unicast server of 4.0 or later."""
        possible = self.mode == "unicast" and self.version >= (4, 0) and wanted in SERVED_BITSTREAMS
        return wanted if possible and wanted <= self.version else self.version

    def _server_info(self, version: BitstreamVersion) -> bytes:
        multicast = self.mode == "multicast"
        four = (version.major, version.minor, 0, 0)
        group = self.multicast_group if multicast else ""
        info = ServerInfo(SERVER_NAME, (1, 0, 0, 0), four, CLOCK_HZ, self.data_port, multicast, group)
        return encode_server_info(info)
