"""A CAN bus behind a serial adapter with the slcan protocol (Lawicel, CANable ...), as a frame link.

python-can's ``slcan`` waits without limit for an adapter that does not read, and raises errors for a line that is no
frame: noise, or the rest of a line when the port is opened.
"""

from __future__ import annotations

import contextlib
import re
import time
from typing import Final

from carlab.core.errors import ActuatorFaultError, NotReadyError
from drivers.links.lines import slcan_port
from drivers.links.link import CanFrame
from drivers.links.serial_link import SerialLink

BOOT_S: Final = 2.0
"""Time for which an adapter may start after its port was opened: opening resets an Arduino [s]."""
BITRATE_COMMANDS: Final = {
    10_000: "S0", 20_000: "S1", 50_000: "S2", 100_000: "S3", 125_000: "S4", 250_000: "S5", 500_000: "S6",
    750_000: "S7", 1_000_000: "S8",
}  # fmt: skip
MAX_LINE_BYTES: Final = 64
"""More bytes without an end of line are noise; a frame has at most 31."""

_LINE_END = re.compile(rb"[\r\a]")
_EXTENDED_FRAME = re.compile(rb"T([0-9A-F]{8})([0-8])((?:[0-9A-F]{2})*)", re.IGNORECASE)
_TIME_STAMP_DIGITS = 4


class SlcanLink:
    """Frame link to an slcan adapter; ``channel`` is its serial port, PORT or PORT@BAUD.

    The port is opened exclusively. Lines that are no data frame with a 29-bit identifier are ignored.
    """

    def __init__(self, channel: str, bitrate: int = 500_000) -> None:
        self.channel = channel
        self.bitrate = bitrate
        self._serial = SerialLink(*slcan_port(channel), setting="channel")
        self._received = b""

    def open(self) -> None:
        """Open the port and join the bus. Raises NotReadyError with the remedy."""
        if self._serial.fileno() is not None:
            return
        if self.bitrate not in BITRATE_COMMANDS:
            known = ", ".join(map(str, BITRATE_COMMANDS))
            raise NotReadyError(
                f"CAN bus slcan {self.channel} cannot be opened",
                (f"the bitrate {self.bitrate} is not one of {known}; set 'bitrate' in [hardware.actuator].",),
            )
        self._serial.open()
        self._received = b""
        try:
            time.sleep(BOOT_S)
            self._serial.write(f"\rC\r{BITRATE_COMMANDS[self.bitrate]}\rO\r".encode())
        except ActuatorFaultError as error:
            self._serial.close()
            raise NotReadyError(f"CAN bus slcan {self.channel} cannot be opened", (str(error),)) from error

    @property
    def opens(self) -> int:
        """Number of openings since construction."""
        return self._serial.opens

    def write(self, frame: CanFrame) -> None:
        """Send a data frame with a 29-bit identifier. Raises ActuatorFaultError if the adapter does not take it."""
        line = f"T{frame.identifier:08X}{len(frame.data)}{frame.data.hex().upper()}\r"
        self._serial.write(line.encode())

    def read(self) -> list[CanFrame]:
        """Frames that have arrived. Raises ActuatorFaultError if the adapter was removed."""
        *lines, rest = _LINE_END.split(self._received + self._serial.read())
        self._received = rest[-MAX_LINE_BYTES:]
        return [frame for line in lines if (frame := decode_line(line)) is not None]

    def fileno(self) -> int | None:
        """File descriptor of the open port; None while it is closed."""
        return self._serial.fileno()

    def close(self) -> None:
        """Leave the bus and close the port."""
        with contextlib.suppress(ActuatorFaultError):  # not open, or the adapter was removed
            self._serial.write(b"C\r")
        self._serial.close()


def decode_line(line: bytes) -> CanFrame | None:
    """Decode a line of an adapter; None if it is no data frame with a 29-bit identifier."""
    match = _EXTENDED_FRAME.fullmatch(line)
    if match is None:
        return None
    identifier, digits = int(match[1], 16), 2 * int(match[2])
    if identifier >> 29 or len(match[3]) not in (digits, digits + _TIME_STAMP_DIGITS):
        return None
    return CanFrame(identifier, bytes.fromhex(match[3][:digits].decode()))
