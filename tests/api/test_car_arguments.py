"""Cars are given by names, paths or car files in all calls of the Python API."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import carlab
from carlab.core.errors import ConfigError
from sim_backends.simulated_car import SimulatedCar


@pytest.fixture
def car_file(tmp_path: Path) -> Path:
    path = tmp_path / "my_car.toml"
    path.write_text("[vehicle]\nmass = 2.0\n")
    return path


@pytest.mark.parametrize("kind", [str, Path, carlab.load_car])
def test_vehicle_is_a_string_a_path_or_a_car_file(tmp_path: Path, car_file: Path, kind: Callable[[Any], Any]) -> None:
    run = carlab.drive(
        "sim", policy="neutral", ticks=2, out=tmp_path / "runs", rerun=False, picture=False,
        vehicle=kind(str(car_file)), reality="eth_rc_car",
    )  # fmt: skip
    assert "mass = 2.0" in (run.folder / "config.toml").read_text()


def test_strings_are_accepted_by_the_other_calls(tmp_path: Path, car_file: Path) -> None:
    assert carlab.check("sim", vehicle=str(car_file), seconds=0.2).is_ready
    run = carlab.drive(car_file, policy="neutral", ticks=5, out=tmp_path / "runs", rerun=False, picture=False)
    _, replayed = carlab.replay(run.recordings[0], vehicle=str(car_file), out=tmp_path / "runs")
    assert replayed.recordings
    with pytest.raises(ConfigError, match=r"There is no car file 'missing.toml'"):
        carlab.learn("sim", vehicle="missing.toml", out=tmp_path / "runs")


@pytest.mark.parametrize("option", ["car", "vehicle", "reality"])
def test_value_of_another_type_is_refused(tmp_path: Path, option: str) -> None:
    arguments: dict[str, Any] = {"car": "sim"} | {option: 5}
    with pytest.raises(ConfigError, match=f"--{option}: an object of type int is no car; give a name"):
        carlab.drive(**arguments, ticks=2, out=tmp_path)


def test_car_object_is_refused_with_the_entry_point_group() -> None:
    car: Any = SimulatedCar()
    with pytest.raises(ConfigError, match=r"own class SimulatedCar .* entry-point group carlab.cars"):
        carlab.drive(car, ticks=2)


def test_simulator_of_a_car_file_is_no_car() -> None:
    simulator: Any = carlab.load_car().simulator
    with pytest.raises(ConfigError, match=r"type SimulatorConfig is no car; .* the result of carlab.load_car"):
        carlab.predict("drive.mcap", simulator)


def test_episode_of_a_run_is_replayed(tmp_path: Path) -> None:
    run = carlab.drive(policy="neutral", ticks=5, out=tmp_path, rerun=False, picture=False)
    recorded, replayed = carlab.replay(run.episodes[0].data, out=tmp_path)
    assert recorded is run.episodes[0].data
    assert replayed.episodes[0].data.ticks == 5
