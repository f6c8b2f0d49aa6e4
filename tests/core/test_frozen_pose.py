"""The gate ends an episode whose pose repeats while the motor turns, and no other."""

from dataclasses import replace

import numpy as np
import pytest
from logging_car import LoggingCar, gate, seen

from carlab.core.outcome import EndReason
from carlab.core.quantities import Action, CarState
from carlab.core.safety import SafeCar, SafetyState, SafetyStop

PERIOD_S = 1.0 / 30.0


def drive_with_pose(safe: SafeCar, car: LoggingCar, states: list[CarState], turning: bool | None = True) -> int:
    """Command a moving action at each state; returns how many ticks passed before the gate ended the episode."""
    safe.arm()
    for tick, state in enumerate(states):
        car.clock.sleep_until(car.clock.now_s() + PERIOD_S)
        observation = replace(seen(car.clock.now_s(), state), motor_is_turning=turning)
        try:
            safe.command(Action(0.0, 0.3), observation, PERIOD_S)
        except SafetyStop as stop:
            assert stop.reason == EndReason.POSE_FROZEN
            return tick
    return len(states)


def test_a_pose_that_is_frozen_while_the_motor_turns_ends_the_episode() -> None:
    safe, car, events = gate()
    ticks = drive_with_pose(safe, car, [CarState(x_m=1.0)] * 60)
    assert 0.4 < ticks * PERIOD_S <= 0.4 + 3.0 * PERIOD_S
    assert events[-1].kind == "pose_frozen"
    assert car.stops == [False]


@pytest.mark.parametrize("turning", [False, None])
def test_car_at_rest_is_not_frozen(turning: bool | None) -> None:
    safe, car, _ = gate()
    assert drive_with_pose(safe, car, [CarState(x_m=1.0)] * 60, turning) == 60


def test_a_blocked_car_whose_pose_moves_by_the_noise_is_not_frozen() -> None:
    safe, car, _ = gate()
    noise = np.random.default_rng(1).normal(0.0, 1e-4, 60)
    assert drive_with_pose(safe, car, [CarState(x_m=1.0 + float(n)) for n in noise]) == 60


def test_car_with_changing_yaw_only_is_not_frozen() -> None:
    safe, car, _ = gate()
    assert drive_with_pose(safe, car, [CarState(yaw_rad=0.01 * k) for k in range(60)]) == 60


def test_a_neutral_command_does_not_count_as_frozen() -> None:
    safe, car, _ = gate()
    safe.arm()
    for _ in range(60):
        car.clock.sleep_until(car.clock.now_s() + PERIOD_S)
        observation = replace(seen(car.clock.now_s()), motor_is_turning=True)
        safe.command(Action(0.2, 0.0), observation, PERIOD_S)
    assert safe.state == SafetyState.ARMED
