"""``carlab check``."""

from __future__ import annotations

from dataclasses import dataclass, field

from tyro.conf import OmitArgPrefixes

from carlab.api.arguments import above_zero
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
        from carlab.cars.emulated_car import EmulatedCar
        from carlab.cars.latency import LatencyParts, measure_latency, measure_pose_latency

        above_zero(seconds=self.seconds)
        choice = self.which_car.choose(seed=0)
        banner(choice.car.reality, choice.car.name, moves=False)
        with choice.car as car:
            latency: LatencyParts | None = None
            try:
                latency = measure_pose_latency(car, seconds=self.seconds, period_s=choice.control_period_s)
                if self.wheels and isinstance(car, EmulatedCar):
                    latency = measure_latency(car, period_s=choice.control_period_s)
            except (NotReadyError, TimeoutError) as error:
                fail(str(error))
            health = car.health()
        if health.readings:
            rows = [[_label(name), f"{value:.4g}", _unit(name)] for name, value in health.readings.items()]
            table("Readings", ["reading", "value", "unit"], rows)
        if latency is not None and latency.parts:
            lines = [
                [name, f"{p50:.2f}", f"{p99:.2f}", f"{top:.2f}", str(count)]
                for name, p50, p99, top, count in latency.rows()
            ]
            table("Latency [ms]", ["part", "p50", "p99", "max", "samples"], lines)
        for problem in health.problems:
            fail(problem)
        ready = health.ready and latency is not None
        console.print("[green]Ready.[/green]" if ready else "[red]Not ready.[/red]")
        return 0 if ready else NotReadyError.exit_code


def _unit(name: str) -> str:
    return UNITS.get(name.rpartition("_")[2], "")


def _label(name: str) -> str:
    stem, _, unit = name.rpartition("_")
    return (stem if unit in UNITS and stem else name).replace("_", " ")
