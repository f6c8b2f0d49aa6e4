"""Car files by name or path."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from carlab.cars import CarFile


def load_car(car: str | Path | CarFile = "sim") -> CarFile:
    """Read a car file: the parameters of a simulator, and of the real car where it has ``[hardware]``.

    Args:
        car: ``sim`` (the default car), a car that comes with the package (``eth_rc_car``, ``dart_jetracer`` ...), or
            the path of a TOML file. A car file that was read comes back as it is.

    Returns:
        The car file; ``simulator`` has its parameters in SI units, ``save`` writes it.

    Raises:
        ConfigError: there is no such file, or it is wrong.
    """
    from carlab.cars import CarFile, default_car, load_car_file

    if isinstance(car, CarFile):
        return car
    return default_car() if str(car) == "sim" else load_car_file(Path(car))


def typed_car(
    car: str | CarFile,
    vehicle: Path | CarFile | None = None,
    reality: Path | CarFile | None = None,
    dry_run: bool = False,
) -> str:
    """The options that name a car on the command line, each with a space before it; nothing for those not needed."""
    words = [] if car == "sim" else ["--car", _word(car)]
    words += [] if vehicle is None else ["--vehicle", _word(vehicle)]
    words += ["--dry-run"] if dry_run else []
    words += [] if reality is None else ["--reality", _word(reality)]
    return "".join(f" {shlex.quote(word)}" for word in words)


def _word(car: str | Path | CarFile) -> str:
    return str(car) if isinstance(car, (str, Path)) else car.name
