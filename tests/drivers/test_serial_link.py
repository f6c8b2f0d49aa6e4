"""Exclusive access to a serial port, also for programs that ignore the lock of pyserial."""

from __future__ import annotations

import errno
import os
import subprocess
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
