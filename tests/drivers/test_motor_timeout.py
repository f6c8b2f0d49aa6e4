"""Measurement of the time-out of the motor controller's firmware."""

from __future__ import annotations

import math
import threading

import pytest
from patient_config import patient_config

from carlab.core.quantities import Action
from drivers.actuator import Actuator
from drivers.calibration import ActuatorCalibration
from drivers.config import ActuatorConfig
from drivers.emulators.command_log import CommandLog
from drivers.emulators.serial_firmware import SerialFirmware
from drivers.emulators.vesc_firmware import VescFirmware
from drivers.sender.logic import Order, Request, SenderLogic, SenderState
from drivers.vesc.payloads import Command, FirmwareVersion, MotorValues
from tests.helpers.pauses import RunningTime
from tests.helpers.waiting import TIMEOUT_S, until

pytestmark = pytest.mark.realtime

MOVING = Action(0.5, 0.3)
CALIBRATION = ActuatorCalibration()
ADVICE = "Lift the wheels, unplug the USB or CAN cable of the motor controller while they turn, and see that they stop."
CONTROLLED, RELEASED = (MotorValues(erpm=0.0, fault_code=0, status_bits=bits) for bits in (0, 1))


def served(motor_timeout_s: float) -> SerialFirmware:
    return SerialFirmware(VescFirmware(CommandLog(), motor_timeout_s=motor_timeout_s))


def connected(firmware: SerialFirmware) -> Actuator:
    return Actuator(patient_config(port=firmware.port), CALIBRATION)


def test_timeout_is_measured_in_neutral_and_the_car_can_be_armed_afterwards() -> None:
    with served(0.3) as firmware, connected(firmware) as actuator:
        assert "vesc_time_to_motor_release_s" not in actuator.health().readings
        for _ in range(3):  # a pause of the machine prolongs a measurement
            actuator.measure_motor_timeout()
            time_to_release_s = actuator.health().readings["vesc_time_to_motor_release_s"]
            if time_to_release_s < 1.0:
                break
        assert 0.3 <= time_to_release_s < 1.0
        assert any(entry.name == "motor_timeout" for entry in firmware.log.entries())
        assert all(entry.value == 0.0 for entry in firmware.log.motor())
        assert actuator.health().readings["vesc_motor_timeout_flag"] == 0.0
        assert actuator.problems() == ()
        assert actuator.health().warnings == ()
        actuator.arm()
        actuator.command(MOVING)
        until(lambda: firmware.log.motor()[-1].value == 3.0)


def test_long_timeout_is_a_warning_with_the_remedy_and_the_car_can_be_armed() -> None:
    with served(1.0) as firmware, connected(firmware) as actuator:
        assert actuator.health().warnings == ()  # not yet measured
        actuator.measure_motor_timeout()
        (warning,) = actuator.health().warnings
        assert warning.startswith("the VESC stops the motor only 1.")
        assert warning.endswith("set Timeout in VESC Tool (App Settings, General) to 200 to 300 ms.")
        actuator.arm()


def test_missing_timeout_is_a_problem_with_the_remedy() -> None:
    with served(math.inf) as firmware, connected(firmware) as actuator:
        actuator.measure_motor_timeout()
        (problem,) = actuator.problems()
        assert problem.startswith("the VESC does not stop the motor within 2 s after the last command; set Timeout in")
        assert "vesc_time_to_motor_release_s" not in actuator.health().readings


class Firmware5(VescFirmware):
    """Firmware 5.2, which has no status byte at the end of its telemetry."""

    def handle(self, payload: bytes, t_s: float) -> bytes | None:
        reply = super().handle(payload, t_s)
        return reply[:-1] if reply and reply[0] == Command.GET_VALUES_SELECTIVE else reply


def test_timeout_that_the_firmware_does_not_report_is_a_warning() -> None:
    old = Firmware5(CommandLog(), motor_timeout_s=math.inf)
    old.version = FirmwareVersion(5, 2, "OLD", b"u" * 12)
    with SerialFirmware(old) as firmware, connected(firmware) as actuator:
        assert actuator.health().warnings == ()
        actuator.measure_motor_timeout()
        (warning,) = actuator.health().warnings
        assert warning.startswith("the time-out of the VESC was not measured: the firmware does not report")
        assert warning.endswith(ADVICE)
        actuator.arm()


def test_stop_of_another_thread_ends_the_measurement_with_neutral() -> None:
    with served(math.inf) as firmware, connected(firmware) as actuator:
        thread = threading.Thread(target=actuator.measure_motor_timeout)
        thread.start()
        until(lambda: actuator.status().epoch == 1)
        count = len(firmware.log.motor())
        actuator.stop(planned=False)
        with RunningTime() as running:
            thread.join(TIMEOUT_S)
        assert running.seconds < 1.0
        until(lambda: len(firmware.log.motor()) >= count + 3)
        assert actuator.status().state == SenderState.FAULT


def test_refusal_while_armed_is_a_warning_without_the_advice_for_old_firmware() -> None:
    with served(0.3) as firmware, connected(firmware) as actuator:
        actuator.arm()
        actuator.measure_motor_timeout()
        assert actuator.health().warnings == (
            "the time-out of the VESC was not measured: the time-out is measured in neutral only; stop the car.",
        )


