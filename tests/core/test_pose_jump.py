"""The safety gate checks the poses between two ticks too: a wrong one falsifies the estimated speed."""

from dataclasses import replace

import pytest
from logging_car import gate, seen

from carlab.core.outcome import EndReason
from carlab.core.quantities import Action, CarState, PoseSample
from carlab.core.safety import SafetyStop

PERIOD_S = 1.0 / 30.0


@pytest.mark.parametrize("is_tracked", [True, False])
def test_wrong_pose_between_two_ticks_is_a_jump_and_not_a_speed(is_tracked: bool) -> None:
    safe, car, _ = gate(max_speed_mps=2.0)
    safe.arm()
    safe.command(Action(0.1, 0.1), seen(10.0), PERIOD_S)
    car.clock.sleep_until(10.03)
    wrong = PoseSample(2, 10.01, 10.01, 1.0, 0.0, 0.0, tracked=is_tracked)
    right = PoseSample(3, 10.02, 10.02, 0.01, 0.0, 0.0)
    later = replace(seen(10.02, CarState(x_m=0.01, vx_mps=8.0)), poses=(wrong, right))
    with pytest.raises(SafetyStop) as caught:
        safe.command(Action(0.1, 0.1), later, PERIOD_S)
    assert caught.value.reason is (EndReason.POSE_JUMP if is_tracked else EndReason.OVERSPEED)
    assert car.stops == [False]


def test_poses_of_a_fast_car_between_two_ticks_are_no_jump() -> None:
    safe, car, _ = gate(max_speed_mps=2.0)
    safe.arm()
    safe.command(Action(0.1, 0.1), seen(10.0), PERIOD_S)
    car.clock.sleep_until(10.5)
    poses = tuple(PoseSample(k, 10.0 + 0.01 * k, 10.0 + 0.01 * k, 0.02 * k, 0.0, 0.19 * k) for k in range(1, 50))
    later = seen(10.49, CarState(x_m=0.98, yaw_rad=0.19 * 49))
    assert not safe.command(Action(0.1, 0.1), replace(later, poses=poses), PERIOD_S).is_neutral
