"""A serial port as a byte link (pyserial)."""

from __future__ import annotations

import errno
import fcntl
import os
import select
import termios
import time
from typing import Final

import serial
from serial.tools import list_ports

from carlab.core.errors import ActuatorFaultError, NotReadyError

WRITE_TIMEOUT_S: Final = 0.04
DRAIN_S: Final = 0.02
BACKLOG_LIMIT_BYTES: Final = 96
"""A larger backlog means that the device has stopped reading (about two ticks of commands)."""
BACKLOG_S: Final = 0.005
"""Longest duration of a backlog [s]; a longer backlog is discarded.

Linux (cdc-acm) counts a whole buffer of 1280 bytes for each write to a USB device until it is transferred, which takes
about a millisecond. Flushing the buffer cancels the transfer.
"""
PSEUDO_TERMINAL_MAJORS: Final = range(136, 144)
"""Major device numbers of pseudo-terminals on Linux, the ports of emulated devices."""


def serial_ports() -> list[str]:
    """Available serial ports, each with its description."""
    return sorted(
        port.device if port.description in ("n/a", "", None) else f"{port.device} ({port.description})"
        for port in list_ports.comports()
    )


class SerialLink:
    """A serial port opened exclusively, with non-blocking reads and a time-out on writes.

    ``setting`` is the name of the port in ``[hardware.actuator]``, for messages.
    """

    def __init__(self, port: str, baud: int = 115200, *, setting: str = "port") -> None:
        self.port = port
        self.baud = baud
        self.setting = setting
        self.opens = 0
        self._serial: serial.Serial | None = None
        self._last_empty_s = 0.0

    def open(self) -> None:
        """Open the port. Raises NotReadyError with a list of the available ports."""
        if self._serial is not None:
            return
        try:
            port = serial.Serial(self.port, self.baud, timeout=0, exclusive=True)
            _exclude_other_programs(port.fileno())
        except (OSError, ValueError, OverflowError, termios.error) as error:  # SerialException is an OSError
            raise NotReadyError(f"Serial port {self.port} cannot be opened", (self._reason(error),)) from error
        self._serial = port
        self._last_empty_s = time.monotonic()
        self.opens += 1

    def write(self, data: bytes) -> None:
        """Write all of ``data``. Raises ActuatorFaultError on a time-out or a lost port.

        If the device has stopped reading, the unsent bytes are discarded, since they hold old commands.
        """
        port = self._opened()
        try:
            self._discard_backlog(port)
            is_written = _write_all(port.fileno(), data)
            if not is_written:
                port.reset_output_buffer()
        except (OSError, termios.error) as error:
            raise self._lost(error) from error
        if not is_written:
            raise ActuatorFaultError(
                f"{self.port} accepts no more bytes; check that the device is powered, then reset the fault."
            )

    def read(self) -> bytes:
        """Bytes that have arrived. Raises ActuatorFaultError if the port was removed."""
        port = self._opened()
        try:
            waiting = port.in_waiting
            data: bytes = port.read(waiting) if waiting else b""
        except (OSError, termios.error, TypeError) as error:
            raise self._lost(error) from error
        return data

    def fileno(self) -> int | None:
        """File descriptor of the open port; None while it is closed."""
        return None if self._serial is None else self._serial.fileno()

    def close(self) -> None:
        """Close the port and discard unsent bytes; otherwise the kernel waits for a device that does not read."""
        port, self._serial = self._serial, None
        if port is None:
            return
        try:
            if port.out_waiting:
                time.sleep(DRAIN_S)
            if port.out_waiting:
                port.reset_output_buffer()
        except (OSError, termios.error):
            return  # the port was removed, with its bytes
        finally:
            port.close()

    def _discard_backlog(self, port: serial.Serial) -> None:
        """Discard the unsent bytes if the backlog lasts longer than ``BACKLOG_S``."""
        now_s = time.monotonic()
        if port.out_waiting > BACKLOG_LIMIT_BYTES:
            if now_s - self._last_empty_s <= BACKLOG_S:
                return
            port.reset_output_buffer()
        self._last_empty_s = now_s

    def _opened(self) -> serial.Serial:
        if self._serial is None:
            raise ActuatorFaultError(f"{self.port} is not open; open the car first.")
        return self._serial

    def _lost(self, error: BaseException) -> ActuatorFaultError:
        return ActuatorFaultError(f"{self.port} was lost ({error}); check cable and power, then reset the fault.")

    def _reason(self, error: BaseException) -> str:
        if not os.path.exists(self.port):
            found = serial_ports()
            there = f"the available ports are {', '.join(found)}" if found else "there is no serial port"
            return f"it does not exist; {there}. Plug the device in and set '{self.setting}' in [hardware.actuator]."
        if (isinstance(error, OSError) and error.errno == errno.EACCES) or "Permission" in str(error):
            return "permission is denied; add yourself to its group (often 'dialout') and log in again."
        if "exclusively lock" in str(error) or getattr(error, "errno", 0) in (errno.EAGAIN, errno.EBUSY):
            return "another program uses it; close that program."
        return f"{error}. Check that '{self.setting}' in [hardware.actuator] names the device."


def _write_all(fd: int, data: bytes) -> bool:
    """Write ``data``; False if the port stays full for ``WRITE_TIMEOUT_S``.

    ``Serial.write`` also times out if this process was suspended although the port took every byte.
    """
    while data:
        try:
            data = data[os.write(fd, data) :]
        except BlockingIOError:
            if not select.select([], [fd], [], WRITE_TIMEOUT_S)[1]:
                return False
    return True


def _exclude_other_programs(descriptor: int) -> None:
    """Let no other program open the port, also one that ignores the lock of pyserial, such as VESC Tool.

    A pseudo-terminal would refuse every program for ever if this process were killed, so it is left out.
    """
    if os.major(os.fstat(descriptor).st_rdev) not in PSEUDO_TERMINAL_MAJORS:
        fcntl.ioctl(descriptor, termios.TIOCEXCL)
