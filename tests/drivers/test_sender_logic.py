"""The sender's state machine with a fake clock, down to the bytes on the wire."""

from __future__ import annotations

import itertools
import math
import struct
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from recording_link import RecordingLink

from carlab.core.errors import ActionOutOfRangeError
from carlab.core.quantities import Action
from drivers.calibration import ActuatorCalibration, DeviceCommand, MotorKind
from drivers.sender.logic import Order, Request, SenderState
from drivers.vesc.payloads import FirmwareVersion, MotorValues
from drivers.vesc.serial_codec import VescFrameDecoder
from drivers.vesc.serial_device import VescSerialDevice
from tests.helpers.sender_bench import CALIBRATION, CONFIG, HEALTHY, MOVING, NEUTRAL, VERSION, Bench, armed, shut_down


def test_reset_names_the_present_cause_if_the_link_was_lost_after_another_fault() -> None:
    bench = armed()
    bench.send_request(Request.STOP_AND_LATCH)
    bench.logic.link_failed("the port was lost; check the cable, then reset the fault.")
    bench.send_request(Request.RESET_FAULT)
    assert bench.logic.refusal == "the port was lost; check the cable, then reset the fault."
    bench.logic.link_up()
    bench.tick()
    bench.send_request(Request.RESET_FAULT)
    assert bench.logic.state == SenderState.CONNECTED


def test_no_command_before_the_firmware_is_known_and_neutral_before_arming() -> None:
    bench = Bench()
    assert bench.tick() is None
    bench.logic.link_up()
    assert bench.tick() is None
    bench.logic.firmware(VERSION)
    assert bench.tick() == NEUTRAL
    bench.command()
    assert bench.tick() == NEUTRAL
    bench.send_request(Request.ARM)
    assert bench.tick() == NEUTRAL, "armed, and no command yet"
    bench.command()
    assert bench.tick() == MOVING


def test_old_firmware_gets_no_command() -> None:
    bench = Bench()
    bench.logic.link_up()
    bench.logic.firmware(FirmwareVersion(2, 18))
    bench.send_request(Request.ARM)
    bench.command()
    assert bench.tick() is None
    assert bench.logic.state == SenderState.FAULT
    assert "older than 3.07" in bench.logic.fault


def test_watchdog_gives_neutral_then_latches_until_reset_and_arm() -> None:
    bench = armed()
    bench.command()
    assert bench.tick(0.149) == MOVING
    assert bench.tick(0.002) == NEUTRAL
    assert (bench.logic.state, bench.logic.watchdog_trips) == (SenderState.ARMED, 1)
    bench.command()
    assert bench.tick() == MOVING, "one late command does not latch"
    assert bench.tick(0.48) == NEUTRAL
    assert bench.logic.state == SenderState.ARMED
    assert bench.tick(0.03) == NEUTRAL
    assert bench.logic.state == SenderState.FAULT
    assert bench.logic.watchdog_trips == 2
    bench.command()
    assert bench.tick() == NEUTRAL, "latched"
    bench.send_request(Request.ARM)
    bench.command()
    assert bench.tick() == NEUTRAL, "arming does not clear a fault"
    assert bench.logic.refusal == bench.logic.fault
    bench.send_request(Request.RESET_FAULT)
    assert bench.logic.state == SenderState.CONNECTED
    bench.command()
    assert bench.tick() == NEUTRAL, "reset does not arm"
    bench.send_request(Request.ARM)
    assert bench.tick() == NEUTRAL, "the old command is gone"
    bench.command()
    assert bench.tick() == MOVING


def test_delayed_command_is_never_sent() -> None:
    bench = armed()
    bench.command(t_issued_s=bench.now_s - 0.2)
    assert bench.tick() == NEUTRAL
    bench.command(t_issued_s=bench.now_s + 10.0)
    assert bench.tick() == NEUTRAL, "a time of issue in the future"


def test_order_of_an_older_epoch_is_ignored() -> None:
    bench = armed()
    stale = Order(bench.epoch, Request.ARM, 7, bench.now_s, MOVING)
    bench.send_request(Request.STOP)
    bench.logic.order(bench.now_s, stale)
    assert bench.tick() == NEUTRAL
    assert bench.logic.state == SenderState.STOPPING
    while bench.logic.state == SenderState.STOPPING:
        bench.tick()
    bench.send_request(Request.ARM)
    bench.logic.order(bench.now_s, replace(stale, t_issued_s=bench.now_s))
    assert bench.tick() == NEUTRAL, "armed again, but not by that order"


