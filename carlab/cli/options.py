"""Options that several verbs share, and how they become cars and policies."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from carlab.core.errors import ConfigError

if TYPE_CHECKING:
    from carlab.cars import CarChoice


@dataclass
class CarOptions:
    """Which car."""

    car: str = "sim"
    """sim (physics in this process), emulated (the whole hardware path over a pty and UDP, with fake firmware and fake
    motion capture), emulated-can (the same over a CAN bus), or a FILE.toml: with [hardware] a real car, else that
    simulated one."""

    vehicle: Path | None = None
    """A car file whose physics and motion capture sim and emulated use instead of the default car's."""

    dry_run: bool = False
    """Real inputs, but no command is sent."""

    def choose(self, *, seed: int, log_folder: Path | None = None) -> CarChoice:
        """Build the car; nothing is opened yet."""
        from carlab.cars import choose_car

        return choose_car(self.car, vehicle=self.vehicle, dry_run=self.dry_run, seed=seed, log_folder=log_folder)


def required_file(path: Path, what: str) -> Path:
    """The path, where it is a file; ConfigError otherwise."""
    if not path.exists():
        raise ConfigError(f"{what} '{path}' does not exist; check the path.")
    if path.is_dir():
        raise ConfigError(f"{what} '{path}' is a folder; name a file in it.")
    return path
