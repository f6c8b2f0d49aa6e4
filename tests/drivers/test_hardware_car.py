"""HardwareCar with an emulated firmware and a scripted pose source."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import pytest
from patient_config import patient_config

from carlab.core.car import Car
from carlab.core.errors import (
    ActionOutOfRangeError,
    ActuatorFaultError,
    NotArmedError,
    NotOpenError,
    NotReadyError,
    PoseLostError,
)
from carlab.core.pose_source import PoseSource
from carlab.core.quantities import NEUTRAL, Action, ActionLimits, CarState, PoseSample, Reality
from carlab.core.state_estimator import StateEstimator
from drivers.actuator import Actuator
from drivers.config import HardwareConfig
from drivers.dry_run_car import DryRunCar
from drivers.emulators.serial_firmware import SerialFirmware
from drivers.hardware_car import HardwareCar
from drivers.vesc.payloads import MotorValues
from tests.helpers.waiting import until

pytestmark = pytest.mark.realtime


class ScriptedPoses:
    """A pose source with samples scripted by the test."""

    def __init__(self) -> None:
        self.samples: list[PoseSample] = []
        self.failure: NotReadyError | None = None
        self.reported: tuple[str, ...] = ()
        self.n_delayed = 0
        self.closes = 0

    def show(self, x_m: float = 0.0, *, age_s: float = 0.0, tracked: bool = True, sequence: int | None = None) -> None:
        now_s = time.monotonic() - age_s
        number = len(self.samples) + 1 if sequence is None else sequence
        self.samples.append(PoseSample(number, now_s - 0.005, now_s, x_m, 1.0, 0.5, tracked=tracked))

    def show_at_rest(self) -> None:
        """Three poses of a car at rest: the number that a speed estimate needs."""
        for age_s in (0.02, 0.01, 0.0):
            self.show(age_s=age_s)

    def open(self) -> None:
        if self.failure is not None:
            raise self.failure

    def latest(self) -> PoseSample | None:
        return self.samples[-1] if self.samples else None

    def since(self, sequence: int) -> tuple[PoseSample, ...]:
        return tuple(s for s in self.samples if s.sequence > sequence)

    def wait_for(self, sequence: int, timeout_s: float) -> PoseSample | None:
        if self.n_delayed:
            self.n_delayed -= 1
            self.show()
        newest = self.latest()
        return newest if newest is not None and newest.sequence > sequence else None

    def statistics(self) -> Mapping[str, float]:
        return {"rate_hz": 120.0}

    def problems(self) -> tuple[str, ...]:
        return self.reported

    def close(self) -> None:
        self.closes += 1

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.close()


@pytest.fixture
def poses() -> ScriptedPoses:
    return ScriptedPoses()


def make_car(port: str, poses: ScriptedPoses, **options: Any) -> HardwareCar:
    hardware = HardwareConfig(patient_config(port=port), arm_max_pose_age_s=2.0)
    return HardwareCar(
        "test car",
        Actuator(hardware.actuator, hardware.calibration),
        poses,
        StateEstimator(),
        config=hardware,
        limits=ActionLimits(max_throttle=0.5),
        **options,
    )


@pytest.fixture
def car(serial_firmware: SerialFirmware, poses: ScriptedPoses) -> Iterator[HardwareCar]:
    assert isinstance(poses, PoseSource)
    with make_car(serial_firmware.port, poses) as opened:
        yield opened


def test_observation_needs_a_tracked_pose_and_keeps_the_last_one(car: HardwareCar, poses: ScriptedPoses) -> None:
    with pytest.raises(PoseLostError, match="not seen the body yet"):
        car.observe()
    poses.show(1.0, tracked=False)
    with pytest.raises(PoseLostError):
        car.observe()
    poses.show(2.0)
    first = car.observe()
    assert (first.state.x_m, first.state.y_m, first.state.yaw_rad) == (2.0, 1.0, 0.5)
    assert [p.sequence for p in first.poses] == [1, 2]
    assert first.tracked
    poses.show(9.0, tracked=False)
    lost = car.observe()
    assert not lost.tracked
    assert (lost.state.x_m, lost.sequence) == (2.0, 2), "time of the last tracked pose"
    assert [p.sequence for p in lost.poses] == [3]
    assert car.observe().poses == ()


def test_motor_speed_of_stale_telemetry_is_unknown(serial_firmware: SerialFirmware, poses: ScriptedPoses) -> None:
    """Otherwise a car that has stopped in neutral seems to have a frozen pose."""
    serial_firmware.firmware.readings = lambda t_s: MotorValues(erpm=2000.0, fault_code=0)
    config = HardwareConfig(patient_config(port=serial_firmware.port, telemetry_stale_s=0.5))
    actuator = Actuator(config.actuator, config.calibration)
    with HardwareCar("test car", actuator, poses, StateEstimator(), config=config) as car:
        poses.show()
        until(lambda: car.observe().motor_is_turning is True)
        serial_firmware.faults.drops_replies = True
        until(lambda: car.observe().motor_is_turning is None)


def test_restarted_sequence_numbers_are_accepted(car: HardwareCar, poses: ScriptedPoses) -> None:
    poses.show(1.0, sequence=5000)
    car.observe()
    poses.samples.clear()
    poses.show(3.0, sequence=2)
    assert car.observe().state.x_m == 3.0


def test_arming_reports_every_reason(car: HardwareCar, poses: ScriptedPoses, serial_firmware: SerialFirmware) -> None:
    serial_firmware.firmware.readings = lambda t_s: MotorValues(erpm=3000.0, input_v=11.0)
    until(lambda: car.actuator.status().erpm > 200.0)
    with pytest.raises(NotReadyError) as caught:
        car.arm()
    assert len(caught.value.reasons) == 2
    assert "no pose yet" in str(caught.value)
    assert "3000 eRPM" in str(caught.value)


@pytest.mark.parametrize(
    ("samples", "reason"),
    [
        ([(0.0, 5.0, True)], "old"),
        ([(0.0, 0.0, False)], "does not see the body"),
        ([(0.0, 0.01, True), (0.0, 0.0, True)], "too few poses"),
        ([(0.04 * k, 0.04 - 0.01 * k, True) for k in range(5)], "moves at"),
    ],
)
def test_arming_needs_a_fresh_tracked_pose_at_rest(
    car: HardwareCar, poses: ScriptedPoses, samples: list[tuple[float, float, bool]], reason: str
) -> None:
    for x_m, age_s, tracked in samples:
        poses.show(x_m, age_s=age_s, tracked=tracked)
    with pytest.raises(NotReadyError, match=reason):
        car.arm()


def test_arming_waits_for_late_telemetry(
    car: HardwareCar, poses: ScriptedPoses, serial_firmware: SerialFirmware, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("drivers.hardware_car.ARM_WAIT_S", 20.0)
    car.actuator.config = replace(car.actuator.config, telemetry_stale_s=0.25)
    serial_firmware.faults.drops_replies = True
    until(lambda: any("telemetry is" in problem for problem in car.actuator.problems()))
    threading.Timer(0.1, setattr, (serial_firmware.faults, "drops_replies", False)).start()
    poses.n_delayed = 4
    car.arm()


def test_arming_waits_for_late_poses(car: HardwareCar, poses: ScriptedPoses) -> None:
    poses.show(age_s=5.0)  # too old, and too few for a speed
    poses.n_delayed = 4
    car.arm()
    assert poses.n_delayed == 1, "a speed estimate needs three poses"
    assert car.command(Action(0.1, 0.2)).throttle == pytest.approx(0.2)


def test_problem_of_the_pose_source_prevents_arming(
    car: HardwareCar, poses: ScriptedPoses, serial_firmware: SerialFirmware
) -> None:
    poses.show_at_rest()
    poses.reported = ("the body is tilted; change up_axis.",)
    assert car.health().problems == poses.reported
    with pytest.raises(NotReadyError, match=r"the body is tilted; change up_axis\."):
        car.arm()
    with pytest.raises(NotArmedError):
        car.command(Action(0.1, 0.1))
    assert all(entry.value == 0.0 for entry in serial_firmware.log.motor())
    poses.reported = ()
    poses.show_at_rest()
    assert car.health().ready
    car.arm()


def test_car_without_measured_motor_speed_is_not_armed(
    car: HardwareCar, poses: ScriptedPoses, monkeypatch: pytest.MonkeyPatch
) -> None:
    poses.show_at_rest()
    status_without_speed = replace(car.actuator.status(), erpm=float("nan"))
    monkeypatch.setattr(car.actuator, "status", lambda: status_without_speed)
    with pytest.raises(NotReadyError, match="reports no motor speed"):
        car.arm()


def test_velocities_are_unknown_before_the_third_pose(car: HardwareCar, poses: ScriptedPoses) -> None:
    for age_s, known in ((0.02, False), (0.01, False), (0.0, True)):
        poses.show(1.0, age_s=age_s)
        assert car.observe().velocity_valid is known
    poses.show(1.0, age_s=-1.0)  # After a gap of a second the speed is unknown.
    assert not car.observe().velocity_valid


def test_commands_need_arming_and_a_fault_needs_a_reset(
    car: HardwareCar, poses: ScriptedPoses, serial_firmware: SerialFirmware
) -> None:
    assert car.reality is Reality.REAL
    assert car.command(NEUTRAL) == NEUTRAL
    with pytest.raises(NotArmedError):
        car.command(Action(0.1, 0.1))
    poses.show_at_rest()
    car.arm()
    assert car.command(Action(0.1, 0.2)).throttle == pytest.approx(0.2)
    with pytest.raises(ActionOutOfRangeError, match="beyond the car's limit"):
        car.command(Action(0.0, 0.6))
    with pytest.raises(ActionOutOfRangeError, match="not a number"):
        car.command(Action(float("nan"), 0.0))
    health = car.health()
    assert health.ready
    assert health.readings["mocap_rate_hz"] == 120.0
    car.stop(planned=True)
    with pytest.raises(NotArmedError):
        car.command(Action(0.1, 0.1))
    poses.show_at_rest()
    car.arm()
    car.stop(planned=False)
    with pytest.raises(ActuatorFaultError):
        car.arm()
    assert not car.health().ready
    car.reset_fault()
    poses.show_at_rest()
    car.arm()
    assert not car.place(CarState())


def test_opening_reports_the_reasons_of_actuator_and_mocap(tmp_path: Path, poses: ScriptedPoses) -> None:
    poses.failure = NotReadyError("Motion capture is not ready", ("nobody answers at 10.0.0.1; start it.",))
    car = make_car(str(tmp_path / "missing"), poses)
    with pytest.raises(NotReadyError) as caught:
        car.open()
    assert len(caught.value.reasons) == 2
    assert "10.0.0.1" in str(caught.value)
    assert "does not exist" in str(caught.value)
    assert poses.closes >= 1
    car.close()


def test_closed_car_raises_not_open(serial_firmware: SerialFirmware, poses: ScriptedPoses) -> None:
    car: Car = make_car(serial_firmware.port, poses)
    car.stop(planned=False)
    for use in (car.observe, car.arm, car.reset_fault, lambda: car.command(NEUTRAL)):
        with pytest.raises(NotOpenError):
            use()
    assert not car.health().ready
    car.close()
    car.close()


def test_place_is_passed_to_the_emulator_and_clears_old_poses(
    serial_firmware: SerialFirmware, poses: ScriptedPoses
) -> None:
    placed: list[CarState] = []
    with make_car(serial_firmware.port, poses, place=lambda s: not placed.append(s), reality=Reality.EMULATED) as car:
        poses.show(1.0)
        car.observe()
        assert car.place(CarState(x_m=2.0))
        assert placed == [CarState(x_m=2.0)]
        with pytest.raises(PoseLostError):
            car.observe()
        poses.show(1.0, age_s=0.001)
        with pytest.raises(PoseLostError):
            car.observe()  # captured before the placement, received after it
        poses.show(2.0, age_s=-0.1)
        assert car.observe().state == CarState(2.0, 1.0, 0.5)


def test_dry_run_ends_with_a_fault_of_the_motor_controller(
    serial_firmware: SerialFirmware, poses: ScriptedPoses
) -> None:
    with DryRunCar(make_car(serial_firmware.port, poses)) as car:
        poses.show()
        car.arm()
        assert car.command(Action(0.0, 0.1)) == Action(0.0, 0.1)
        serial_firmware.firmware.fault_code = 2
        until(lambda: not car.health().ready)
        with pytest.raises(ActuatorFaultError, match="under-voltage"):
            car.command(Action(0.0, 0.1))
    assert all(e.value == 0.0 for e in serial_firmware.log.motor())


def test_dry_run_observes_and_discards_commands(serial_firmware: SerialFirmware, poses: ScriptedPoses) -> None:
    inner = make_car(serial_firmware.port, poses)
    calibration = replace(inner.config.calibration)
    with DryRunCar(inner, lambda a: calibration.from_device(calibration.to_device(a))) as car:
        assert car.reality is Reality.DRY_RUN
        poses.show(1.5)
        assert car.observe().state.x_m == 1.5
        with pytest.raises(NotArmedError):
            car.command(Action(0.1, 0.1))
        car.arm()
        t_s = time.monotonic()
        assert car.command(Action(0.12345, 0.1)).steering == pytest.approx(37 / 300)
        with pytest.raises(ActionOutOfRangeError):
            car.command(Action(0.0, 0.9))
        assert serial_firmware.log.wait_for("current", 20.0, t_s) is not None
        car.stop(planned=False)
        with pytest.raises(ActuatorFaultError):
            car.arm()
        car.reset_fault()
        car.arm()
    assert all(e.value == 0.0 for e in serial_firmware.log.motor())
    with pytest.raises(NotOpenError):
        car.command(NEUTRAL)