@pytest.mark.parametrize("is_faulty", [False, True])
def test_orders_are_ignored_during_shutdown(is_faulty: bool) -> None:
    bench = armed()
    if is_faulty:
        bench.send_request(Request.STOP_AND_LATCH)
    bench.logic.main_lost()
    for request in (Request.RESET_FAULT, Request.ARM):
        bench.send_request(request)
        bench.command()
        assert bench.tick() == NEUTRAL


def test_stop_settles_after_three_neutrals_over_sixty_milliseconds() -> None:
    for rate_hz in (10.0, 30.0, 100.0, 400.0):
        bench = armed()
        bench.command()
        bench.tick()
        bench.send_request(Request.STOP)
        times = []
        while bench.logic.state == SenderState.STOPPING:
            assert bench.tick(1.0 / rate_hz) == NEUTRAL
            times.append(bench.now_s)
        assert len(times) >= 3
        assert times[-1] - times[0] >= 0.06 - 1e-9
        assert bench.logic.state == SenderState.CONNECTED
        assert bench.logic.is_neutral_settled


@pytest.mark.parametrize("cause", ["request", "main lost"])
def test_shutdown_sends_three_neutrals_over_sixty_milliseconds(cause: str) -> None:
    bench = armed()
    bench.command()
    assert bench.tick() == MOVING
    shut_down(bench, cause)
    times = []
    while not bench.logic.is_finished:
        bench.command()
        assert bench.tick() == NEUTRAL
        times.append(bench.now_s)
    assert len(times) >= 3
    assert times[-1] - times[0] >= 0.06 - 1e-9


@pytest.mark.parametrize("cause", ["request", "main lost"])
@pytest.mark.parametrize(
    ("brake_a", "speed_mps", "is_answering", "until_s"),
    [
        (4.0, 3.0, True, 1.0 - 200.0 / 9000.0),  # (3 m/s - that at 200 eRPM) / 3 m/s2
        (4.0, -3.0, True, 1.0 - 200.0 / 9000.0),
        (4.0, 9.0, True, 1.5),
        (4.0, 0.05, True, 0.12),
        (0.0, 3.0, True, 0.12),
        (4.0, 3.0, False, 0.25),
    ],
)
def test_shutdown_brakes_until_the_car_is_at_rest(
    cause: str, brake_a: float, speed_mps: float, is_answering: bool, until_s: float
) -> None:
    """A car that brakes at 3 m/s2, with 3000 eRPM for 1 m/s; without telemetry its speed is unknown after 0.25 s."""
    bench = Bench(calibration=replace(CALIBRATION, neutral_brake_a=brake_a)).connect()
    bench.is_answering = False
    bench.logic.telemetry(bench.now_s, replace(HEALTHY, erpm=3000.0 * speed_mps))
    start_s = bench.now_s
    shut_down(bench, cause)
    times = []
    while not bench.logic.is_finished:
        assert bench.tick() == bench.logic.neutral
        times.append(bench.now_s)
        slower_mps = max(abs(speed_mps) - 3.0 * (bench.now_s - start_s), 0.0)
        if is_answering:
            bench.logic.telemetry(bench.now_s, replace(HEALTHY, erpm=math.copysign(3000.0 * slower_mps, speed_mps)))
    assert times[-1] - start_s == pytest.approx(until_s, abs=0.021)


def test_unplanned_stop_latches_and_planned_stop_keeps_a_fault() -> None:
    bench = armed()
    bench.send_request(Request.STOP_AND_LATCH)
    assert bench.logic.state == SenderState.FAULT
    bench.send_request(Request.STOP)
    bench.tick()
    assert bench.logic.state == SenderState.FAULT


def test_stale_telemetry_gives_neutral_and_lost_telemetry_a_fault() -> None:
    bench = armed()
    bench.is_answering = False
    commands = []
    for _ in range(110):
        bench.command()
        commands.append(bench.tick())
    assert commands[:24] == [MOVING] * 24
    assert commands[26:] == [NEUTRAL] * 84
    assert bench.logic.state == SenderState.FAULT
    assert "stopped answering" in bench.logic.fault
    bench.send_request(Request.RESET_FAULT)
    assert bench.logic.state == SenderState.FAULT
    assert "does not answer" in bench.logic.refusal


@pytest.mark.parametrize(
    ("values", "text"),
    [
        (MotorValues(fault_code=2), "under-voltage"),
        (MotorValues(fault_code=77), "reports fault code 77;"),
        (MotorValues(status_bits=2), "kill switch"),
    ],
)
def test_firmware_faults_latch(values: MotorValues, text: str) -> None:
    bench = armed()
    bench.command()
    bench.logic.telemetry(bench.now_s, values)
    assert bench.logic.state == SenderState.FAULT
    assert text in bench.logic.fault
    bench.send_request(Request.RESET_FAULT)
    assert bench.logic.state == SenderState.FAULT, "the cause persists"
    bench.tick()
    bench.send_request(Request.RESET_FAULT)
    assert bench.logic.state == SenderState.CONNECTED


