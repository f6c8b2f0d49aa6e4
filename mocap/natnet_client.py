"""A NatNet client: handshake, keep-alive, clock alignment, and one thread that receives.

Threading: only the receiver thread reads the sockets and decodes. ``open`` sends requests and waits on one condition
for the thread's results. The thread counts invalid datagrams and continues.
"""

from __future__ import annotations

import logging
import select
import socket
import threading
import time
from collections.abc import Callable, Mapping

from carlab.core.errors import ProtocolError
from carlab.core.resource import Resource
from mocap.config import MocapConfig
from mocap.natnet import messages, sockets
from mocap.natnet.bitstream_switch import BitstreamSwitch
from mocap.natnet.message_schedule import MessageSchedule
from mocap.natnet.models import (
    FRAME_MODELS_CHANGED,
    FRAME_RECORDING,
    BitstreamVersion,
    Description,
    Frame,
    MessageId,
    ServerMode,
    check_readable,
)
from mocap.stream_statistics import MALFORMED_RUN, StreamStatistics
from mocap.time_alignment import ClockAlignment

_log = logging.getLogger(__name__)

MIN_ECHOES = 8
"""Number of echoes before the alignment is accurate; until then they are sent more often."""
RETRY_PERIOD_S = 0.25
WAKE_PERIOD_S = 0.02

FrameListener = Callable[[Frame, int, float, float], None]
"""Called in the receiver thread with a frame, its sequence number, capture and receive time [s, host monotonic]."""


