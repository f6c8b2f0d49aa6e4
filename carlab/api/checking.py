"""Check whether a car can be armed."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from carlab.api.arguments import above_zero
from carlab.api.runs import html_table
from carlab.api.tasks import given_task, load_checked
from carlab.core.errors import ActuatorFaultError, NotReadyError
from carlab.core.quantities import Health
from carlab.core.task import Task
from carlab.experiment.episodes.hooks import RunHooks

if TYPE_CHECKING:
    from carlab.cars import CarFile
    from carlab.cars.latency import LatencyParts


@dataclass(frozen=True)
class CarCheck:
    """Result of ``carlab.check``.

    Attributes:
        health: readings by name, which ends in the unit, and problems and warnings as sentences.
        latency: samples [s] of each part of the latency; None if no pose arrived.
        problems: why the car is not ready; empty if it is ready.
    """

    health: Health
    latency: LatencyParts | None
    problems: tuple[str, ...]

    @property
    def is_ready(self) -> bool:
        """Whether the car can be armed."""
        return self.health.ready and self.latency is not None

    def __repr__(self) -> str:
        """Ready, or the problems."""
        return "<CarCheck ready>" if self.is_ready else f"<CarCheck not ready: {'; '.join(self.problems)}>"

    def _repr_html_(self) -> str:
        parts = [] if self.latency is None else self.latency.rows()
        lines = [["ready", "yes" if self.is_ready else "no"]]
        lines += [["problem", text] for text in self.problems] + [["warning", text] for text in self.health.warnings]
        return (
            html_table(["check", "result"], lines)
            + html_table(["reading", "value"], [[*item] for item in self.health.readings.items()])
            + html_table(["latency [ms]", "p50", "p99", "max", "samples"], parts)
        )


def check(
    car: str | Path | CarFile = "sim",
    *,
    task: str | Task | None = None,
    track: Path | str | None = None,
    seconds: float = 2.0,
    wheels: bool = True,
    vehicle: str | Path | CarFile | None = None,
    reality: str | Path | CarFile | None = None,
    dry_run: bool = False,
    hooks: RunHooks | None = None,
) -> CarCheck:
    """Open a car without moving it, and measure health, rates and latency of each part.

    On a car with a motor controller no command is sent for a while, to measure the controller's time-out.

    Args:
        car: as for ``carlab.drive``.
        task: a task to check first, before anything is opened: as for ``carlab.drive``; None: none.
        track: as for ``carlab.drive``.
        seconds: duration of the motion-capture measurement [s].
        wheels: on an emulated car, also steer at rest to measure the latency of a command; a real car does not move.
        vehicle: as for ``carlab.drive``.
        reality: as for ``carlab.drive``.
        dry_run: as for ``carlab.drive``.
        hooks: ``on_start`` is called before the car is opened.

    Returns:
        Readings, latency and problems; ``is_ready`` states whether the car can be armed.

    Raises:
        ConfigError: an argument is invalid, or the task has an error.
        NotReadyError, ActuatorFaultError: the hardware cannot be opened.
    """
    from carlab.cars import choose_car
    from carlab.cars.emulated_car import EmulatedCar
    from carlab.cars.latency import measure_latency, measure_pose_latency
    from drivers.hardware_car import HardwareCar

    above_zero(seconds=seconds)
    choice = choose_car(car, vehicle=vehicle, reality=reality, dry_run=dry_run, seed=0)
    if (chosen := given_task(task, track, choice.track)) is not None:
        load_checked(chosen, choice.envelope.arena_m)
    (hooks or RunHooks()).on_start(Path(), choice.car)
    latency: LatencyParts | None = None
    problems: list[str] = []
    with choice.car as opened:
        try:
            latency = measure_pose_latency(opened, seconds=seconds, period_s=choice.control_period_s)
            if wheels and isinstance(opened, EmulatedCar):
                latency = measure_latency(opened, period_s=choice.control_period_s)
        except (NotReadyError, TimeoutError) as error:
            problems.append(str(error))
        hardware = opened.hardware if isinstance(opened, EmulatedCar) else opened
        if isinstance(hardware, HardwareCar):
            with contextlib.suppress(ActuatorFaultError):  # ``health`` has the fault
                hardware.measure_motor_timeout()
        health = opened.health()
    problems += [problem for problem in health.problems if not any(problem in known for known in problems)]
    return CarCheck(health, latency, tuple(problems))
