"""Faults of motion capture while an emulated car drives, through the safety gate."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from carlab.cars.car_file import default_car
from carlab.cars.emulated_car import EmulatedCar
from carlab.core.clock import Pacer
from carlab.core.errors import NotReadyError, PoseLostError
from carlab.core.outcome import EndReason
from carlab.core.quantities import Action
from carlab.core.safety import SafeCar, SafetyEnvelope, SafetyStop

PERIOD_S = 1.0 / 30.0
STRAIGHT = Action(0.0, 0.3)
MAX_TICKS = 300


@pytest.fixture
def car() -> Iterator[EmulatedCar]:
    options = {"watchdog_s": 2.0, "latch_s": 30.0, "telemetry_stale_s": 5.0, "telemetry_lost_s": 10.0}
    with EmulatedCar(default_car(), actuator_options=options) as opened:
        yield opened


def drive_until_stop(car: EmulatedCar, faults: dict[str, Any]) -> SafetyStop:
    """Drive, switch on the faults of the server after half a second, and return the stop of the safety gate."""
    gate = SafeCar(car, SafetyEnvelope(), lambda event: None)
    gate.arm()
    pacer = Pacer(car.clock, PERIOD_S)
    pacer.start()

    def drive() -> None:
        for tick in range(MAX_TICKS):
            if tick == 15:
                car.world.request(do="mocap", faults=faults)
            gate.command(STRAIGHT, car.observe(), PERIOD_S)
            pacer.wait()

    with pytest.raises(SafetyStop) as caught:
        drive()
    return caught.value


@pytest.mark.realtime
def test_recorded_take_is_named_before_the_first_live_pose(car: EmulatedCar) -> None:
    reason = "Motive is in Edit mode and streams a recorded take; switch it to Live mode."
    car.world.request(do="mocap", faults={"server_mode": 2})
    car.clock.sleep_until(car.clock.now_s() + 2.0)
    car.observe()
    car.hardware.estimator.reset()
    with pytest.raises(PoseLostError, match=f"has not seen the body yet; {reason}"):
        car.observe()
    with pytest.raises(NotReadyError) as caught:
        car.arm()
    assert reason in str(caught.value)
    assert "markers" not in str(caught.value)


@pytest.mark.realtime
def test_poses_of_a_recorded_take_end_the_episode(car: EmulatedCar) -> None:
    """Motive was switched to Edit mode: its frames show a past drive."""
    stop = drive_until_stop(car, {"server_mode": 2})
    assert stop.reason == EndReason.TRACKING_LOST
    assert "Motion capture reports: Motive is in Edit mode and streams a recorded take; switch it" in stop.detail
    t_stopped_s = car.clock.now_s()
    car.clock.sleep_until(t_stopped_s + 0.2)
    motor = [e for e in car.world.request(do="log", since_s=t_stopped_s)["entries"] if e[1] == "current"]
    assert motor
    assert all(value == 0.0 for _, _, value in motor)
