"""Test copies of a car file with other numbers."""

from pathlib import Path

import pytest

import carlab
from carlab.core.errors import ConfigError

FILE = """[vehicle]
mass = 2.0
[track]
centre_line_m = [[0.0, 0.0], [3.0, 0.0], [3.0, 3.0]]
width_m = 0.8
"""


def test_changed_car_is_saved_with_its_new_numbers(tmp_path: Path) -> None:
    """The text of the file that was read has the old numbers."""
    (tmp_path / "car.toml").write_text(FILE)
    changed = carlab.load_car(tmp_path / "car.toml").with_values(
        {"motor.drive_gain": 7.0, "effects.steering_lag.time_constant": 0.05}
    )
    read = carlab.load_car(changed.save(tmp_path / "changed.toml"))
    assert read.simulator == changed.simulator
    assert (read.simulator.parameters.mass_kg, read.simulator.parameters.drive_gain_n) == (2.0, 7.0)
    assert read.simulator.effects == {"steering_lag": {"time_constant": 0.05}}
    assert (changed.track, changed.real) == (None, None)


def test_changed_car_is_driven_and_its_run_has_the_new_numbers(tmp_path: Path) -> None:
    changed = carlab.load_car().with_values({"motor.drive_gain": 7.0})
    run = carlab.drive(changed, policy="neutral", ticks=2, rerun=False, picture=False, out=tmp_path)
    assert carlab.load_car(run.folder / "config.toml").simulator == changed.simulator


def test_unknown_number_is_refused() -> None:
    with pytest.raises(ConfigError, match="did you mean 'drive_gain'"):
        carlab.load_car().with_values({"motor.gain": 7.0})


def test_text_of_each_car_file_has_its_numbers(tmp_path: Path) -> None:
    (tmp_path / "default.toml").write_text(carlab.load_car().text)
    assert carlab.load_car(tmp_path / "default.toml").simulator == carlab.load_car().simulator
