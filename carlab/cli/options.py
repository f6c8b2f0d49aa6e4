"""Options that several verbs share, and how they become cars and policies."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from carlab.api.cars import typed_car
from carlab.core.errors import ConfigError, DataError

if TYPE_CHECKING:
    from carlab.cars import CarChoice


@dataclass
class CarOptions:
    """Which car."""

    car: str = "sim"
    """sim, emulated (serial), emulated-can, a car that comes along (eth_rc_car, dart_jetracer ...: simulated), or
    FILE.toml: with [hardware] that real car, else that simulated one."""

    vehicle: Path | None = None
    """Car file whose physics and motion capture sim and emulated use in place of the default car's."""

    dry_run: bool = False
    """Real inputs, but no command is sent."""

    reality: Path | None = None
    """Car file whose physics a simulated or emulated car has in truth: what differs from its own file is concealed from
    everything that learns and diagnoses, and reaches it through recordings alone."""

    def arguments(self) -> dict[str, Any]:
        """These options as arguments of the calls that drive."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def typed(self) -> str:
        """These options as one would type them, each with a space before it; nothing for those that need no word."""
        return typed_car(**self.arguments())

    def choose(self, *, seed: int, log_folder: Path | None = None) -> CarChoice:
        """Build the car; nothing is opened yet."""
        from carlab.cars import choose_car

        given = self.arguments()
        return choose_car(given.pop("car"), **given, seed=seed, log_folder=log_folder)


def new_file(path: Path, option: str, suffix: str) -> Path:
    """The path, where it has that suffix and nothing is there; ConfigError or DataError otherwise."""
    if path.suffix != suffix:
        raise ConfigError(f"{option} {path}: name a file that ends in {suffix}.")
    if path.exists():
        raise DataError(f"{path} is there already; remove it or choose another {option}.")
    return path


def json_file(path: Path, option: str) -> Path:
    """The path, where a JSON file may be written; ConfigError otherwise."""
    if path.suffix != ".json" or path.is_dir():
        raise ConfigError(f"{option} {path}: name a file that ends in .json.")
    if not path.parent.is_dir():
        raise ConfigError(f"{option} {path}: there is no folder {path.parent}; make it first.")
    return path
