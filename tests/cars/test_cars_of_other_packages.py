"""Cars of other packages: entry points that make a car, and the messages if they fail."""

import importlib.metadata
from pathlib import Path
from typing import Any

import pytest

import carlab
from carlab.cars import CarChoice, CarFile, choose_car
from carlab.core.errors import ConfigError, NotReadyError
from carlab.core.geofence import rectangle
from carlab.core.safety import SafetyEnvelope


def make_car(file: CarFile, seed: int) -> CarChoice:
    limits = SafetyEnvelope(max_throttle=0.4, arena_m=rectangle(-9.0, 9.0, -9.0, 9.0))
    return CarChoice(choose_car("sim", seed=seed).car, file.simulator, limits, file.text)


def fail(file: CarFile, seed: int) -> CarChoice:
    raise ZeroDivisionError("no wheel")


def refuse(file: CarFile, seed: int) -> CarChoice:
    raise NotReadyError("no battery")


def number(file: CarFile, seed: int) -> int:
    return seed


@pytest.fixture(autouse=True)
def installed_cars(monkeypatch: pytest.MonkeyPatch) -> None:
    names = ("make_car", "fail", "refuse", "number", "missing")
    points = [importlib.metadata.EntryPoint(name, f"{__name__}:{name}", "carlab.cars") for name in names]

    def entry_points(**selection: Any) -> list[importlib.metadata.EntryPoint]:
        assert selection == {"group": "carlab.cars"}
        return points

    monkeypatch.setattr(importlib.metadata, "entry_points", entry_points)


def test_car_of_another_package_is_driven(tmp_path: Path) -> None:
    run = carlab.drive("make_car", policy="slow_circle", ticks=20, out=tmp_path, rerun=False, picture=False)
    assert run.episodes[0].data.ticks == 20


@pytest.mark.parametrize(("name", "message"), [
    ("fail", "'fail' cannot be made: .*:fail failed with ZeroDivisionError: no wheel. With --verbose"),
    ("missing", "'missing' cannot be made: .* failed with AttributeError"),
    ("number", "returned an object of type int; return a carlab.cars.CarChoice"),
])  # fmt: skip
def test_function_that_makes_no_car_is_named(name: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        choose_car(name)


def test_message_of_the_other_package_is_unchanged() -> None:
    with pytest.raises(NotReadyError, match="no battery"):
        choose_car("refuse")