@pytest.mark.parametrize("planned", [True, False])
def test_interrupted_measurement_is_a_warning_until_the_next_one(*, planned: bool) -> None:
    with served(math.inf) as firmware, connected(firmware) as actuator:
        thread = threading.Thread(target=actuator.measure_motor_timeout)
        thread.start()
        until(lambda: actuator.status().epoch == 1)
        actuator.stop(planned=planned)
        thread.join(TIMEOUT_S)
        (warning,) = actuator.health().warnings
        cause = "the measurement was interrupted; measure again." if planned else actuator.status().fault
        assert warning == f"the time-out of the VESC was not measured: {cause}"
        actuator.reset_fault()
        actuator.measure_motor_timeout()
        assert all("was not measured" not in warning for warning in actuator.health().warnings)


def test_lost_link_ends_the_measurement() -> None:
    with served(math.inf) as firmware, connected(firmware) as actuator:
        thread = threading.Thread(target=actuator.measure_motor_timeout)
        thread.start()
        until(lambda: actuator.status().epoch == 1)
        firmware.unplug()
        with RunningTime() as running:
            thread.join(TIMEOUT_S)
        assert running.seconds < 1.0


class Bench:
    """The sender's logic in neutral, with a fake clock."""

    def __init__(self, values: MotorValues) -> None:
        self.logic = SenderLogic(ActuatorConfig(), CALIBRATION)
        self.now_s, self.epoch = 100.0, 0
        self.logic.link_up()
        self.logic.firmware(FirmwareVersion(6, 5, "TEST", b"u" * 12))
        self.tick(0.5, values)

    def tick(self, duration_s: float, values: MotorValues) -> int:
        """Number of commands that are sent while the telemetry has the values."""
        frames = self.logic.frames
        for _ in range(round(duration_s / 0.01)):
            self.now_s += 0.01
            self.logic.telemetry(self.now_s, values)
            command = self.logic.decide(self.now_s)
            if command is not None:
                self.logic.written(self.now_s, command)
        return self.logic.frames - frames

    def request(self, request: Request) -> str:
        self.epoch += 1
        self.logic.order(self.now_s, Order(self.epoch, request, 0, self.now_s, CALIBRATION.neutral))
        return self.logic.refusal


def test_nothing_is_sent_until_the_release_and_neutral_afterwards() -> None:
    bench = Bench(CONTROLLED)
    assert bench.request(Request.MEASURE_TIMEOUT) == ""
    assert bench.tick(0.25, CONTROLLED) == 0
    assert bench.tick(0.1, RELEASED) > 5
    assert bench.logic.timeout.result_s == pytest.approx(0.26)


def test_release_before_the_last_command_does_not_count() -> None:
    bench = Bench(CONTROLLED)
    assert bench.request(Request.MEASURE_TIMEOUT) == ""
    assert bench.tick(0.05, RELEASED) == 0, "a late answer to an earlier request"
    bench.tick(0.2, CONTROLLED)
    bench.tick(0.1, RELEASED)
    assert bench.logic.timeout.result_s == pytest.approx(0.26)


def test_measurement_without_release_ends_after_two_seconds() -> None:
    bench = Bench(CONTROLLED)
    bench.request(Request.MEASURE_TIMEOUT)
    assert bench.tick(1.99, CONTROLLED) == 0
    assert bench.tick(0.1, CONTROLLED) > 5
    assert bench.logic.timeout.result_s == math.inf


@pytest.mark.parametrize("request_", [Request.ARM, Request.STOP, Request.STOP_AND_LATCH, Request.SHUT_DOWN])
def test_each_other_request_ends_the_measurement(request_: Request) -> None:
    bench = Bench(CONTROLLED)
    bench.request(Request.MEASURE_TIMEOUT)
    assert bench.tick(0.1, CONTROLLED) == 0
    bench.request(request_)
    assert bench.tick(0.2, CONTROLLED) > 5
    assert math.isnan(bench.logic.timeout.result_s)


def test_fault_ends_the_measurement_with_neutral() -> None:
    bench = Bench(CONTROLLED)
    bench.request(Request.MEASURE_TIMEOUT)
    assert bench.tick(0.1, CONTROLLED) == 0
    assert bench.tick(0.1, MotorValues(erpm=0.0, fault_code=2, status_bits=0)) > 5


def test_measurement_is_refused_while_armed_and_for_old_firmware() -> None:
    bench = Bench(CONTROLLED)
    bench.request(Request.ARM)
    assert bench.request(Request.MEASURE_TIMEOUT) == "the time-out is measured in neutral only; stop the car."
    assert bench.tick(0.1, CONTROLLED) > 5
    old = Bench(MotorValues(erpm=0.0, fault_code=0))
    assert old.request(Request.MEASURE_TIMEOUT) == f"the firmware does not report its time-out. {ADVICE}"
    assert old.tick(0.1, MotorValues(erpm=0.0, fault_code=0)) > 5
