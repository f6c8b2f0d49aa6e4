"""``carlab emulate`` prints the tables of a car file that drives its hardware."""

from __future__ import annotations

import signal
import subprocess
import sys
import tomllib
from pathlib import Path

from carlab.cars import load_car_file
from carlab.cars.emulated_car import free_udp_port
from drivers.calibration import ActuatorCalibration
from tests.helpers.command_line import Carlab

ARENA = "[hardware.arena]\ncorners_m = [[-3, -3], [3, -3], [3, 3], [-3, 3]]\n"


def test_printed_tables_are_a_car_file_with_the_emulated_calibration(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "carlab", "emulate", "--port", str(tmp_path / "vesc")]
    ports = ["--command-port", "0", "--data-port", "0"]
    with subprocess.Popen([*command, *ports], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        lines = []
        for line in process.stdout:
            if line.startswith("^C"):
                break
            lines.append(line)
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=20.0) == 0
    assert lines[0].startswith("EMULATED")
    printed = "".join(lines[1:])
    assert set(tomllib.loads(printed)["hardware"]) == {"actuator", "mocap", "calibration"}
    (tmp_path / "car.toml").write_text(ARENA + printed)
    file = load_car_file(tmp_path / "car.toml")
    assert file.real is not None
    assert file.real.hardware.calibration == ActuatorCalibration()
    assert file.real.hardware.actuator.port == str(tmp_path / "vesc")


def test_second_emulated_car_on_a_can_bus_is_refused(carlab: Carlab) -> None:
    """Both would receive the commands, and their replies would mix."""
    ports = ("--command-port", "0", "--data-port", "0", "--can-channel", f"239.74.163.2:{free_udp_port()}")
    command = [sys.executable, "-m", "carlab", "emulate", "--actuator", "can", *ports]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert any(line.startswith("^C") for line in process.stdout)
            code, text = carlab("emulate", "--actuator", "can", *ports)
        finally:
            process.send_signal(signal.SIGINT)
    assert code == 3
    assert f"is in use: another program emulates it (process {process.pid}, " in text
    assert "end that program or choose another channel." in text


def test_negative_seed_is_refused(carlab: Carlab, tmp_path: Path) -> None:
    code, text = carlab("emulate", "--port", tmp_path / "vesc", "--seed", -1)
    assert code == 2
    assert "--seed -1: give at least 0." in text


def test_port_whose_link_cannot_be_made_is_refused_by_its_name(carlab: Carlab) -> None:
    """In /proc nobody can make a link, also not a superuser."""
    code, text = carlab("emulate", "--port", "/proc/vesc", "--command-port", 0, "--data-port", 0)
    assert code == 3
    assert "The link /proc/vesc to the serial port cannot be made: " in text
    assert "/dev/pts" not in text


def test_log_that_cannot_be_written_is_refused(carlab: Carlab, tmp_path: Path) -> None:
    emulate = ("emulate", "--port", tmp_path / "vesc", "--log")
    code, text = carlab(*emulate, tmp_path / "missing" / "log.jsonl")
    assert code == 2
    assert f"there is no folder {tmp_path / 'missing'}; create it first." in text
    code, text = carlab(*emulate, tmp_path)
    assert code == 2
    assert f"--log {tmp_path}: it is a folder; name a file in it" in text
