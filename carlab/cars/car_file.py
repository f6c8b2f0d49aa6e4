"""The car file (TOML): parameters of a simulator, and under ``[hardware]`` the configuration of the real car."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from importlib import resources
from pathlib import Path
from typing import Any

import tomli_w

from carlab.core.car import Car
from carlab.core.errors import ConfigError
from carlab.core.geofence import as_polygon
from carlab.core.recording_noise import RecordingNoise
from carlab.core.safety import SafetyEnvelope
from carlab.core.tables import check_keys, from_table, number
from carlab.core.toml_files import read_toml
from carlab.core.track import Track, track_from_table
from drivers.calibration import ActuatorCalibration
from drivers.config import ActuatorConfig, HardwareConfig
from mocap.config import MocapConfig
from sim_backends.car_parameters import TABLES, SimulatorConfig, preset_names

_ARMING = tuple(f.name for f in fields(HardwareConfig) if f.name.startswith("arm_"))

MAX_ARENA_M = 500.0
"""Largest coordinate of an arena [m]. An arena in millimetres would never stop the car."""


@dataclass(frozen=True, slots=True)
class RealCar:
    """Contents of ``[hardware]``: actuator and calibration, motion capture, and the limits of the safety gate."""

    name: str
    hardware: HardwareConfig
    mocap: MocapConfig
    envelope: SafetyEnvelope


@dataclass(frozen=True, slots=True)
class CarFile:
    """A car file: a simulator, and where the file has them the real car, the noise and the track.

    Attributes:
        name: of the car, for messages.
        text: TOML; if it is empty, that of the simulator.
        simulator: parameters and effects in SI units.
        real: contents of ``[hardware]``; None for a simulated car.
        recording_noise: noise that a diagnosis measured; None if the file does not state it.
        track: closed track for ``laps``; None if the file does not state it.
    """

    name: str
    text: str
    simulator: SimulatorConfig
    real: RealCar | None
    recording_noise: RecordingNoise | None = None
    track: Track | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "text", self.text or tomli_w.dumps(self.simulator.to_tables()))

    def with_values(self, changes: Mapping[str, float]) -> CarFile:
        """Simulated car with changed numbers, for example as ``reality`` of ``carlab.drive``.

        Args:
            changes: numbers by dotted name, such as ``motor.drive_gain`` or ``effects.steering_lag.time_constant``; an
                effect with a number is added.

        Returns:
            A car file without ``[hardware]``, measured noise and track.

        Raises:
            ConfigError: an unknown name, or an impossible value.
        """
        return CarFile(self.name, "", self.simulator.with_values(changes), None)

    def __repr__(self) -> str:
        """One line: name, kind of vehicle model, and whether the file has ``[hardware]``."""
        return f"<CarFile {self.name}: {self.simulator.kind}{' with [hardware]' if self.real else ''}>"

    def save(self, path: Path | str) -> Path:
        """Write the file as TOML, replacing an existing file; returns the path.

        Raises DataError if it cannot be written.
        """
        from carlab.recording.atomic_files import write_text

        write_text(Path(path), self.text)
        return Path(path)


def read_car(car: str | Path | CarFile, option: str = "--car") -> CarFile:
    """Return a car file unchanged, or read one by its path or the name of a preset.

    Raises ConfigError as ``load_car_file``, and for an object of another type; the message names ``option``.
    """
    if isinstance(car, CarFile):
        return car
    if isinstance(car, Car):
        raise ConfigError(
            f"{option}: a car of your own class {type(car).__name__} has no car file; register a function that makes "
            'it in the entry-point group carlab.cars, and give the name of the entry point (see "Add a car").'
        )
    if not isinstance(car, (str, Path)):
        raise ConfigError(
            f"{option}: an object of type {type(car).__name__} is no car; give a name, the path of a car file, or the "
            "result of carlab.load_car."
        )
    return load_car_file(Path(car))


def load_car_file(path: Path) -> CarFile:
    """Read a car file, or a preset by its bare name (``preset_names``).

    Raises ConfigError for a missing file, bad TOML, an unknown key or an impossible value.
    """
    if is_preset(path):
        name = path.name
        text = (resources.files("sim_backends") / "presets" / f"{name}.toml").read_text(encoding="utf-8")
        return CarFile(name, text, SimulatorConfig.from_preset(name), None)
    if path.is_dir():
        raise ConfigError(
            f"'{path}' is a folder; name a car file in it (a run has config.toml, a diagnosis model.toml)."
        )
    if not path.is_file():
        raise ConfigError(
            f"There is no car file '{path}'; name an existing TOML file or one of the presets: "
            f"{', '.join(preset_names())}."
        )
    text, tables = read_toml(path, "a car file")
    if not tables:
        raise ConfigError(f"{path} is empty; a car file has at least one table such as [vehicle].")
    check_keys(tables, (*TABLES, "hardware", "recording_noise", "track"), str(path))
    noise = tables.pop("recording_noise", None)
    if noise is not None:
        noise = from_table(RecordingNoise, noise, f"[recording_noise] of {path}")
    hardware, track = tables.pop("hardware", None), tables.pop("track", None)
    simulator = SimulatorConfig.from_tables(tables, str(path))
    real = None if hardware is None else _real_car(hardware, path)
    course = None if track is None else track_from_table(track, f"[track] of {path}")
    return CarFile(path.stem if real is None else real.name, text, simulator, real, noise, course)


def is_preset(path: Path) -> bool:
    """Whether this is the bare name of a preset and no file of that name exists."""
    return str(path) in preset_names() and not path.is_file()


def default_car() -> CarFile:
    """The default car of ``--car sim`` and ``emulated``."""
    return CarFile("rc_car", "", SimulatorConfig.from_preset(), None)


def _real_car(tables: Any, path: Path) -> RealCar:
    where = f"[hardware] of {path}"
    if not isinstance(tables, Mapping):
        raise ConfigError(f"{where} must be a table.")
    check_keys(tables, ("name", "actuator", "calibration", "mocap", "arena", "limits", *_ARMING), where)

    def table(name: str) -> Mapping[str, Any]:
        found = tables.get(name, {})
        if not isinstance(found, Mapping):
            raise ConfigError(f"'{name}' in {where} must be a table [hardware.{name}].")
        return found

    arena = table("arena")
    check_keys(arena, ("corners_m",), f"[hardware.arena] of {path}")
    limits = table("limits")
    check_keys(limits, [f.name for f in fields(SafetyEnvelope) if f.name != "arena_m"], f"[hardware.limits] of {path}")
    envelope = from_table(SafetyEnvelope, limits, f"[hardware.limits] of {path}")
    if "corners_m" not in arena:
        raise ConfigError(
            f"[hardware.arena] of {path} is missing; list the corners of the area in which the car must stay, "
            "for example corners_m = [[-2, -2], [2, -2], [2, 2], [-2, 2]]."
        )
    hardware = HardwareConfig(
        actuator=from_table(ActuatorConfig, table("actuator"), f"[hardware.actuator] of {path}"),
        calibration=from_table(ActuatorCalibration, table("calibration"), f"[hardware.calibration] of {path}"),
        **{name: number(tables[name], f"'{name}' in {where}") for name in _ARMING if name in tables},
    )
    hardware.actuator.check_deadlines()
    corners_m = as_polygon(arena["corners_m"], f"corners_m in [hardware.arena] of {path}")
    farthest_m = max(abs(coordinate) for corner in corners_m for coordinate in corner)
    if farthest_m > MAX_ARENA_M:
        raise ConfigError(
            f"corners_m in [hardware.arena] of {path} has a corner at {farthest_m:g} m; it must be at most "
            f"{MAX_ARENA_M:g} m (is it in another unit?)."
        )
    return RealCar(
        name=str(tables.get("name", path.stem)),
        hardware=hardware,
        mocap=from_table(MocapConfig, table("mocap"), f"[hardware.mocap] of {path}"),
        envelope=replace(envelope, arena_m=corners_m),
    )
