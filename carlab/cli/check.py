"""``carlab check``."""

from __future__ import annotations

from dataclasses import dataclass, field

from rich.text import Text
from tyro.conf import OmitArgPrefixes

from carlab.api.checking import check
from carlab.cli.console import banner, console, fail, readings_table, table, warn
from carlab.cli.options import ARGUMENT_DEFAULT, CarOptions, TaskOptions, arguments_of, options_of
from carlab.core.errors import NotReadyError
from carlab.experiment.episodes.hooks import RunHooks


@dataclass
@options_of(check)
class Check:
    """Open a car without moving it, and measure health, rates and latency of each part.

    On a car with a motor controller no command is sent for a while, to measure the controller's time-out.

    With --task, first find errors of shape and unit in a task.

    Exit code 0 if the car is ready to be armed, 3 if not; all reasons are listed.
    """

    car: OmitArgPrefixes[CarOptions] = field(default_factory=CarOptions)

    task: OmitArgPrefixes[TaskOptions] = field(default_factory=TaskOptions)

    seconds: float = ARGUMENT_DEFAULT
    wheels: bool = ARGUMENT_DEFAULT

    verbose: bool = False
    """Show the whole log."""

    def run(self) -> int:
        """Check and print."""
        hooks = RunHooks(on_start=lambda folder, car: banner(car.reality, car.name, moves=False))
        result = check(**arguments_of(self, check), hooks=hooks)
        if self.task.to_text():
            console.print("No error found in the task.")
        if result.health.readings:
            readings_table("Readings", result.health.readings)
        if result.latency is not None and result.latency.parts:
            lines = [
                [name, *(f"{ms:z.2f}" for ms in (p50, p99, top)), str(count)]
                for name, p50, p99, top, count in result.latency.rows()
            ]
            table("Latency [ms]", ["part", "p50", "p99", "max", "samples"], lines)
        for warning in result.health.warnings:
            warn(warning)
        for problem in result.problems:
            fail(problem)
        console.print(Text("Ready.", "green") if result.is_ready else Text("Not ready.", "red"))
        return 0 if result.is_ready else NotReadyError.exit_code
