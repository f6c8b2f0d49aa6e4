"""``carlab listen``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from rich.text import Text
from tyro.conf import arg

from carlab.api.arguments import above_zero
from carlab.cli.console import console, fail, readings_table
from carlab.cli.options import ARGUMENT_DEFAULT, arguments_of, options_of
from carlab.core.clock import MonotonicClock
from carlab.core.errors import ConfigError
from carlab.experiment.episodes.interrupts import Interrupts
from mocap.config import MocapConfig


@dataclass
@options_of(MocapConfig)
class Listen:
    """Print motion-capture frames on arrival, and statistics: pose, rate, latency, losses."""

    car: Path | None = None
    """Car file with [hardware.mocap], which replaces the options below."""

    server_address: Annotated[str, arg(name="server")] = ARGUMENT_DEFAULT
    local_interface: Annotated[str, arg(name="interface")] = ARGUMENT_DEFAULT
    mode: Literal["unicast", "multicast"] = ARGUMENT_DEFAULT
    command_port: int = ARGUMENT_DEFAULT
    body: str = ARGUMENT_DEFAULT
    body_id: int | None = ARGUMENT_DEFAULT
    bitstream: str = ARGUMENT_DEFAULT
    up_axis: Literal["y", "z"] = ARGUMENT_DEFAULT

    seconds: float | None = None
    """Duration [s]; by default until ^C."""

    verbose: bool = False
    """Show the whole log."""

    def run(self) -> int:
        """Print four frames per second and new problems of the poses, then the statistics and the last problems."""
        from carlab.cars import load_car_file
        from mocap.rigid_body import RigidBodyPoseSource

        above_zero(seconds=self.seconds)
        config = MocapConfig(**arguments_of(self, MocapConfig))
        if self.car is not None:
            real = load_car_file(self.car).real
            if real is None:
                raise ConfigError(f"{self.car} has no [hardware]; give --server and --body instead.")
            config = real.mocap
        clock = MonotonicClock()
        with Interrupts() as interrupts, RigidBodyPoseSource(config) as source:
            end_s = float("inf") if self.seconds is None else clock.now_s() + self.seconds
            sequence = -1
            shown: set[str] = set()
            while not interrupts.requested.is_set() and clock.now_s() < end_s:
                sample = source.wait_for(sequence, 0.5)
                if sample is None:
                    console.print("no frame for half a second", style="yellow")
                    continue
                sequence = sample.sequence
                age_ms = (sample.t_receive_s - sample.t_capture_s) * 1e3
                console.print(
                    f"frame {sample.sequence:8d}  x {sample.x_m:+8.4f} m  y {sample.y_m:+8.4f} m  "
                    f"yaw {sample.yaw_rad:+7.4f} rad  latency {age_ms:5.1f} ms",
                    Text("" if sample.tracked else " not tracked", "yellow"),
                )
                problems = source.problems()
                for problem in problems:
                    if problem not in shown:
                        fail(problem)
                shown.update(problems)
                clock.sleep_until(min(clock.now_s() + 0.25, end_s))
            statistics, problems = source.statistics(), source.problems()
        readings_table("Stream", statistics)
        for problem in problems:
            fail(problem)
        return 0
