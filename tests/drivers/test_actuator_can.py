"""Actuator and emulated firmware over CAN: virtual bus within a process, UDP multicast between processes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
import uuid
from pathlib import Path
from typing import Any

import pytest
from cut_can_bus import CutLink, Wire
from faulty_frame_link import FaultyFrameLink
from patient_config import patient_config

from carlab.core.errors import ActuatorFaultError, NotReadyError
from carlab.core.quantities import Action
from drivers import actuator as actuator_module
from drivers.actuator import Actuator
from drivers.calibration import ActuatorCalibration
from drivers.config import ActuatorConfig
from drivers.emulators.can_firmware import CanFirmware
from drivers.emulators.command_log import CommandLog, read_log
from drivers.emulators.faults import WireFaults
from drivers.emulators.vesc_firmware import VescFirmware
from drivers.links.can_link import CanLink
from drivers.links.link import CanFrame
from drivers.sender.logic import SenderState
from drivers.sender.process import SenderThread
from drivers.vesc.can_device import VescCanDevice
from tests.helpers.waiting import TIMEOUT_S, until

pytestmark = pytest.mark.realtime

ROOT = Path(__file__).resolve().parents[2]
CALIBRATION = ActuatorCalibration(max_current_a=10.0)
MOVING = Action(0.5, 0.3)
FIRMWARE = """
import sys
from pathlib import Path
from drivers.emulators.can_firmware import CanFirmware
from drivers.emulators.command_log import CommandLog
from drivers.emulators.vesc_firmware import VescFirmware

with CanFirmware(VescFirmware(CommandLog(Path(sys.argv[2]))), channel=sys.argv[1]):
    print("open", flush=True)
    sys.stdin.buffer.read()
"""
CHILD = """
import sys, time
from carlab.core.quantities import Action
from drivers.actuator import Actuator
from drivers.calibration import ActuatorCalibration
from drivers.config import ActuatorConfig
config = ActuatorConfig(
    kind="vesc_can", interface="udp_multicast", channel=sys.argv[1],
    watchdog_s=2.0, latch_s=30.0, telemetry_stale_s=5.0, telemetry_lost_s=10.0,
)
with Actuator(config, ActuatorCalibration()) as actuator:
    actuator.arm()
    print(actuator._sender.pid, flush=True)
    while True:
        actuator.command(Action(0.5, 0.3))
        time.sleep(0.02)
"""


def config_for(interface: str, channel: str, **changes: Any) -> ActuatorConfig:
    return patient_config(kind="vesc_can", interface=interface, channel=channel, **changes)


def channel_name() -> str:
    return f"test-{uuid.uuid4()}"


def multicast_channel() -> str:
    """A separate port for each test, so that parallel runs do not receive each other's frames."""
    return f"239.74.163.2:{20000 + uuid.uuid4().int % 20000}"


@pytest.mark.parametrize("status_rate_hz", [0.0, 50.0])
@pytest.mark.parametrize("interface", ["virtual", "udp_multicast"])
def test_drive_reaches_the_firmware_and_ends_in_neutral(interface: str, status_rate_hz: float) -> None:
    channel = channel_name() if interface == "virtual" else multicast_channel()
    firmware = VescFirmware(CommandLog(), motor_timeout_s=0.4)
    with CanFirmware(firmware, interface, channel, status_rate_hz=status_rate_hz) as served:
        with Actuator(config_for(interface, channel), CALIBRATION) as actuator:
            actuator.arm()
            actuator.command(MOVING)
            until(lambda: any(e.value == 3.0 for e in served.log.motor()))
            until(lambda: any(e.value == 0.65 for e in served.log.entries("servo")))
            until(lambda: "battery_v" in actuator.health().readings)  # one of several status messages
            assert actuator.health().readings["battery_v"] == pytest.approx(11.1)
            t_s = time.monotonic()
            actuator.stop(planned=True)
        until(lambda: len([e for e in served.log.motor(t_s) if e.value == 0.0]) >= 6)
        motor = served.log.motor()
        last_moving = max(e.t_s for e in motor if e.value)
        neutral = [e for e in motor if e.t_s > last_moving]
        assert {e.name for e in neutral} == {"current"}
        assert neutral[-1].t_s - neutral[0].t_s >= 0.02  # times of reception: a busy machine receives several at once
        assert served.log.entries("servo")[-1].value == 0.5
        assert served.log.wait_for("motor_timeout", TIMEOUT_S) is not None