class NatNetClient(Resource):
    """Connection to one NatNet server. Constructing does nothing; ``open`` or ``with`` connects.

    ``on_models`` gets no definitions once the server has restarted: until it sends them, its ids may be others.
    """

    def __init__(
        self,
        config: MocapConfig,
        on_frame: FrameListener | None = None,
        on_models: Callable[[tuple[Description, ...]], None] | None = None,
    ) -> None:
        self.config = config
        self._on_frame = on_frame
        self._on_models = on_models
        self._changed = threading.Condition()
        self._server = ""
        self._command: socket.socket | None = None
        self._data: socket.socket | None = None
        self._group = ("", "")
        self._thread: threading.Thread | None = None
        self._stop = threading.Event()
        self._reset()

    def open(self) -> None:
        """Connect, negotiate the bitstream version, request the model definitions and align the clocks. Idempotent.

        Raises NotReadyError if the server does not answer, streams in another mode, or streams a version that cannot
        be decoded.
        """
        if self._thread is not None and self._thread.is_alive():
            return
        self.close()
        try:
            self._open()
        except BaseException:
            self.close()
            raise

    def _open(self) -> None:
        config = self.config
        self._reset()
        self._server = sockets.resolve(config.server_address)
        local = config.local_interface
        interface = sockets.resolve(local, "local_interface") if local else sockets.interface_towards(self._server)
        self._command = sockets.udp_socket(interface, 0)
        self._stop.clear()
        self._thread = threading.Thread(target=self._receive, name="natnet-receiver", daemon=True)
        self._thread.start()
        unicast = config.mode == "unicast"
        if not self._send_until(MessageId.CONNECT, self._connect_payload(), lambda: self.server_info is not None):
            raise sockets.not_ready(
                f"no NatNet server answered at {config.server_address}:{config.command_port} within "
                f"{config.timeout_s:g} s: is Motive streaming (Data Streaming pane, Broadcast Frame Data on), is its "
                "Local Interface the network that this computer is on, and does its firewall let UDP pass?"
            )
        info = self.server_info
        assert info is not None
        if info.clock_hz and info.is_multicast == unicast:
            found = "multicast" if info.is_multicast else "unicast"
            raise sockets.not_ready(
                f'{info.name} streams by {found}; set mode = "{found}" in [hardware.mocap] (listen: --mode {found}), '
                "or change Motive."
            )
        self._agree_on_bitstream(info)
        if not unicast:
            group = config.multicast_group or info.multicast_group or sockets.DEFAULT_GROUP
            self._data = sockets.multicast_receiver(
                group, config.data_port or info.data_port or sockets.DEFAULT_DATA_PORT, interface
            )
            self._group = (group, interface)
        self._polls_mode = True
        if not self._send_until(MessageId.REQUEST_MODELDEF, b"", lambda: self.models is not None):
            detail = self._statistics.last_error or "the request had no answer; restart streaming in Motive."
            raise sockets.not_ready(f"no model definitions within {config.timeout_s:g} s: {detail}")
        if info.clock_hz:
            # The thread sends the echoes; without answers, capture times are times of arrival.
            self._wait(lambda: self.alignment.echoes >= MIN_ECHOES, config.timeout_s)

    def _agree_on_bitstream(self, info: messages.ServerInfo) -> None:
        """Request the version from a unicast server of NatNet 4 or later; until it takes effect both are decoded."""
        decoder, wanted = self._decoder, self.config.bitstream_version
        assert decoder is not None
        if self._wants_other_bitstream(info):
            self._responses.clear()
            decoder.pending = wanted
            request = messages.encode_request(f"Bitstream,{wanted}")
            answered = self._send_until(MessageId.REQUEST, request, lambda: bool(self._responses))
            if answered and self._responses[0] == 0:
                return
            decoder.pending = None
        try:
            check_readable(info.bitstream)
        except ProtocolError as error:
            raise sockets.not_ready(str(error)) from error

    def close(self) -> None:
        """Disconnect, stop the thread, close the sockets. Idempotent, safe after a failed open."""
        self._stop.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join()
        self._thread = None
        if self._command is not None:
            if self.server_info is not None:
                self._send(MessageId.DISCONNECT)
            self._command.close()
            self._command = None
        if self._data is not None:
            self._data.close()
            self._data = None

    @property
    def is_live(self) -> bool:
        """Whether the frames show what the cameras see now, and not a recorded take; True if the server is silent."""
        if self.server_mode == ServerMode.RECORDING_OR_EDIT:
            return self._is_recording
        return self.server_mode in (None, ServerMode.LIVE)

    @property
    def is_unreadable(self) -> bool:
        """Whether the newest datagrams could not be decoded, for example after a change of the bitstream version."""
        return self._statistics.malformed_run >= MALFORMED_RUN

    @property
    def version(self) -> BitstreamVersion | None:
        """Current bitstream version of the frames; None before the handshake."""
        return None if self._decoder is None else self._decoder.version

    @property
    def last_error(self) -> str:
        """Error of the last datagram that could not be decoded; empty for none."""
        return self._statistics.last_error

    @property
    def foreign_address(self) -> str:
        """Source address of the last datagram that was not the server's; empty for none."""
        return self._statistics.foreign_address

    @property
    def failure(self) -> Exception | None:
        """Error that ended the receiver thread before ``close``, for example in a listener; None for none."""
        return self._failure

    def statistics(self) -> Mapping[str, float]:
        """Counts of received, lost and invalid frames, rate, latencies and clock alignment."""
        with self._changed:
            numbers = self._statistics.as_mapping()
            numbers["round_trip_min_ms"] = self.alignment.round_trip_s * 1e3
            numbers["clock_drift_ppm"] = self.alignment.drift_ppm
            numbers["clock_resets"] = float(self.alignment.resets)
        return numbers

    def _reset(self) -> None:
        self.server_info: messages.ServerInfo | None = None
        self.models: tuple[Description, ...] | None = None
        self.server_mode: int | None = None
        self.alignment = ClockAlignment(0.0)
        self._statistics = StreamStatistics()
        self._decoder: BitstreamSwitch | None = None
        self._responses: list[int | None] = []
        self._polls_mode = self._is_recording = False
        self._schedule = MessageSchedule(keepalives=self.config.mode == "unicast")
        self._failure: Exception | None = None

    def _connect_payload(self) -> bytes:
        wanted = self.config.bitstream_version if self.config.mode == "unicast" else None
        return messages.encode_connect("carlab", bitstream=wanted)

    def _send_until(self, message_id: int, payload: bytes, answered: Callable[[], bool]) -> bool:
        """Send a message repeatedly until ``answered``; False after the time-out."""
        deadline_s = time.monotonic() + self.config.timeout_s
        while (left_s := deadline_s - time.monotonic()) > 0.0:
            self._send(message_id, payload)
            if self._wait(answered, min(RETRY_PERIOD_S, left_s)):
                return True
        return answered()

    def _wait(self, ready: Callable[[], bool], timeout_s: float) -> bool:
        """Wait for the receiver thread. Raises NotReadyError if it has ended."""
        with self._changed:
            self._changed.wait_for(lambda: ready() or self._failure is not None, timeout_s)
            if self._failure is not None:
                raise sockets.not_ready(f"{self.last_error}; close it and open it again.") from self._failure
            return ready()

    def _send(self, message_id: int, payload: bytes = b"") -> None:
        if self._command is None:
            return
        try:
            self._command.sendto(messages.encode_message(message_id, payload), (self._server, self.config.command_port))
        except OSError as error:  # the network may be down briefly; missing frames are reported elsewhere
            with self._changed:
                self._statistics.last_error = f"sending to {self._server} failed: {error}"

    def _receive(self) -> None:
        """Body of the receiver thread."""
        try:
            while not self._stop.is_set():
                self._receive_once()
        except Exception as error:
            # The error is stored for ``failure`` and ``last_error``.
            _log.exception("The NatNet receiver has failed.")
            with self._changed:
                self._failure = error
                self._statistics.last_error = f"the receiver failed: {error!r}"
                self._changed.notify_all()

    def _receive_once(self) -> None:
        listening = [s for s in (self._command, self._data) if s is not None]
        ready, _, _ = select.select(listening, [], [], WAKE_PERIOD_S)
        for sock in ready:
            try:
                datagram, source = sock.recvfrom(sockets.DATAGRAM_BYTES)
            except OSError as error:
                # BlockingIOError: no datagram after all; others: the network is down briefly.
                if not isinstance(error, BlockingIOError):
                    self._statistics.last_error = f"receiving failed: {error}"
                    self._stop.wait(WAKE_PERIOD_S)
                continue
            received_s = time.monotonic()
            self._handle_datagram(datagram, source, received_s)
        self._send_due_messages(time.monotonic())

    def _handle_datagram(self, datagram: bytes, source: tuple[str, int], received_s: float) -> None:
        if source[0] != self._server:
            with self._changed:
                self._statistics.foreign += 1
                self._statistics.foreign_address = source[0]
            return
        try:
            message_id, payload = messages.split_message(datagram)
            if message_id == MessageId.FRAMEOFDATA:
                self._handle_frame(payload, received_s)
            else:
                self._handle_message(message_id, payload, received_s)
        except ProtocolError as error:
            with self._changed:
                self._statistics.add_malformed(str(error))
                self._changed.notify_all()

    def _handle_message(self, message_id: int, payload: bytes, received_s: float) -> None:
        models: tuple[Description, ...] | None = None
        with self._changed:
            if message_id == MessageId.SERVERINFO:
                models = () if self._handle_server_info(messages.decode_server_info(payload)) else None
            elif message_id == MessageId.ECHORESPONSE:
                stamp, ticks = messages.decode_echo_response(payload)
                self.alignment.add_echo(stamp * 1e-9, ticks, received_s)
            elif message_id == MessageId.MODELDEF and self._decoder is not None:
                models = self.models = self._decoder.decode_models(payload)
                self._schedule.note_models()
            elif message_id in (MessageId.RESPONSE, MessageId.UNRECOGNIZED_REQUEST):
                is_answer = message_id == MessageId.RESPONSE
                self._handle_response(messages.decode_integer_response(payload) if is_answer else None)
            elif message_id == MessageId.MESSAGESTRING:
                _log.info("Message from the NatNet server: %s", messages.decode_text(payload))
            self._changed.notify_all()
        if models is not None and self._on_models is not None:
            self._on_models(models)

    def _handle_server_info(self, info: messages.ServerInfo) -> bool:
        """Store the server's information; returns whether the server may be a different one, after a reconnect."""
        before = self.server_info
        if before == info and not self._schedule.reconnecting:
            return False
        self._schedule.note_server_info(time.monotonic())
        self.server_info = info
        self._decoder = BitstreamSwitch(info.bitstream)
        if before is not None:
            if before != info:
                _log.warning("The NatNet server has changed: %s", info)
            self._schedule.models_outdated = True
            if self._wants_other_bitstream(info):
                self._decoder.pending = self.config.bitstream_version
                self._send(MessageId.REQUEST, messages.encode_request(f"Bitstream,{self.config.bitstream}"))
        if before is None or before.clock_hz != info.clock_hz:
            self.alignment = ClockAlignment(float(info.clock_hz))
        return before is not None

    def _handle_response(self, response: int | None) -> None:
        """Store the answer to the request for the mode, or to that for a bitstream version before."""
        if not self._polls_mode:
            self._responses.append(response)
        elif response is not None:
            self.server_mode = response

    def _wants_other_bitstream(self, info: messages.ServerInfo) -> bool:
        return (
            self.config.mode == "unicast"
            and info.bitstream >= (4, 0)
            and info.bitstream > self.config.bitstream_version
        )

    def _handle_frame(self, payload: bytes, received_s: float) -> None:
        if self._decoder is None:
            return
        frame = self._decoder.decode_frame(payload)
        self._schedule.note_frame(received_s)
        with self._changed:
            restarts, lost = self._statistics.restarts, self._statistics.lost
            sequence = self._statistics.accept(frame.frame_number, received_s)
            if sequence is None:
                return
            capture_s = self._capture_time(frame, received_s)
            self._is_recording = bool(frame.params & FRAME_RECORDING)
            has_restarted = self._statistics.restarts > restarts
            if frame.params & FRAME_MODELS_CHANGED or has_restarted:
                self._schedule.models_outdated = True
            if self._statistics.lost > lost:
                self._schedule.models_uncertain = True
        if has_restarted and self._on_models is not None:
            self._on_models(())
        if self._on_frame is not None:
            self._on_frame(frame, sequence, capture_s, received_s)

    def _capture_time(self, frame: Frame, received_s: float) -> float:
        exposed_ticks = frame.mid_exposure_ticks or frame.transmit_ticks
        exposure = self.alignment.exposure(exposed_ticks, frame.transmit_ticks, received_s)
        if exposure.is_inconsistent:
            self._schedule.advance_echo(received_s)
        if exposure.is_aligned:
            self._statistics.add_latency(received_s - exposure.capture_s, exposure.on_server_s)
        elif exposure.is_inconsistent:
            self._statistics.mistimed += 1
        return exposure.capture_s

    def _send_due_messages(self, now_s: float) -> None:
        if self.server_info is None:
            return
        settled = self.alignment.echoes >= MIN_ECHOES and not self.alignment.is_uncertain
        payloads: dict[MessageId, Callable[[], bytes]] = {
            MessageId.CONNECT: self._connect_payload,
            MessageId.ECHOREQUEST: lambda: messages.encode_echo_request(time.monotonic_ns()),
            MessageId.REQUEST: lambda: messages.encode_request("CurrentMode"),
        }
        has_clock, polls_mode = self.server_info.clock_hz > 0, self._polls_mode
        for message_id in self._schedule.due(now_s, has_clock=has_clock, settled=settled, polls_mode=polls_mode):
            self._send(message_id, payloads.get(message_id, bytes)())
            if message_id == MessageId.CONNECT and self._data is not None:
                sockets.join_group_again(self._data, *self._group)