def test_fault_stays_latched_if_another_board_replaces_the_lost_one() -> None:
    bench = armed()
    bench.logic.link_failed("unplugged")
    assert bench.tick() is None
    bench.logic.link_up()
    bench.logic.firmware(FirmwareVersion(6, 5, "TEST", b"v" * 12))
    bench.logic.telemetry(bench.now_s, HEALTHY)
    bench.send_request(Request.RESET_FAULT)
    assert bench.logic.state == SenderState.FAULT
    assert bench.tick() is None


def test_same_board_after_a_lost_link_gets_neutral_until_reset_and_armed() -> None:
    bench = armed()
    bench.command()
    bench.logic.link_failed("unplugged")
    bench.logic.link_up()
    bench.logic.firmware(VERSION)
    bench.command()
    assert bench.tick() == NEUTRAL
    bench.send_request(Request.RESET_FAULT)
    assert bench.logic.state == SenderState.CONNECTED
    assert bench.logic.fault == ""


def motor_and_servo(data: bytes) -> tuple[int, int, int]:
    """Command id, motor number and servo number of the written bytes, decoded by the protocol's layout."""
    motor, servo = VescFrameDecoder().feed(data, 0.0)
    (position,) = struct.unpack(">h", servo[1:])
    assert servo[0] == 12
    return motor[0], struct.unpack(">i", motor[1:])[0], position


STEP = st.one_of(
    st.tuples(st.just("action"), st.floats(width=32), st.floats(width=32)),
    st.tuples(st.just("hostile"), st.integers(-(2**31), 2**31 - 1), st.integers(-(2**15), 2**15 - 1)),
    st.tuples(st.just("late"), st.floats(-1.0, 1.0), st.floats(0.0, 2.0)),
    st.sampled_from(
        [(w.name, 0.0, 0.0) for w in (Request.ARM, Request.STOP, Request.STOP_AND_LATCH, Request.RESET_FAULT)]
    ),
    st.tuples(st.just("wait"), st.floats(0.0, 0.7), st.just(0.0)),
    st.just(("silence", 0.0, 0.0)),
    st.just(("fault code", 0.0, 0.0)),
)


@given(st.lists(STEP, max_size=40), st.sampled_from(["current", "duty"]))
@settings(max_examples=250, deadline=None)
def test_every_frame_is_within_limits_and_neutral_unless_armed(
    steps: list[tuple[str, float, float]], mode: str
) -> None:
    calibration = ActuatorCalibration(
        throttle_mode=mode,  # type: ignore[arg-type]
        max_current_a=10.0,
        max_duty=0.3,
        servo_min=0.2,
        servo_max=0.8,
    )
    bench = Bench(CONFIG, calibration).connect()
    link = RecordingLink()
    device = VescSerialDevice(link)
    full = {6: 10_000, 5: 30_000}
    may_move = False  # expected: True after an accepted ARM, False after any stop or fault
    newest: tuple[float, DeviceCommand] | None = None
    for (kind, a, b), _ in zip(steps, itertools.count(), strict=False):
        if kind in ("action", "late"):
            action = Action(a, b) if kind == "action" else Action(a, a)
            if math.isfinite(action.steering) and math.isfinite(action.throttle):
                issued_s = bench.now_s - (b if kind == "late" else 0.0)
                newest = (issued_s, calibration.to_device(action))
                bench.command(newest[1], issued_s)
            else:
                with pytest.raises(ActionOutOfRangeError):
                    calibration.to_device(action)
        elif kind == "hostile":
            newest = (bench.now_s, DeviceCommand(MotorKind.CURRENT, int(a), int(b)))
            bench.command(newest[1])
        elif kind in Request.__members__:
            was_faulty = bench.logic.state == SenderState.FAULT
            bench.send_request(Request[kind])
            may_move = kind == "ARM" and not was_faulty and (may_move or bench.logic.state == SenderState.ARMED)
            newest = None
        elif kind == "silence":
            bench.is_answering = not bench.is_answering
        elif kind == "fault code":
            bench.logic.telemetry(bench.now_s, MotorValues(fault_code=4))
        command = bench.tick(a if kind == "wait" else 0.01)
        may_move = may_move and bench.logic.state != SenderState.FAULT
        assert command is not None
        device.send(command)
        identifier, motor, servo = motor_and_servo(link.written[-1])
        assert abs(motor) <= full[identifier]
        assert 200 <= servo <= 800
        if (motor, servo) != (0, 500):
            assert may_move
            assert newest is not None
            assert command == newest[1]
            assert bench.now_s - newest[0] <= CONFIG.watchdog_s