def test_broadcasts_of_a_controller_that_does_not_answer_are_no_telemetry(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its receiver fails while it drives: it broadcasts its status, but obeys no command and answers no request."""
    channel = channel_name()
    firmware = VescFirmware(CommandLog(), motor_timeout_s=0.4)
    config = config_for("virtual", channel, telemetry_stale_s=0.5, telemetry_lost_s=1.0)
    served = CanFirmware(firmware, "virtual", channel, status_rate_hz=50.0)
    with served, Actuator(config, CALIBRATION) as actuator:
        actuator.arm()
        actuator.command(MOVING)
        until(lambda: bool(served.log.motor()))
        monkeypatch.setattr(served, "_handle_frame", lambda bus, frame, now_s: None)
        until(lambda: actuator.status().state == SenderState.FAULT)
        assert "the VESC stopped answering" in actuator.status().fault


@pytest.mark.parametrize("identifier", [0x117, 0x2FF])
def test_motor_command_of_another_sender_latches_a_fault(identifier: int) -> None:
    """Two senders would alternate; a broadcast commands each controller."""
    channel = channel_name()
    other = CanLink("virtual", channel)
    served = CanFirmware(VescFirmware(CommandLog()), "virtual", channel)
    with served, Actuator(config_for("virtual", channel), CALIBRATION) as actuator:
        actuator.arm()
        actuator.command(MOVING)
        until(lambda: any(e.value == 3.0 for e in served.log.motor()))
        other.open()
        other.write(CanFrame(0x118, bytes(4)))  # another controller
        other.write(CanFrame(identifier, bytes(4)))
        other.close()
        until(lambda: actuator.status().state == SenderState.FAULT)
        assert "another sender on the CAN bus commands controller 23" in actuator.status().fault
        until(lambda: actuator.status().t_telemetry_s > 0.0)
        actuator.reset_fault()
        actuator.arm()


def test_driving_continues_despite_lost_frames() -> None:
    channel = channel_name()
    faults = WireFaults(drop_share=0.1, corrupt_share=0.1, seed=1)
    config = config_for("virtual", channel, open_timeout_s=TIMEOUT_S)
    served = CanFirmware(VescFirmware(CommandLog()), "virtual", channel, faults=faults)
    with served, Actuator(config, CALIBRATION) as actuator:
        actuator.arm()
        actuator.command(MOVING)
        until(lambda: len(served.log.motor()) > 100)
        assert actuator.status().state == SenderState.ARMED
        assert {e.value for e in served.log.motor()} <= {0.0, 3.0}
        assert faults.dropped > 5


def test_missing_controller_and_missing_bus_are_not_ready() -> None:
    with pytest.raises(NotReadyError, match="no device answers; check power, termination"):
        Actuator(config_for("virtual", channel_name(), open_timeout_s=0.4), CALIBRATION).open()
    with pytest.raises(NotReadyError, match="ip link set nocan7 up"):
        Actuator(config_for("socketcan", "nocan7"), CALIBRATION).open()
    with pytest.raises(NotReadyError, match="interface"):
        Actuator(config_for("no_such_interface", "x"), CALIBRATION).open()


def test_ping_is_answered() -> None:
    channel = channel_name()
    with CanFirmware(VescFirmware(CommandLog()), "virtual", channel, status_rate_hz=0.0):
        link = CanLink("virtual", channel)
        link.open()
        link.write(CanFrame(0x1117, b"\x2a"))
        replies: list[CanFrame] = []
        until(lambda: bool(replies.extend(link.read()) or replies))
        assert replies == [CanFrame(0x122A, b"\x17\x00")]
        link.close()


def test_bus_failure_latches_a_fault_and_the_firmware_times_out() -> None:
    channel = channel_name()
    config = config_for("virtual", channel)
    link = FaultyFrameLink(CanLink("virtual", channel))
    with CanFirmware(VescFirmware(CommandLog(), motor_timeout_s=0.3), "virtual", channel) as served:
        device = VescCanDevice(link, 23, 42)
        with Actuator(config, CALIBRATION, lambda c, k: SenderThread(c, k, device)) as actuator:
            actuator.arm()
            actuator.command(MOVING)
            until(lambda: any(e.value == 3.0 for e in served.log.motor()))
            link.failure = "the bus is off"
            until(lambda: actuator.status().state == SenderState.FAULT)
            with pytest.raises(ActuatorFaultError, match="the bus is off"):
                actuator.command(MOVING)
            assert served.log.wait_for("motor_timeout", TIMEOUT_S) is not None
            link.failure = None
            t_s = time.monotonic()
            until(lambda: len(served.log.motor(t_s)) > 10)
            assert all(e.value == 0.0 for e in served.log.motor(t_s)), "after the reconnection only neutral is sent"
            with pytest.raises(ActuatorFaultError):
                actuator.arm()
            actuator.reset_fault()
            actuator.arm()


def test_bus_that_does_not_open_in_time_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    """For example an adapter in the network that does not answer."""
    link, may_open = CanLink("virtual", channel_name()), threading.Event()
    monkeypatch.setattr(link, "open", may_open.wait)
    monkeypatch.setattr(actuator_module, "START_TIMEOUT_S", 0.3)
    device = VescCanDevice(link, 23, 42)
    actuator = Actuator(config_for("virtual", "bus"), CALIBRATION, lambda c, k: SenderThread(c, k, device))
    started_s = time.monotonic()
    with pytest.raises(NotReadyError, match="controller 23 on virtual bus is not ready: it cannot be opened within"):
        actuator.open()
    assert time.monotonic() - started_s < 2.0
    may_open.set()


def test_cut_bus_that_returns_after_the_end_of_the_program_gets_neutral_last() -> None:
    """The kernel sends the frames that waited in the transmit queue; no program could follow them with neutral."""
    channel, wire = channel_name(), Wire()
    with CanFirmware(VescFirmware(CommandLog()), "virtual", channel) as served:
        device = VescCanDevice(CutLink(channel, wire), 23, 42)
        with Actuator(config_for("virtual", channel), CALIBRATION, lambda c, k: SenderThread(c, k, device)) as actuator:
            actuator.arm()
            actuator.command(MOVING)
            until(lambda: any(e.value == 3.0 for e in served.log.motor()))
            wire.is_cut = True
            until(lambda: actuator.status().state == SenderState.FAULT)
            assert "error-passive" in actuator.status().fault
        t_s = time.monotonic()
        wire.mend(channel)
        until(lambda: bool(served.log.motor(t_s)) and served.log.motor()[-1].value == 0.0)


@pytest.mark.parametrize("victim", ["main", "sender"])
def test_killed_process_ends_in_neutral_or_firmware_timeout(tmp_path: Path, victim: str) -> None:
    channel = multicast_channel()
    log = tmp_path / "log.jsonl"
    firmware = subprocess.Popen(
        [sys.executable, "-c", FIRMWARE, channel, str(log)],
        cwd=ROOT,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    main = None
    try:
        assert firmware.stdout is not None
        assert firmware.stdout.readline() == "open\n"
        main = subprocess.Popen(
            [sys.executable, "-c", CHILD, channel], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        assert main.stdout is not None
        assert main.stderr is not None
        line = main.stdout.readline()
        assert line, main.stderr.read()
        sender_pid = int(line)
        until(lambda: any(e.value == 3.0 for e in read_log(log)))
        os.kill(main.pid if victim == "main" else sender_pid, signal.SIGKILL)
        main.communicate(timeout=TIMEOUT_S)
        until(lambda: any(e.name == "motor_timeout" for e in read_log(log)))
    finally:
        if main is not None:
            main.kill()
            main.communicate()
        firmware.communicate(timeout=TIMEOUT_S)
    entries = read_log(log)
    motor = [e for e in entries if e.name in ("current", "brake", "duty", "rpm")]
    if victim == "main":
        neutral = [e for e in motor if e.t_s > max(m.t_s for m in motor if m.value)]
        assert len(neutral) >= 3
        assert neutral[-1].t_s - neutral[0].t_s >= 0.02  # times of reception: a busy machine receives several at once
        assert [e.value for e in entries if e.name == "servo"][-3:] == [0.5] * 3
    else:
        assert motor[-1].value == 3.0, "no process is left to send neutral: the firmware's time-out stops the motor"
