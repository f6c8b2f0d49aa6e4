"""The check of a car whose cable is pulled meanwhile."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

import carlab
from carlab.cars.emulated_world import World, WorldConfig
from drivers.emulators.serial_firmware import SerialFirmware
from mocap.emulators.faults import ServerFaults
from sim_backends.car_parameters import SimulatorConfig
from tests.helpers.waiting import until

CAR = """
[hardware.actuator]
port = "{port}"
[hardware.mocap]
command_port = {command_port}
[hardware.arena]
corners_m = [[-3, -3], [3, -3], [3, 3], [-3, 3]]
"""


@pytest.mark.realtime
def test_fault_during_the_check_is_a_problem_among_the_readings(tmp_path: Path) -> None:
    with World(WorldConfig(SimulatorConfig().to_tables())) as world:
        firmware = world.firmware
        assert isinstance(firmware, SerialFirmware)

        def pull_cable() -> None:
            until(lambda: len(firmware.log.motor()) > 10)
            firmware.unplug()

        path = tmp_path / "car.toml"
        path.write_text(CAR.format(**world.addresses), encoding="utf-8")
        thread = threading.Thread(target=pull_cable)
        thread.start()
        found = carlab.check(path, seconds=1.5)
        thread.join()
    assert not found.is_ready
    assert any("was lost" in problem for problem in found.problems)
    assert "<td>problem</td>" in found._repr_html_()
    assert found.health.readings["mocap_frames"] > 0


@pytest.mark.realtime
def test_check_without_poses_measures_the_motor_timeout_and_names_the_problem_once(tmp_path: Path) -> None:
    with World(WorldConfig(SimulatorConfig().to_tables(), motor_timeout_s=0.25)) as world:
        world.server.faults = ServerFaults(occlusion=1.0)
        path = tmp_path / "car.toml"
        path.write_text(CAR.format(**world.addresses), encoding="utf-8")
        found = carlab.check(path, seconds=0.2)
    assert not found.is_ready
    assert found.health.readings["vesc_time_to_motor_release_s"] == pytest.approx(0.25, abs=0.1)
    assert len(set(found.problems)) == len(found.problems)
