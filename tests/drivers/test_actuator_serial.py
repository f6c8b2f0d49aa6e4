"""Actuator, sender process and emulated firmware end to end over a pseudo-terminal."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from patient_config import patient_config

from carlab.core.errors import (
    ActionOutOfRangeError,
    ActuatorFaultError,
    NotArmedError,
    NotOpenError,
    NotReadyError,
)
from carlab.core.quantities import NEUTRAL, Action
from drivers.actuator import Actuator
from drivers.calibration import ActuatorCalibration
from drivers.config import ActuatorConfig
from drivers.emulators.command_log import CommandLog
from drivers.emulators.faults import WireFaults
from drivers.emulators.serial_firmware import SerialFirmware
from drivers.emulators.vesc_firmware import VescFirmware
from drivers.links.serial_link import WRITE_TIMEOUT_S, SerialLink
from drivers.sender.logic import SenderState
from drivers.vesc.payloads import FirmwareVersion, MotorValues, get_values, set_current
from drivers.vesc.serial_codec import encode_frame
from tests.helpers.pauses import RunningTime
from tests.helpers.waiting import TIMEOUT_S, until

pytestmark = pytest.mark.realtime

CALIBRATION = ActuatorCalibration(max_current_a=10.0)
MOVING = Action(0.5, 0.3)  # 3 A, servo 0.65


def config_for(firmware: SerialFirmware, **changes: object) -> ActuatorConfig:
    return patient_config(port=firmware.port, **changes)


@pytest.fixture
def actuator(serial_firmware: SerialFirmware) -> Iterator[Actuator]:
    with Actuator(config_for(serial_firmware), CALIBRATION) as opened:
        yield opened


def test_commands_arrive_as_returned_and_stop_ends_in_neutral(
    actuator: Actuator, serial_firmware: SerialFirmware
) -> None:
    log = serial_firmware.log
    actuator.arm()
    sent = actuator.command(MOVING)
    assert sent.steering == pytest.approx(0.5)
    assert sent.throttle == pytest.approx(0.3)
    until(lambda: any(e.value == 3.0 for e in log.motor()))
    until(lambda: any(e.value == 0.65 for e in log.entries("servo")))
    t_stop_s = time.monotonic()
    actuator.stop(planned=True)
    t_stopped_s = time.monotonic()
    after = [e for e in log.motor(t_stop_s) if e.t_s <= t_stopped_s]
    first_neutral = next(i for i, e in enumerate(after) if e.value == 0.0)
    neutral = after[first_neutral:]
    assert all((e.name, e.value) == ("current", 0.0) for e in neutral)
    assert len(neutral) >= 3
    assert neutral[-1].t_s - neutral[0].t_s >= 0.02  # times of reception: a busy machine receives several at once
    assert log.entries("servo")[-1].value == 0.5
    with pytest.raises(NotArmedError):
        actuator.command(MOVING)
    assert actuator.command(NEUTRAL) == NEUTRAL


def test_neutral_of_an_armed_car_brakes(serial_firmware: SerialFirmware) -> None:
    """The safety gate and a released dead-man control give neutral without disarming the car."""
    log = serial_firmware.log
    with Actuator(config_for(serial_firmware), replace(CALIBRATION, neutral_brake_a=2.5)) as actuator:
        actuator.arm()
        actuator.command(MOVING)
        until(lambda: any(e.value == 3.0 for e in log.motor()))
        t_released_s = time.monotonic()
        assert actuator.command(NEUTRAL) == NEUTRAL
        until(lambda: actuator.status().sent_number == 2)
        until(lambda: len(log.motor(t_released_s)) > 10)
        assert {(e.name, e.value) for e in log.motor(t_released_s)[5:]} == {("brake", 2.5)}


def test_command_is_written_before_the_next_deadline(serial_firmware: SerialFirmware) -> None:
    """At 10 Hz the next deadline is 50 ms away on average; a new command wakes the sender before it."""
    with Actuator(config_for(serial_firmware, rate_hz=10.0, telemetry_rate_hz=10.0), CALIBRATION) as actuator:
        actuator.arm()
        delays = []
        for k in range(1, 16):
            actuator.command(Action(0.0, 0.01 * k))
            until(lambda k=k: actuator.status().sent_number == k)  # type: ignore[misc]
            delays.append(actuator.status().t_written_s - actuator.status().t_issued_s)
            time.sleep(0.037)
        assert sorted(delays)[7] < 0.035


def test_send_rate_is_limited_for_frequent_commands(actuator: Actuator, serial_firmware: SerialFirmware) -> None:
    actuator.arm()
    t_start_s = time.monotonic()
    posted = 0
    while time.monotonic() < t_start_s + 0.5:
        actuator.command(Action(0.0, 0.1))
        posted += 1
    elapsed_s = time.monotonic() - t_start_s
    frames = len(serial_firmware.log.motor(t_start_s))
    assert posted > 1000
    assert frames <= 4.0 * 100.0 * elapsed_s + 5


def test_nan_command_is_never_sent(actuator: Actuator, serial_firmware: SerialFirmware) -> None:
    actuator.arm()
    for bad in (Action(float("nan"), 0.0), Action(0.0, float("inf")), Action(float("-inf"), float("nan"))):
        with pytest.raises(ActionOutOfRangeError):
            actuator.command(bad)
    assert actuator.command(Action(1e30, -1e30)) == Action(1.0, -1.0), "clamped"
    until(lambda: any(e.value == -10.0 for e in serial_firmware.log.motor()))
    assert all(abs(e.value) <= 10.0 for e in serial_firmware.log.motor())


def test_watchdog_fault_is_latched_until_reset_and_arm(serial_firmware: SerialFirmware) -> None:
    config = config_for(serial_firmware, watchdog_s=0.15, latch_s=0.5)
    with Actuator(config, CALIBRATION) as actuator:
        actuator.arm()
        until(lambda: actuator.status().state == SenderState.ARMED)
        actuator.command(MOVING)
        until(lambda: actuator.status().state == SenderState.FAULT)
        moving = [e.t_s for e in serial_firmware.log.motor() if e.value == 3.0]
        assert moving
        until(lambda: len(serial_firmware.log.motor(moving[-1])) > 3)
        after = [e for e in serial_firmware.log.motor() if e.t_s > moving[-1]]
        assert all(e.value == 0.0 for e in after)
        with pytest.raises(ActuatorFaultError, match=r"no command arrived for 0\.5 s"):
            actuator.command(MOVING)
        with pytest.raises(ActuatorFaultError):
            actuator.command(NEUTRAL)
        with pytest.raises(ActuatorFaultError):
            actuator.arm()
        assert not actuator.health().ready
        actuator.reset_fault()
        with pytest.raises(NotArmedError):
            actuator.command(MOVING)
        actuator.arm()
        actuator.command(MOVING)


def test_unplanned_stop_latches(actuator: Actuator) -> None:
    actuator.arm()
    actuator.stop(planned=False)
    with pytest.raises(ActuatorFaultError, match="stopped for safety"):
        actuator.arm()
    actuator.reset_fault()
    actuator.arm()


def test_firmware_fault_stops_and_persists(actuator: Actuator, serial_firmware: SerialFirmware) -> None:
    actuator.arm()
    actuator.command(MOVING)
    serial_firmware.firmware.fault_code = 2
    until(lambda: actuator.status().state == SenderState.FAULT)
    with pytest.raises(ActuatorFaultError, match="under-voltage"):
        actuator.command(MOVING)
    with pytest.raises(ActuatorFaultError, match="under-voltage"):
        actuator.reset_fault()
    serial_firmware.firmware.fault_code = 0
    until(lambda: actuator.status().fault_code == 0)
    actuator.reset_fault()


def test_missing_telemetry_gives_neutral_then_a_fault(serial_firmware: SerialFirmware) -> None:
    config = config_for(serial_firmware, telemetry_stale_s=0.25, telemetry_lost_s=1.6)
    with Actuator(config, CALIBRATION) as actuator:
        actuator.arm()
        until(lambda: not actuator.command(MOVING).is_neutral)
        serial_firmware.faults.drops_replies = True
        returned: list[tuple[float, bool]] = []
        while actuator.status().state == SenderState.ARMED:
            try:
                returned.append((time.monotonic(), actuator.command(MOVING).is_neutral))
            except ActuatorFaultError:
                break
            time.sleep(0.01)
        until(lambda: actuator.status().state == SenderState.FAULT)
        assert "stopped answering" in actuator.status().fault
        moving = [e.t_s for e in serial_firmware.log.motor() if e.value == 3.0]
        neutral = [e for e in serial_firmware.log.motor() if e.t_s > moving[-1]]
        assert neutral[-1].t_s - neutral[0].t_s > 0.4, "neutral is sent well before the fault"
        neutral_from_s = next(t_s for t_s, is_neutral in returned if is_neutral)
        assert all(is_neutral for t_s, is_neutral in returned if t_s > neutral_from_s)
        assert neutral_from_s > moving[-1] - 0.25
        moving_until_s = max(t_s for t_s, is_neutral in returned if not is_neutral)
        assert moving_until_s < moving[-1] + 0.25, "the reported command is neutral from then on, too"


def test_replugged_device_gets_neutral_until_reset_and_arm(serial_firmware: SerialFirmware) -> None:
    serial_firmware.firmware.motor_timeout_s = 0.3
    with Actuator(config_for(serial_firmware), CALIBRATION) as actuator:
        actuator.arm()
        actuator.command(MOVING)
        until(lambda: any(e.value == 3.0 for e in serial_firmware.log.motor()))
        serial_firmware.unplug()
        until(lambda: actuator.status().state == SenderState.FAULT)
        with pytest.raises(ActuatorFaultError, match="was lost"):
            actuator.command(MOVING)
        with pytest.raises(ActuatorFaultError, match="was lost"):
            actuator.reset_fault()
        assert serial_firmware.log.wait_for("motor_timeout", TIMEOUT_S) is not None
        serial_firmware.replug()
        t_replug_s = serial_firmware.log.entries("replug")[0].t_s
        until(lambda: len(serial_firmware.log.motor(t_replug_s)) > 10)
        assert serial_firmware.log.entries(since_s=t_replug_s)[2].name == "firmware", "nothing before the version"
        assert all(e.value == 0.0 for e in serial_firmware.log.motor(t_replug_s)), "never re-arms by itself"
        with pytest.raises(ActuatorFaultError, match="was lost"):
            actuator.command(MOVING)
        until(lambda: not actuator.problems() or "old" not in actuator.problems()[0])
        actuator.reset_fault()
        actuator.arm()
        actuator.command(MOVING)
        until(lambda: any(e.value == 3.0 for e in serial_firmware.log.motor(t_replug_s)))


def test_planned_stop_without_a_link_gives_a_warning(
    actuator: Actuator, serial_firmware: SerialFirmware, caplog: pytest.LogCaptureFixture
) -> None:
    actuator.arm()
    actuator.stop(planned=True)
    actuator.arm()
    actuator.command(MOVING)
    assert caplog.text == ""
    serial_firmware.unplug()
    actuator.stop(planned=True)
    assert "Neutral may not have arrived at the stop; then the VESC's own time-out stops the motor: " in caplog.text
    assert "was lost" in caplog.text
    assert len(caplog.records) == 1
    actuator.stop(planned=True)
    assert len(caplog.records) == 1


def test_another_board_on_the_same_port_is_not_used(serial_firmware: SerialFirmware) -> None:
    with Actuator(config_for(serial_firmware), CALIBRATION) as actuator:
        serial_firmware.unplug()
        until(lambda: actuator.status().state == SenderState.FAULT)
        serial_firmware.firmware.version = FirmwareVersion(6, 5, "OTHER", b"another board")
        serial_firmware.replug()
        t_replug_s = serial_firmware.log.entries("replug")[0].t_s
        assert serial_firmware.log.wait_for("firmware", TIMEOUT_S, t_replug_s) is not None
        time.sleep(0.3)
        with pytest.raises(ActuatorFaultError):
            actuator.reset_fault()
        assert not serial_firmware.log.motor(t_replug_s)


def test_device_that_stops_reading_is_a_fault(serial_firmware: SerialFirmware) -> None:
    config = config_for(serial_firmware, rate_hz=500.0)
    with Actuator(config, CALIBRATION) as actuator:
        actuator.arm()
        serial_firmware.faults.stops_reading = True
        until(lambda: actuator.status().state == SenderState.FAULT)
        assert "accepts no more bytes" in actuator.status().fault


def test_suspended_process_is_no_fault_if_the_port_accepts_the_bytes(
    serial_firmware: SerialFirmware, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The process sleeps longer than the write time-out while it writes."""
    write = os.write

    def slow_write(fd: int, data: bytes) -> int:
        time.sleep(1.5 * WRITE_TIMEOUT_S)
        return write(fd, data)

    link = SerialLink(serial_firmware.port)
    link.open()
    try:
        with monkeypatch.context() as patch:
            patch.setattr(os, "write", slow_write)
            link.write(encode_frame(set_current(0.0)))
        assert serial_firmware.log.wait_for("current", TIMEOUT_S) is not None
    finally:
        link.close()


