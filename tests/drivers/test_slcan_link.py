"""A CAN bus behind a serial adapter: driving, noise, an adapter that hangs or is removed."""

from __future__ import annotations

import fcntl
import os
import time
import tty
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from patient_config import patient_config
from slcan_adapter import SlcanAdapter

from carlab.core.errors import ActuatorFaultError, NotReadyError
from carlab.core.quantities import Action
from drivers.actuator import SILENT_SENDER_S, Actuator
from drivers.calibration import ActuatorCalibration
from drivers.config import ActuatorConfig
from drivers.emulators.can_firmware import CanFirmware
from drivers.emulators.command_log import CommandLog
from drivers.emulators.vesc_firmware import VescFirmware
from drivers.links import slcan_link
from drivers.links.link import CanFrame
from drivers.links.slcan_link import SlcanLink, decode_line
from drivers.sender.logic import SenderState
from drivers.sender.loop import RECONNECT_PERIODS_S
from tests.helpers.pauses import RunningTime
from tests.helpers.waiting import until

pytestmark = pytest.mark.realtime

MOVING = Action(0.5, 0.3)


def config_for(adapter: SlcanAdapter, **changes: Any) -> ActuatorConfig:
    return patient_config(kind="vesc_can", interface="slcan", channel=adapter.port, **changes)


@pytest.fixture
def channel() -> str:
    return f"test-{uuid.uuid4()}"


@pytest.fixture
def adapter(channel: str) -> Iterator[SlcanAdapter]:
    with SlcanAdapter(channel) as served:
        yield served


@pytest.fixture
def firmware(channel: str) -> Iterator[CanFirmware]:
    with CanFirmware(VescFirmware(CommandLog(), motor_timeout_s=0.4), "virtual", channel) as served:
        yield served


def test_drive_survives_noise_and_ends_in_neutral(adapter: SlcanAdapter, firmware: CanFirmware) -> None:
    with Actuator(config_for(adapter), ActuatorCalibration()) as actuator:
        assert adapter.lines[:4] == [b"", b"C", b"S6", b"O"]
        actuator.arm()
        actuator.command(MOVING)
        until(lambda: any(e.value == 3.0 for e in firmware.log.motor()))
        for noise in (b"D0123\r", b"t12\r", b"\xff\xfe\r", b"T000009179\r", b"\a", b"x" * 100):
            adapter.send(noise)
        t_noise_s = time.monotonic()
        until(lambda: actuator.status().t_telemetry_s > t_noise_s + 0.1)
        assert actuator.status().state == SenderState.ARMED
        actuator.stop(planned=True)
    until(lambda: adapter.lines[-1] == b"C")
    assert firmware.log.motor()[-1].value == 0.0


def test_removed_adapter_latches_a_fault(adapter: SlcanAdapter, firmware: CanFirmware) -> None:
    with Actuator(config_for(adapter), ActuatorCalibration()) as actuator:
        actuator.arm()
        actuator.command(MOVING)
        until(lambda: any(e.value == 3.0 for e in firmware.log.motor()))
        adapter.unplug()
        until(lambda: actuator.status().state == SenderState.FAULT)
        assert "was lost" in actuator.status().fault
        assert not actuator.status().is_ended


def test_adapter_that_is_plugged_in_again_gets_neutral(tmp_path: Path, channel: str, firmware: CanFirmware) -> None:
    """While the adapter starts, the sender answers: it refuses to reset the fault with the reason of the fault."""
    with (
        SlcanAdapter(channel, tmp_path / "adapter") as adapter,
        Actuator(config_for(adapter), ActuatorCalibration()) as actuator,
    ):
        actuator.arm()
        actuator.command(MOVING)
        until(lambda: any(e.value == 3.0 for e in firmware.log.motor()))
        adapter.unplug()
        until(lambda: actuator.status().state == SenderState.FAULT)
        adapter.plug()
        t_plugged_s = time.monotonic()
        until(lambda: is_open_in_another_process(adapter.port))
        time.sleep(SILENT_SENDER_S + 0.1)
        with pytest.raises(ActuatorFaultError, match="was lost"):
            actuator.reset_fault()
        until(lambda: len(firmware.log.motor(t_plugged_s)) > 10)
        commands = firmware.log.motor(t_plugged_s)
        assert all(e.value == 0.0 for e in commands)
        assert commands[0].t_s - t_plugged_s < max(RECONNECT_PERIODS_S) + slcan_link.BOOT_S + 1.0
        until(lambda: actuator.status().t_telemetry_s > t_plugged_s)
        actuator.reset_fault()
        actuator.arm()


def test_close_does_not_wait_for_an_adapter_that_starts(tmp_path: Path, channel: str, firmware: CanFirmware) -> None:
    with SlcanAdapter(channel, tmp_path / "adapter") as adapter:
        actuator = Actuator(config_for(adapter), ActuatorCalibration())
        actuator.open()
        adapter.unplug()
        until(lambda: actuator.status().state == SenderState.FAULT)
        adapter.plug()
        until(lambda: is_open_in_another_process(adapter.port))
        with RunningTime() as running:
            actuator.close()
        assert running.seconds < 0.5 * slcan_link.BOOT_S


def is_open_in_another_process(port: str) -> bool:
    """Whether another process has the port locked."""
    descriptor = os.open(port, os.O_RDWR | os.O_NOCTTY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(descriptor)
    return False


def test_adapter_that_does_not_read_is_a_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its buffer fills up; unsent commands are discarded."""
    monkeypatch.setattr(slcan_link, "BOOT_S", 0.0)
    master, terminal = os.openpty()
    tty.setraw(terminal)
    link = SlcanLink(os.ttyname(terminal))
    link.open()

    def write_until_full() -> None:
        for _ in range(10_000):
            link.write(CanFrame(0x117, bytes(4)))

    with pytest.raises(ActuatorFaultError, match="accepts no more bytes"):
        write_until_full()
    link.close()
    os.close(master)
    os.close(terminal)


def test_port_in_use_and_unknown_bitrate_are_refused(monkeypatch: pytest.MonkeyPatch, adapter: SlcanAdapter) -> None:
    monkeypatch.setattr(slcan_link, "BOOT_S", 0.0)
    link = SlcanLink(adapter.port)
    link.open()
    with pytest.raises(NotReadyError, match="another program uses it"):
        SlcanLink(adapter.port).open()
    link.close()
    with pytest.raises(NotReadyError, match="bitrate 33333 is not one of"):
        SlcanLink(adapter.port, 33_333).open()
    with pytest.raises(NotReadyError, match="set 'channel'"):
        SlcanLink("/dev/does_not_exist").open()


@pytest.mark.parametrize(
    ("line", "frame"),
    [
        (b"T00000901200ff", CanFrame(0x901, b"\x00\xff")),
        (b"T00000901200FF1234", CanFrame(0x901, b"\x00\xff")),  # with a time stamp
        (b"T1FFFFFFF0", CanFrame(0x1FFFFFFF, b"")),
        (b"T3FFFFFFF0", None),
        (b"T000009012FF", None),
        (b"t90120000", None),
        (b"", None),
    ],
)
def test_lines_are_decoded(line: bytes, frame: CanFrame | None) -> None:
    assert decode_line(line) == frame


@given(st.binary(max_size=40))
def test_random_lines_are_decoded_or_ignored(line: bytes) -> None:
    decode_line(line)
    decode_line(b"T" + line)
