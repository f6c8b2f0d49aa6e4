"""Car files by name or path."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from carlab.cars import CarFile


def load_car(car: str | Path | CarFile = "sim") -> CarFile:
    """Read a car file: the parameters of a simulator and, with ``[hardware]``, the configuration of the real car.

    Args:
        car: ``sim`` (the default car), a preset (``eth_rc_car``, ``dart_jetracer`` ...), the path of a TOML file, or
            a ``CarFile``, which is returned unchanged.

    Returns:
        The car file; ``simulator`` has its parameters in SI units, ``save`` writes it.

    Raises:
        ConfigError: the file does not exist or is invalid.
    """
    from carlab.cars import default_car, read_car

    return default_car() if car in ("sim", Path("sim")) else read_car(car)


def car_options_text(
    car: str | Path | CarFile,
    vehicle: str | Path | CarFile | None = None,
    reality: str | Path | CarFile | None = None,
    dry_run: bool = False,
) -> str:
    """Command-line options that select a car, each with a leading space; options with default values are omitted."""
    words = [] if car == "sim" else ["--car", car_name(car)]
    words += [] if vehicle is None else ["--vehicle", car_name(vehicle)]
    words += ["--dry-run"] if dry_run else []
    words += [] if reality is None else ["--reality", car_name(reality)]
    return "".join(f" {shlex.quote(word)}" for word in words)


def car_name(car: str | Path | CarFile) -> str:
    """The name or path of a car, as on the command line."""
    return str(car) if isinstance(car, (str, Path)) else car.name