def test_garbage_lost_and_broken_frames_are_tolerated_and_counted(tmp_path: Path) -> None:
    faults = WireFaults(drop_share=0.05, corrupt_share=0.2, seed=3)
    firmware = SerialFirmware(VescFirmware(CommandLog()), faults=faults)
    with firmware, Actuator(config_for(firmware, open_timeout_s=TIMEOUT_S), CALIBRATION) as actuator:
        actuator.arm()
        firmware.send_raw(bytes((i * 73 + i // 7) & 255 for i in range(3000)) + encode_frame(set_current(9.0))[:5])
        firmware.send_raw(encode_frame(get_values() + bytes(20)))  # a reply of no known layout
        until(lambda: actuator.status().crc_errors >= 3)
        status = actuator.status()
        assert status.garbage_bytes >= 1000
        actuator.command(MOVING)
        until(lambda: any(e.value == 3.0 for e in firmware.log.motor()))
        assert actuator.status().state == SenderState.ARMED
        assert {e.value for e in firmware.log.motor()} <= {0.0, 3.0}


def test_line_at_115200_baud_builds_no_backlog(tmp_path: Path) -> None:
    firmware = SerialFirmware(VescFirmware(CommandLog()), baud=115_200)
    with firmware, Actuator(config_for(firmware), CALIBRATION) as actuator:
        actuator.arm()
        actuator.command(MOVING)
        until(lambda: len([e for e in firmware.log.motor() if e.value == 3.0]) > 50)
        moving = [e for e in firmware.log.motor() if e.value == 3.0]
        wire_s = 18 * 10 / 115_200
        assert moving[0].t_s >= actuator.status().t_issued_s + wire_s * 0.9
        t_s = firmware.log.motor()[-1].t_s
        assert time.monotonic() - t_s < 1.0, "no backlog builds up"


def test_readings_are_those_of_the_firmware(tmp_path: Path) -> None:
    firmware = VescFirmware(CommandLog(), readings=lambda t_s: MotorValues(erpm=1234.0, input_v=7.4))
    with SerialFirmware(firmware) as served, Actuator(config_for(served), CALIBRATION) as actuator:
        readings = actuator.health().readings
        assert (readings["motor_erpm"], readings["battery_v"]) == (1234.0, 7.4)
        assert readings["firmware_version"] == pytest.approx(6.05)
        assert actuator.status().hardware == "EMULATED"


def test_wrong_port_is_reported_without_traceback(tmp_path: Path) -> None:
    missing = tmp_path / "nothing"
    with pytest.raises(NotReadyError, match="does not exist") as caught:
        Actuator(ActuatorConfig(port=str(missing)), CALIBRATION).open()
    assert "port" in str(caught.value)
    assert "\nTraceback" not in str(caught.value)


def test_port_in_use_missing_device_and_old_firmware_are_not_ready(serial_firmware: SerialFirmware) -> None:
    with Actuator(config_for(serial_firmware), CALIBRATION), pytest.raises(NotReadyError, match="another program"):
        Actuator(config_for(serial_firmware), CALIBRATION).open()
    serial_firmware.faults.drops_replies = True
    with pytest.raises(NotReadyError, match="no device answers"):
        Actuator(config_for(serial_firmware, open_timeout_s=0.5), CALIBRATION).open()
    serial_firmware.faults.drops_replies = False
    serial_firmware.firmware.version = FirmwareVersion(3, 0)
    with pytest.raises(NotReadyError, match=r"3\.00 is older than 3\.07"):
        Actuator(config_for(serial_firmware), CALIBRATION).open()
    assert not serial_firmware.log.motor(serial_firmware.log.entries("firmware")[-1].t_s), "no command to an old one"


def test_calls_on_a_closed_or_partly_opened_actuator_are_safe(serial_firmware: SerialFirmware) -> None:
    actuator = Actuator(config_for(serial_firmware), CALIBRATION)
    actuator.close()
    actuator.stop(planned=True)
    for use in (lambda: actuator.command(NEUTRAL), actuator.arm, actuator.status, actuator.reset_fault):
        with pytest.raises(NotOpenError):
            use()
    assert not actuator.health().ready
    actuator.open()
    actuator.open()
    actuator.close()
    actuator.close()
    actuator.open()
    assert actuator.health().ready
    actuator.close()


def test_sender_imports_no_heavy_modules_and_ignores_signals(
    actuator: Actuator, serial_firmware: SerialFirmware
) -> None:
    pid = actuator._sender.pid  # type: ignore[union-attr]
    assert os.getsid(pid) == pid, "the sender has a separate session: a terminal's ^C does not reach it"
    mapped = Path(f"/proc/{pid}/maps").read_text(encoding="ascii")
    assert "torch" not in mapped
    assert "rerun" not in mapped
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        os.kill(pid, number)
    t_s = time.monotonic()
    until(lambda: len(serial_firmware.log.motor(t_s)) > 20)


def test_stop_does_not_wait_for_a_hanging_sender(actuator: Actuator, serial_firmware: SerialFirmware) -> None:
    """Otherwise the stop would be reported as a hung loop, which hides the true reason."""
    actuator.arm()
    assert actuator._sender is not None
    actuator.command(MOVING)
    os.kill(actuator._sender.pid, signal.SIGSTOP)  # type: ignore[attr-defined]
    try:
        until(lambda: time.monotonic() - actuator.status().t_published_s > 0.6)
        with RunningTime() as running:
            actuator.stop(planned=False)
        assert running.seconds < 1.0
    finally:
        t_resumed_s = time.monotonic()
        os.kill(actuator._sender.pid, signal.SIGCONT)  # type: ignore[attr-defined]
    until(lambda: actuator.status().state == SenderState.FAULT)
    assert all(e.value == 0.0 for e in serial_firmware.log.motor(t_resumed_s)[1:]), "one frame may be in transmission"
