"""A control period that the watchdog does not permit is refused; a command that the watchdog replaced is reported."""

from __future__ import annotations

from pathlib import Path

import pytest

from carlab.cars import choose_car
from carlab.cars.emulated_car import EmulatedCar
from carlab.core.documents import SafetyEvent
from carlab.core.errors import ConfigError
from carlab.core.quantities import Action, CarState
from carlab.core.safety import SafeCar, SafetyEnvelope
from sim_backends.simulated_car import SimulatedCar

HARDWARE = "[hardware.arena]\ncorners_m = [[-9, -9], [9, -9], [9, 9], [-9, 9]]\n"
TELEMETRY = "telemetry_stale_s = 1.9\ntelemetry_lost_s = 2.0\n"
LONG_WATCHDOG = f"[hardware.actuator]\nwatchdog_s = 1.5\nlatch_s = 2.0\n{TELEMETRY}"
ENVELOPE = SafetyEnvelope(steering_rate_per_s=1000.0, throttle_rate_per_s=1000.0, stale_pose_s=1.9, lost_pose_s=2.0)


def car_file(folder: Path, control_period_s: float, hardware: str = "") -> Path:
    path = folder / "car.toml"
    path.write_text(f"[timing]\ncontrol_period = {control_period_s}\n{hardware}", encoding="utf-8")
    return path


@pytest.mark.parametrize("dry_run", [False, True])
@pytest.mark.parametrize("car", ["sim", "emulated", "emulated-can", "real file"])
def test_period_that_is_not_shorter_than_the_watchdog_is_refused(tmp_path: Path, car: str, dry_run: bool) -> None:
    def choose(control_period_s: float, hardware: str = "") -> float:
        path = car_file(tmp_path, control_period_s, HARDWARE + hardware)
        if car == "real file":
            return choose_car(str(path), dry_run=dry_run).control_period_s
        return choose_car(car, vehicle=path, dry_run=dry_run).control_period_s

    for period_s in (0.15, 0.2):
        with pytest.raises(ConfigError, match=rf"is {period_s:g} s.* set a control_period below 0\.15 s, or a longer"):
            choose(period_s)
    assert choose(0.149) == 0.149
    assert choose(0.2, LONG_WATCHDOG) == 0.2
    with pytest.raises(ConfigError, match=r"below 1\.5 s"):
        choose(1.5, LONG_WATCHDOG)


@pytest.mark.parametrize("car", ["sim", "emulated", "emulated-can", "file"])
def test_watchdog_of_a_car_without_hardware_is_longer_than_its_period(tmp_path: Path, car: str) -> None:
    path = car_file(tmp_path, 0.4)
    choice = choose_car(str(path)) if car == "file" else choose_car(car, vehicle=path)
    assert choice.watchdog_s is not None
    assert choice.watchdog_s > choice.control_period_s == 0.4


def test_car_that_is_not_driven_may_have_any_period(tmp_path: Path) -> None:
    path = car_file(tmp_path, 0.2, HARDWARE)
    assert choose_car("sim", vehicle=path, is_driven=False).control_period_s == 0.2


def motor_values(car: EmulatedCar, since_s: float) -> list[float]:
    """Motor commands [A] that the emulated firmware has received."""
    entries = car.world.request(do="log", since_s=since_s)["entries"]
    return [value for _, name, value in entries if name in ("current", "brake", "duty")]


@pytest.mark.realtime
def test_emulated_car_holds_a_command_as_long_as_its_car_file_states(tmp_path: Path) -> None:
    path = car_file(tmp_path, 0.2, HARDWARE + LONG_WATCHDOG)
    with choose_car("emulated", vehicle=path).car as car:
        assert isinstance(car, EmulatedCar)
        car.arm()
        car.command(Action(0.0, 0.2))
        t_s = car.clock.now_s()
        car.clock.sleep_until(t_s + 0.6)
        car.command(Action(0.0, 0.2))
        values = motor_values(car, t_s + 0.1)
        assert len(values) > 10
        assert set(values) == {2.0}
        assert car.watchdog_trips == 0


def test_simulated_car_holds_a_command_as_long_as_its_car_file_states(tmp_path: Path) -> None:
    speeds_mps = []
    for hardware in ("", HARDWARE + LONG_WATCHDOG):
        with choose_car("sim", vehicle=car_file(tmp_path, 0.1, hardware)).car as car:
            assert isinstance(car, SimulatedCar)
            car.arm()
            car.command(Action(0.0, 0.5))
            car.clock.sleep_until(car.clock.now_s() + 1.0)
            speeds_mps.append(car.true_state.vx_mps)
            assert car.watchdog_trips == (1 if not hardware else 0)
    assert speeds_mps[1] > 2.0 * speeds_mps[0], "drive force for 0.92 s instead of 0.15 s"


@pytest.mark.realtime
def test_command_that_the_watchdog_replaced_is_reported(tmp_path: Path) -> None:
    events: list[SafetyEvent] = []
    path = car_file(tmp_path, 0.03, HARDWARE + "[hardware.actuator]\nlatch_s = 2.0\n" + TELEMETRY)
    with choose_car("emulated", vehicle=path).car as car:
        assert isinstance(car, EmulatedCar)
        car.place(CarState())
        safe = SafeCar(car, ENVELOPE, events.append)
        safe.arm()
        t_s = car.clock.now_s()
        safe.command(Action(0.0, 0.2), car.observe(), 0.033)
        car.clock.sleep_until(t_s + 0.3)
        safe.command(Action(0.0, 0.2), car.observe(), 0.033)
        values = motor_values(car, t_s)
        first = values.index(2.0)
        assert 0.0 in values[first:], "the firmware has received neutral between two equal commands"
        assert [event.kind for event in events] == ["watchdog"]
        safe.stop(planned=True)
