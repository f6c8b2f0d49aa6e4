"""Sizes of messages on serial lines and CAN buses, for the check whether a line carries them. Pure."""

from __future__ import annotations

from carlab.core.errors import ConfigError

BITS_PER_BYTE = 10
"""Bits of a byte on a serial line: start bit, eight data bits, stop bit."""
SLCAN_BAUD = 115200
"""Default speed of the serial line of an slcan adapter."""


def can_frame_bits(data_bytes: int) -> int:
    """Bits of a CAN frame with a 29-bit identifier and the pause after it, with as many stuff bits as possible.

    Davis, Burns, Bril, Lukkien: Controller Area Network (CAN) schedulability analysis, Real-Time Systems 35, 2007.
    """
    return 80 + 10 * data_bytes


def slcan_line_bytes(data_bytes: int) -> int:
    """Bytes of the line of an slcan adapter for such a frame: ``T``, identifier, length, data in hexadecimal, end."""
    return 11 + 2 * data_bytes


def slcan_port(channel: str) -> tuple[str, int]:
    """Serial port and baud of the channel of an slcan adapter, PORT or PORT@BAUD. Raises ConfigError."""
    port, at, baud = channel.partition("@")
    if not at:
        return port, SLCAN_BAUD
    if not (port and baud.isascii() and baud.isdecimal() and int(baud)):
        raise ConfigError(
            f"channel in [hardware.actuator] is '{channel}'; an slcan adapter has its port, PORT or PORT@BAUD such as "
            "/dev/ttyUSB0@1000000."
        )
    return port, int(baud)
