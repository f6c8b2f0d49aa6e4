"""VESC over CAN: encode commands to frames, decode frames to telemetry and payloads. Pure functions.

Functions that return a frame raise ProtocolError for a number that does not fit, is not finite, or is no controller id.

Facts (vedderb/bldc comm/comm_can.c, documentation/comm_can.md): 29-bit identifiers, ``(packet << 8) | controller``;
messages of fixed layout are in ``dbc/vesc.dbc``; every other command goes through a small transport: up to 6 bytes in
one PROCESS_SHORT_BUFFER, more in FILL_RX_BUFFER pieces and a PROCESS_RX_BUFFER with length and CRC-16/XMODEM.
"""

from __future__ import annotations

import enum
import functools
import importlib.resources
import math
import struct
from dataclasses import dataclass, field, fields
from typing import Any, cast

import cantools

from carlab.core.errors import ProtocolError
from drivers.links.link import CanFrame
from drivers.vesc import payloads as vesc_payloads
from drivers.vesc.payloads import MotorValues
from drivers.vesc.serial_codec import MAX_PAYLOAD, crc16

BROADCAST_ID = 255
CONTROLLER_MASK = 0xFF
MESSAGE_MASK = 0x1FFFFF00


class Packet(enum.IntEnum):
    """Packet numbers, bits 8 and up of the identifier."""

    SET_DUTY = 0
    SET_CURRENT = 1
    SET_CURRENT_BRAKE = 2
    SET_RPM = 3
    FILL_RX_BUFFER = 5
    FILL_RX_BUFFER_LONG = 6
    PROCESS_RX_BUFFER = 7
    PROCESS_SHORT_BUFFER = 8
    STATUS_1 = 9
    STATUS_2 = 14
    STATUS_3 = 15
    STATUS_4 = 16
    PING = 17
    PONG = 18
    STATUS_5 = 27
    STATUS_6 = 58


STATUS_PACKETS = frozenset(p for p in Packet if p.name.startswith("STATUS"))
MOTOR_PACKETS = frozenset((0, 1, 2, 3, 4, 10, 11, 12, 13))
"""Every packet that commands the motor: duty, current, brake current, speed, position, and relative ones."""


class ReplyMode(enum.IntEnum):
    """How the receiver of a transported payload replies."""

    REPLY_TO_SENDER = 0
    IS_REPLY = 1
    NO_REPLY = 2


def packet_of(frame: CanFrame) -> int:
    """Packet number of a frame."""
    return frame.identifier >> 8


def controller_of(frame: CanFrame) -> int:
    """Id of the addressed controller, or of the sender of a status."""
    return frame.identifier & CONTROLLER_MASK


@functools.cache
def database() -> cantools.database.Database:
    """The messages of ``dbc/vesc.dbc``, by identifier without the controller id."""
    text = importlib.resources.files("drivers").joinpath("dbc/vesc.dbc").read_text(encoding="utf-8")
    loaded = cantools.database.load_string(text, "dbc", frame_id_mask=MESSAGE_MASK)
    return cast("cantools.database.Database", loaded)


def _identifier(packet: int, controller_id: int) -> int:
    if not 0 <= controller_id <= BROADCAST_ID:
        raise ProtocolError(f"controller id {controller_id} is outside 0 ... 255.")
    return packet << 8 | controller_id


def _simple(packet: Packet, controller_id: int, signal: str, value: float) -> CanFrame:
    if not math.isfinite(value):
        raise ProtocolError(f"{signal} is {value}; it must be a finite number.")
    message = database().get_message_by_name(f"VESC_{packet.name}")
    try:
        data = message.encode({signal: value})
    except (cantools.database.EncodeError, OverflowError) as error:
        raise ProtocolError(f"{signal} {value:g} cannot be sent: {error}") from error
    return CanFrame(_identifier(packet, controller_id), bytes(data))


def set_duty(controller_id: int, duty: float) -> CanFrame:
    """Frame that sets the duty cycle in [-1, 1]."""
    return _simple(Packet.SET_DUTY, controller_id, "duty", duty)


def set_current(controller_id: int, current_a: float) -> CanFrame:
    """Frame that sets the motor current [A]; four bytes of data."""
    return _simple(Packet.SET_CURRENT, controller_id, "current_a", current_a)


def set_current_brake(controller_id: int, current_a: float) -> CanFrame:
    """Frame that sets the brake current [A]."""
    return _simple(Packet.SET_CURRENT_BRAKE, controller_id, "current_a", current_a)


def set_servo_position(controller_id: int, host_id: int, position: float) -> CanFrame:
    """Frame that sets the servo position in [0, 1], as a short buffer without reply (there is no simple message)."""
    (frame,) = encode_payload(controller_id, host_id, vesc_payloads.set_servo_position(position), ReplyMode.NO_REPLY)
    return frame


def pong(host_id: int, controller_id: int) -> CanFrame:
    """A motor controller's answer to PING: its id and hardware type 0."""
    return CanFrame(_identifier(Packet.PONG, host_id), bytes((controller_id, 0)))


