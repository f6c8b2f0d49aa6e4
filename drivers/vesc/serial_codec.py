"""VESC serial framing: encode payloads to bytes, decode a byte stream to payloads. Pure; time is an argument.

Frame (vedderb/bldc comm/packet.c): ``02 LEN payload CRC16 03`` for 1 to 255 bytes, ``03 LEN_HI LEN_LO payload CRC16
03`` for more, at most 512. The CRC is CRC-16/XMODEM over the payload, high byte first.
"""

from __future__ import annotations

import binascii
from collections import deque
from dataclasses import dataclass, field

from carlab.core.errors import ProtocolError

MAX_PAYLOAD = 512
SHORT_START, LONG_START, STOP = 0x02, 0x03, 0x03


def crc16(payload: bytes) -> int:
    """CRC-16/XMODEM: polynomial 0x1021, start 0, not reflected; 0x31C3 for ``123456789``."""
    return binascii.crc_hqx(payload, 0)


def encode_frame(payload: bytes) -> bytes:
    """Frame a payload of 1 to 512 bytes. Raises ProtocolError for other lengths."""
    if not 1 <= len(payload) <= MAX_PAYLOAD:
        raise ProtocolError(f"A payload has 1 to {MAX_PAYLOAD} bytes, not {len(payload)}.")
    if len(payload) <= 255:
        head = bytes((SHORT_START, len(payload)))
    else:
        head = bytes((LONG_START,)) + len(payload).to_bytes(2, "big")
    return head + payload + crc16(payload).to_bytes(2, "big") + bytes((STOP,))


@dataclass(slots=True)
class VescFrameDecoder:
    """Decoder from bytes to payloads, with one-byte resynchronisation like the firmware's decoder.

    If the buffer does not begin with a valid frame, one byte is dropped and the search continues at the next byte. A
    false start byte hides valid frames for at most its false length of up to 512 bytes, and for at most
    ``frame_timeout_s`` (None for no limit): a frame that is unfinished then is dropped in the same way, and valid
    frames inside it are decoded. The longest frame takes 45 ms at 115200 baud.
    """

    frame_timeout_s: float | None = 0.1
    crc_errors: int = 0
    garbage_bytes: int = 0
    _buffer: bytearray = field(default_factory=bytearray)
    _arrivals: deque[tuple[int, float]] = field(default_factory=deque)
    """For each chunk with bytes in the buffer: number of bytes received with it, and time [s]."""
    _received: int = 0

    def feed(self, data: bytes, t_s: float) -> list[bytes]:
        """Add bytes that arrived at ``t_s`` (any monotonic clock; may be empty) and return complete payloads."""
        payloads: list[bytes] = []
        while self._is_overdue(t_s):
            self._drop_byte()
            self._scan(payloads)
        if data:
            self._buffer += data
            self._received += len(data)
            self._arrivals.append((self._received, t_s))
            self._scan(payloads)
        return payloads

    def clear(self) -> None:
        """Drop an unfinished frame, after the link was opened again."""
        self._remove(len(self._buffer))

    def _is_overdue(self, t_s: float) -> bool:
        """Whether the first byte of the buffer has waited too long for the rest of its frame."""
        return (
            self.frame_timeout_s is not None
            and bool(self._arrivals)
            and t_s - self._arrivals[0][1] > self.frame_timeout_s
        )

    def _scan(self, payloads: list[bytes]) -> None:
        while self._buffer:
            span = self._frame_span()
            if span is None:
                return
            start, end = span
            if end == 0:
                self._drop_byte()
                continue
            payloads.append(bytes(self._buffer[start:end]))
            self._remove(end + 3)

    def _frame_span(self) -> tuple[int, int] | None:
        """Start and end of the payload of a frame at the front; (0, 0) if no frame starts there; None if incomplete."""
        buffer = self._buffer
        if buffer[0] == SHORT_START:
            start = 2
            length = buffer[1] if len(buffer) >= 2 else None
            is_valid = length != 0
        elif buffer[0] == LONG_START:
            start = 3
            length = int.from_bytes(buffer[1:3], "big") if len(buffer) >= 3 else None
            is_valid = length is None or 255 <= length <= MAX_PAYLOAD
        else:
            return 0, 0
        if not is_valid:
            return 0, 0
        if length is None or len(buffer) < start + length + 3:
            return None
        end = start + length
        if buffer[end + 2] != STOP:
            return 0, 0
        if crc16(bytes(buffer[start:end])) != int.from_bytes(buffer[end : end + 2], "big"):
            self.crc_errors += 1
            return 0, 0
        return start, end

    def _drop_byte(self) -> None:
        self._remove(1)
        self.garbage_bytes += 1

    def _remove(self, count: int) -> None:
        del self._buffer[:count]
        while self._arrivals and self._arrivals[0][0] <= self._received - len(self._buffer):
            self._arrivals.popleft()
