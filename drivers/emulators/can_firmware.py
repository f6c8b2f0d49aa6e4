"""An emulated VESC on a CAN bus of python-can: ``virtual`` within a process, ``udp_multicast`` between processes."""

from __future__ import annotations

import threading
import time

import can

from carlab.core.resource import Resource
from drivers.config import MULTICAST_GROUP
from drivers.emulators.faults import WireFaults
from drivers.emulators.vesc_firmware import VescFirmware
from drivers.links.bus_lock import BusLock, IdUse
from drivers.links.can_link import open_bus
from drivers.links.link import CanFrame
from drivers.vesc import can_codec as vesc_can_codec
from drivers.vesc.can_codec import CanReassembler, Packet, ReplyMode
from drivers.vesc.payloads import Command

POLL_S = 0.005
STATUS_PACKETS = (Packet.STATUS_1, Packet.STATUS_4, Packet.STATUS_5)
_SIMPLE = {
    Packet.SET_DUTY: Command.SET_DUTY,
    Packet.SET_CURRENT: Command.SET_CURRENT,
    Packet.SET_CURRENT_BRAKE: Command.SET_CURRENT_BRAKE,
    Packet.SET_RPM: Command.SET_RPM,
}
"""Motor commands whose data are those of the serial payload, without its command id."""


class CanFirmware(Resource):
    """A ``VescFirmware`` on a CAN bus; one thread serves it between ``open`` and ``close``.

    While open it holds the lock on its controller's id (``drivers.links.bus_lock``).

    Args:
        firmware: The firmware; its callbacks run in the serving thread.
        interface: python-can interface.
        channel: Channel of the interface; for ``udp_multicast`` GROUP or GROUP:PORT on this host's loopback.
        status_rate_hz: Rate of status broadcasts 1, 4 and 5; 0 for none, the default of a new VESC.
        faults: Faults of the wire.
    """

    def __init__(
        self,
        firmware: VescFirmware,
        interface: str = "udp_multicast",
        channel: str = MULTICAST_GROUP,
        *,
        status_rate_hz: float = 50.0,
        faults: WireFaults | None = None,
    ) -> None:
        self.firmware = firmware
        self.log = firmware.log
        self.interface = interface
        self.channel = channel
        self.status_rate_hz = status_rate_hz
        self.faults = WireFaults() if faults is None else faults
        self._lock = BusLock(interface, channel, firmware.controller_id, IdUse.EMULATOR)
        self._reassembler = CanReassembler(firmware.controller_id)
        self._bus: can.BusABC | None = None
        self._thread: threading.Thread | None = None
        self._stop = threading.Event()
        self._has_received = False
        self._next_status_s = 0.0

    def open(self) -> None:
        """Join the bus and start serving. Idempotent. Raises NotReadyError if a program emulates this controller."""
        if self._thread is not None:
            return
        self._lock.acquire()
        self.log.open()
        self._bus = open_bus(self.interface, self.channel, 500_000)
        self.log.add(time.monotonic(), "open")
        self._stop.clear()
        self._thread = threading.Thread(target=self._serve, args=(self._bus,), name="can-firmware", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop serving and leave the bus. Idempotent."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        if self._bus is not None:
            self._bus.shutdown()
            self._bus = None
        self._lock.release()
        self.log.close()

    def _serve(self, bus: can.BusABC) -> None:
        while not self._stop.is_set():
            message = bus.recv(POLL_S)
            now_s = time.monotonic()
            if message is not None and message.is_extended_id and not message.is_error_frame:
                frame = CanFrame(message.arbitration_id, bytes(message.data))
                if self.faults.transmit(frame.data) == frame.data:  # a frame with a flipped bit is lost on CAN
                    self._handle_frame(bus, frame, now_s)
            self.firmware.poll(now_s)
            if self.status_rate_hz > 0.0 and now_s >= self._next_status_s:
                self._next_status_s = now_s + 1.0 / self.status_rate_hz
                values = self.firmware.values(now_s)
                for packet in STATUS_PACKETS:
                    self._send(bus, vesc_can_codec.encode_status(packet, self.firmware.controller_id, values))

    def _handle_frame(self, bus: can.BusABC, frame: CanFrame, now_s: float) -> None:
        own_id = self.firmware.controller_id
        if vesc_can_codec.controller_of(frame) not in (own_id, vesc_can_codec.BROADCAST_ID):
            return
        if vesc_can_codec.packet_of(frame) in _SIMPLE and len(frame.data) >= 4:
            self._note_first(frame, now_s)
            command = _SIMPLE[Packet(vesc_can_codec.packet_of(frame))]
            self.firmware.handle(bytes((command,)) + frame.data, now_s)
        elif vesc_can_codec.packet_of(frame) == Packet.PING and frame.data:
            self._note_first(frame, now_s)
            self._send(bus, vesc_can_codec.pong(frame.data[0], own_id))
        elif (packet := self._reassembler.feed(frame)) is not None:
            self._note_first(frame, now_s)
            reply = self.firmware.handle(packet.payload, now_s)
            if reply is not None and packet.send == ReplyMode.REPLY_TO_SENDER:
                for answer in vesc_can_codec.encode_payload(packet.sender_id, own_id, reply, ReplyMode.IS_REPLY):
                    self._send(bus, answer)

    def _note_first(self, frame: CanFrame, now_s: float) -> None:
        if not self._has_received:
            self._has_received = True
            self.log.add(now_s, "first_byte", float(vesc_can_codec.packet_of(frame)))

    def _send(self, bus: can.BusABC, frame: CanFrame) -> None:
        data = self.faults.transmit(frame.data)
        if not self.faults.drops_replies and data == frame.data:
            bus.send(can.Message(arbitration_id=frame.identifier, data=frame.data, is_extended_id=True))