def encode_payload(receiver_id: int, sender_id: int, payload: bytes, send: ReplyMode) -> list[CanFrame]:
    """Transport a payload of 1 to 512 bytes from ``sender_id`` to ``receiver_id``.

    Raises ProtocolError for another length or id.
    """
    if not 1 <= len(payload) <= MAX_PAYLOAD:
        raise ProtocolError(f"A payload has 1 to {MAX_PAYLOAD} bytes, not {len(payload)}.")
    if len(payload) <= 6:
        data = bytes((sender_id, send)) + payload
        return [CanFrame(_identifier(Packet.PROCESS_SHORT_BUFFER, receiver_id), data)]
    frames = []
    offset = 0
    while offset < len(payload) and offset <= 255:
        piece = bytes((offset,)) + payload[offset : offset + 7]
        frames.append(CanFrame(_identifier(Packet.FILL_RX_BUFFER, receiver_id), piece))
        offset += 7
    while offset < len(payload):
        piece = offset.to_bytes(2, "big") + payload[offset : offset + 6]
        frames.append(CanFrame(_identifier(Packet.FILL_RX_BUFFER_LONG, receiver_id), piece))
        offset += 6
    end = struct.pack(">BBHH", sender_id, send, len(payload), crc16(payload))
    frames.append(CanFrame(_identifier(Packet.PROCESS_RX_BUFFER, receiver_id), end))
    return frames


@dataclass(frozen=True, slots=True)
class TransportedPayload:
    """A transported payload with its sender and reply mode."""

    sender_id: int
    send: int
    payload: bytes


@dataclass(slots=True)
class CanReassembler:
    """Reassembles transport frames addressed to ``own_id``; ``errors`` counts dropped packets."""

    own_id: int
    errors: int = 0
    _buffer: bytearray = field(default_factory=lambda: bytearray(MAX_PAYLOAD))
    _filled: int = 0

    def feed(self, frame: CanFrame) -> TransportedPayload | None:
        """Add a frame; returns the payload if the frame completes one. Frames for other ids are ignored."""
        if controller_of(frame) != self.own_id:
            return None
        if packet_of(frame) == Packet.PROCESS_SHORT_BUFFER:
            if len(frame.data) < 3:
                self.errors += 1
                return None
            return TransportedPayload(frame.data[0], frame.data[1], frame.data[2:])
        if packet_of(frame) == Packet.FILL_RX_BUFFER and len(frame.data) >= 2:
            self._fill(frame.data[0], frame.data[1:])
        elif packet_of(frame) == Packet.FILL_RX_BUFFER_LONG and len(frame.data) >= 3:
            self._fill(int.from_bytes(frame.data[:2], "big"), frame.data[2:])
        elif packet_of(frame) == Packet.PROCESS_RX_BUFFER:
            return self._finish(frame.data)
        return None

    def _fill(self, offset: int, piece: bytes) -> None:
        if offset == 0:
            self._filled = 0
        if offset != self._filled or offset + len(piece) > MAX_PAYLOAD:
            self._filled = -1  # a piece is missing: later pieces are rejected until the next packet starts
            return
        self._buffer[offset : offset + len(piece)] = piece
        self._filled = offset + len(piece)

    def _finish(self, data: bytes) -> TransportedPayload | None:
        filled, self._filled = self._filled, 0
        if len(data) < 6:
            self.errors += 1
            return None
        sender_id, send, length, crc = struct.unpack_from(">BBHH", data)
        payload = bytes(self._buffer[:length])
        if length != filled or crc16(payload) != crc:
            self.errors += 1
            return None
        return TransportedPayload(sender_id, send, payload)


_VALUE_NAMES = frozenset(f.name for f in fields(MotorValues))


def decode_status(frame: CanFrame) -> MotorValues | None:
    """Decode a STATUS_1 ... 6 broadcast; None for other frames (STATUS_6 has inputs only: no field is set).

    Raises ProtocolError for a status of the wrong length.
    """
    if packet_of(frame) not in STATUS_PACKETS:
        return None
    message = database().get_message_by_frame_id(frame.identifier)
    if len(frame.data) < message.length:
        raise ProtocolError(f"{message.name} has {len(frame.data)} bytes, not {message.length}.")
    decoded = cast("dict[str, Any]", message.decode(frame.data[: message.length], decode_choices=False))
    return MotorValues(**{name: float(value) for name, value in decoded.items() if name in _VALUE_NAMES})  # type: ignore[arg-type]


def encode_status(packet: Packet, controller_id: int, values: MotorValues) -> CanFrame:
    """Encode a status broadcast as the firmware does; fields that are None become zero."""
    message = database().get_message_by_name(f"VESC_{packet.name}")
    signals = {s.name: getattr(values, s.name, None) or 0 for s in message.signals}
    data = bytes(message.encode(signals, strict=False)).ljust(8, b"\0")
    return CanFrame(_identifier(packet, controller_id), data)
