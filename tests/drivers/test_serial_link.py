"""The serial link: exclusive access, also to programs that ignore the lock of pyserial, and backlogs."""

from __future__ import annotations

import errno
import fcntl
import os
import subprocess
import termios
import time
from collections.abc import Iterator
from typing import Any

import pytest
import serial

from carlab.core.errors import NotReadyError
from drivers.emulators.command_log import CommandLog
from drivers.emulators.serial_firmware import SerialFirmware
from drivers.emulators.vesc_firmware import VescFirmware
from drivers.links import serial_link
from drivers.links.serial_link import SerialLink

NOBODY = 65534
ACM_WRITE_BUFFER_BYTES = 1280
"""Size of a write buffer of Linux's cdc-acm: 20 packets of 64 bytes (USB full speed)."""


def can_another_program_open(port: str) -> bool:
    """Whether a program without privileges can open the port."""
    os.chmod(port, 0o666)
    user = NOBODY if os.getuid() == 0 else None
    command = ["sh", "-c", 'exec 3<>"$0"', port]
    return subprocess.run(command, user=user, stderr=subprocess.DEVNULL, check=False).returncode == 0


def test_open_port_refuses_other_programs(monkeypatch: pytest.MonkeyPatch) -> None:
    with SerialFirmware(VescFirmware(CommandLog())) as firmware:
        link = SerialLink(firmware.port)
        link.open()
        assert can_another_program_open(firmware.port), "a pseudo-terminal stays open to other programs"
        link.close()
        monkeypatch.setattr(serial_link, "PSEUDO_TERMINAL_MAJORS", range(0))
        link.open()
        assert not can_another_program_open(firmware.port)
        link.close()


def test_port_that_another_program_holds_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    def busy(*arguments: Any, **options: Any) -> None:
        raise serial.SerialException(errno.EBUSY, "could not open port: Device or resource busy")

    monkeypatch.setattr(serial, "Serial", busy)
    with pytest.raises(NotReadyError, match="another program uses it; close that program"):
        SerialLink("/dev/null").open()


@pytest.mark.parametrize("baud", [2**31, 10**30])
def test_baud_that_no_port_has_is_refused(baud: int) -> None:
    with SerialFirmware(VescFirmware(CommandLog())) as firmware, pytest.raises(NotReadyError, match="cannot be opened"):
        SerialLink(firmware.port, baud).open()


@pytest.fixture
def usb_device(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """Descriptor at which a USB device reads; the queue of its port is that of Linux.

    drivers/usb/class/cdc-acm.c: ``acm_tty_chars_in_buffer`` counts a whole buffer for a write that is not transferred,
    ``acm_tty_flush_buffer`` cancels its transfer. Here a write is transferred when the device reads it.
    """
    device, host = os.pipe()

    class AcmPort:
        def __init__(self, *arguments: Any, **options: Any) -> None:
            """Opening has no effect."""

        def fileno(self) -> int:
            return host

        @property
        def out_waiting(self) -> int:
            waiting = int.from_bytes(fcntl.ioctl(device, termios.FIONREAD, bytes(4)), "little")
            return ACM_WRITE_BUFFER_BYTES if waiting else 0

        def reset_output_buffer(self) -> None:
            os.read(device, 4096)

        def close(self) -> None:
            """Closing has no effect."""

    monkeypatch.setattr(serial, "Serial", AcmPort)
    monkeypatch.setattr(serial_link, "PSEUDO_TERMINAL_MAJORS", range(1))  # the pipe is no terminal
    yield device
    os.close(device)
    os.close(host)


@pytest.mark.realtime
def test_second_write_to_a_usb_device_does_not_cancel_the_first(usb_device: int) -> None:
    """In a tick the sender writes a command and, at once, a request of telemetry."""
    link = SerialLink("/dev/ttyACM0")
    link.open()
    for _ in range(3):
        link.write(b"command")
        link.write(b"request")
        assert os.read(usb_device, 4096) == b"commandrequest"
        time.sleep(0.01)
    link.close()


@pytest.mark.realtime
def test_old_bytes_never_reach_a_device_that_has_stopped_reading(usb_device: int) -> None:
    link = SerialLink("/dev/ttyACM0")
    link.open()
    for number in range(5):
        link.write(b"command%d" % number)
        link.write(b"request%d" % number)
        time.sleep(0.01)
    assert os.read(usb_device, 4096) == b"command4request4"
    link.close()
