"""Options that several verbs share, and how they become cars and policies."""

from __future__ import annotations

import os
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

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

    def typed(self) -> str:
        """These options as one would type them, each with a space before it; nothing for those that need no word."""
        words = [] if self.car == CarOptions().car else ["--car", self.car]
        words += [] if self.vehicle is None else ["--vehicle", str(self.vehicle)]
        words += ["--dry-run"] if self.dry_run else []
        return "".join(f" {shlex.quote(word)}" for word in words)

    def choose(self, *, seed: int, log_folder: Path | None = None) -> CarChoice:
        """Build the car; nothing is opened yet."""
        from carlab.cars import choose_car

        return choose_car(self.car, vehicle=self.vehicle, dry_run=self.dry_run, seed=seed, log_folder=log_folder)


def has_screen() -> bool:
    """Whether a window can be opened."""
    return sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


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


def above_zero(**values: float | None) -> None:
    """Raise ConfigError for an option that is not a finite number above zero; None is none given."""
    for name, value in values.items():
        if value is not None and not 0.0 < value < float("inf"):
            raise ConfigError(f"--{name} {value:g}: a number above zero.")


def required_file(path: Path, what: str) -> Path:
    """The path, where it is a file; ConfigError otherwise."""
    if not path.exists():
        raise ConfigError(f"{what} '{path}' does not exist; check the path.")
    if path.is_dir():
        raise ConfigError(f"{what} '{path}' is a folder; name a file in it.")
    return path
