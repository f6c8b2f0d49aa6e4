"""``carlab check``."""

from __future__ import annotations

from dataclasses import dataclass, field

from tyro.conf import OmitArgPrefixes

from carlab.api.runs import RunHooks
from carlab.cli.console import banner, console, fail, table
from carlab.cli.options import CarOptions
from carlab.core.errors import NotReadyError

UNITS = {"v": "V", "ms": "ms", "s": "s", "hz": "Hz", "ppm": "ppm", "erpm": "eRPM", "count": "", "flag": ""}


@dataclass
class Check:
    """Open everything and move nothing: health, rates and latency of each part.

    Exit code 0 where the car is ready to be armed, 3 where it is not; the reasons are listed together.
    """

    which_car: OmitArgPrefixes[CarOptions] = field(default_factory=CarOptions)

    seconds: float = 2.0
    """How long to watch motion capture."""

    wheels: bool = True
    """On an emulated car, also steer at standstill to measure the way of a command; a real car never moves."""

    verbose: bool = False
    """Show the whole log."""

    def run(self) -> int:
        """Check and print."""
        from carlab.api import check

        hooks = RunHooks(on_start=lambda folder, car: banner(car.reality, car.name, moves=False))
        found = check(**self.which_car.arguments(), seconds=self.seconds, wheels=self.wheels, hooks=hooks)
        if readings := found.health.readings:
            rows = [[_label(name), f"{value:.4g}", _unit(name)] for name, value in readings.items()]
            table("Readings", ["reading", "value", "unit"], rows)
        if found.latency is not None and found.latency.parts:
            lines = [
                [name, f"{p50:.2f}", f"{p99:.2f}", f"{top:.2f}", str(count)]
                for name, p50, p99, top, count in found.latency.rows()
            ]
            table("Latency [ms]", ["part", "p50", "p99", "max", "samples"], lines)
        for problem in found.problems:
            fail(problem)
        console.print("[green]Ready.[/green]" if found.is_ready else "[red]Not ready.[/red]")
        return 0 if found.is_ready else NotReadyError.exit_code


def _unit(name: str) -> str:
    return UNITS.get(name.rpartition("_")[2], "")


def _label(name: str) -> str:
    stem, _, unit = name.rpartition("_")
    return (stem if unit in UNITS and stem else name).replace("_", " ")
