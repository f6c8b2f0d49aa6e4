"""Calibration: commands to device steps and back."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from carlab.core.errors import ActionOutOfRangeError, ConfigError
from carlab.core.quantities import NEUTRAL, Action
from carlab.core.tables import from_table
from drivers.calibration import ActuatorCalibration, DeviceCommand, MotorKind

UNIT = st.floats(-1.0, 1.0)


@st.composite
def calibrations(draw: st.DrawFn) -> ActuatorCalibration:
    centre = draw(st.floats(0.4, 0.6))
    return ActuatorCalibration(
        servo_centre=centre,
        servo_range_left=draw(st.floats(0.05, 0.35)),
        servo_range_right=draw(st.floats(0.05, 0.35)),
        steering_sign=draw(st.sampled_from([-1, 1])),
        servo_min=0.0,
        servo_max=1.0,
        throttle_mode=draw(st.sampled_from(["current", "duty"])),
        max_current_a=draw(st.floats(1.0, 60.0)),
        max_duty=draw(st.floats(0.05, 1.0)),
        throttle_sign=draw(st.sampled_from([-1, 1])),
        throttle_dead_band=draw(st.sampled_from([0.0, 0.1, 0.3])),
    )


def test_device_steps_equal_a_hand_calculation() -> None:
    calibration = ActuatorCalibration(
        servo_centre=0.53, servo_range_left=0.3, servo_range_right=0.25, steering_sign=-1, max_current_a=20.0
    )
    assert calibration.to_device(NEUTRAL) == DeviceCommand(MotorKind.CURRENT, 0, 530)
    assert calibration.to_device(Action(1.0, 1.0)) == DeviceCommand(MotorKind.CURRENT, 20000, 230)
    assert calibration.to_device(Action(7.0, 7.0)) == calibration.to_device(Action(1.0, 1.0))
    assert calibration.to_device(Action(-1.0, -0.5)) == DeviceCommand(MotorKind.CURRENT, -10000, 780)


def test_modes_signs_and_dead_band_equal_a_hand_calculation() -> None:
    duty = ActuatorCalibration(throttle_mode="duty", max_duty=0.5, throttle_sign=-1, throttle_dead_band=0.2)
    assert duty.to_device(Action(0.0, 0.5)) == DeviceCommand(MotorKind.DUTY, -30000, 500)  # -(0.2 + 0.8 / 2) / 2
    assert duty.to_device(Action(0.0, 0.0)).motor_steps == 0
    assert duty.neutral == DeviceCommand(MotorKind.CURRENT, 0, 500)
    braking = ActuatorCalibration(neutral_brake_a=2.5)
    assert braking.neutral == DeviceCommand(MotorKind.BRAKE, 2500, 500)
    assert braking.to_device(NEUTRAL) == braking.neutral
    assert braking.from_device(braking.neutral) == NEUTRAL
    assert braking.to_device(Action(0.5, 0.0)) == DeviceCommand(MotorKind.CURRENT, 0, 650)


@given(calibrations(), UNIT, UNIT)
@settings(max_examples=200, deadline=None)
def test_round_trip_within_one_device_step(calibration: ActuatorCalibration, steering: float, throttle: float) -> None:
    device = calibration.to_device(Action(steering, throttle))
    back = calibration.from_device(device)
    span = min(calibration.servo_range_left, calibration.servo_range_right)
    assert abs(back.steering - steering) <= 1.0 / (1000.0 * span) + 1e-9
    full = calibration.max_current_a * 1e3 if calibration.throttle_mode == "current" else calibration.max_duty * 1e5
    assert abs(back.throttle - throttle) <= 1.0 / (full * (1.0 - calibration.throttle_dead_band)) + 1e-9
    again = calibration.to_device(back)
    assert abs(again.servo_steps - device.servo_steps) <= 1
    assert calibration.is_within_limits(device)
    assert calibration.is_within_limits(calibration.neutral)


@given(calibrations(), st.floats(allow_nan=True), st.floats(allow_nan=True))
@settings(max_examples=200, deadline=None)
def test_any_number_stays_within_limits_or_is_refused(calibration: ActuatorCalibration, a: float, b: float) -> None:
    if math.isfinite(a) and math.isfinite(b):
        device = calibration.to_device(Action(a, b))
        assert calibration.is_within_limits(device)
        assert 0.0 <= device.servo_position <= 1.0
    else:
        with pytest.raises(ActionOutOfRangeError):
            calibration.to_device(Action(a, b))


@pytest.mark.parametrize(
    "command",
    [
        DeviceCommand(MotorKind.CURRENT, 10001, 500),
        DeviceCommand(MotorKind.CURRENT, 0, 149),
        DeviceCommand(MotorKind.CURRENT, 0, 851),
        DeviceCommand(MotorKind.BRAKE, -1, 500),
        DeviceCommand(MotorKind.BRAKE, 10001, 500),
        DeviceCommand(MotorKind.DUTY, 100, 500),
    ],
)
def test_commands_beyond_the_limits_are_detected(command: DeviceCommand) -> None:
    assert not ActuatorCalibration().is_within_limits(command)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"servo_range_left": 0.5}, "full left"),
        ({"servo_centre": 0.9}, "the centre"),
        ({"servo_min": 0.9}, "servo_min"),
        ({"max_current_a": -1.0}, "positive"),
        ({"max_duty": 2.0}, "at most 1"),
        ({"neutral_brake_a": 50.0}, "max_brake_a"),
        ({"throttle_dead_band": 1.0}, "dead_band"),
        ({"steering_sign": 2}, "one of"),
        ({"servo_center": 0.5}, "did you mean 'servo_centre'"),
        ({"max_current_a": float("nan")}, "NaN"),
        ({"max_current_a": float("inf")}, "positive"),
    ],
)
def test_bad_tables_are_refused_with_one_sentence(table: dict[str, float], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        from_table(ActuatorCalibration, table, "[hardware.calibration]")
