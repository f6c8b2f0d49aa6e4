"""Callbacks of runs and searches that several verbs share, and figures of tasks in tables."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import termios
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.progress import Progress

from carlab.cli.console import banner, console, fail, progress
from carlab.cli.exit_codes import EXIT_SAFETY_STOP
from carlab.core.car import Car
from carlab.core.errors import ConfigError
from carlab.core.outcome import EndReason
from carlab.core.quantities import CarState
from carlab.experiment.episodes.interrupts import Interrupts


def ask_to_place(bar: Progress, otherwise: str) -> Callable[[CarState], None]:
    """Create a prompt to place the car at a start pose. ^C at the prompt ends the run like ^C while driving.

    Only a line that is typed after the prompt confirms: the car moves then.
    """

    def ask(start: CarState) -> None:
        text = f"Put the car at x {start.x_m:.2f} m, y {start.y_m:.2f} m, yaw {start.yaw_rad:.2f} rad"
        if not sys.stdin.isatty():
            raise ConfigError(f"{text}: the confirmation needs a terminal; {otherwise}.")
        bar.stop()
        handler = signal.signal(signal.SIGINT, signal.default_int_handler)
        interrupted = False
        try:
            with contextlib.suppress(termios.error):  # the terminal was closed: its end follows
                termios.tcflush(sys.stdin, termios.TCIFLUSH)
            console.input(f"{text}, step back and press Enter. ")
        except (KeyboardInterrupt, EOFError):
            interrupted = True
        finally:
            signal.signal(signal.SIGINT, handler)
        if interrupted:
            console.print()  # the end of the prompt's line
            signal.raise_signal(signal.SIGINT)
        bar.start()

    return ask


def common_hooks(bar: Progress) -> dict[str, Any]:
    """Callbacks of runs with a policy: the car's banner, the prompt to place it, and the end of a hung run."""
    folders: list[Path] = []

    def on_start(folder: Path, car: Car) -> None:
        folders.append(folder)
        banner(car.reality, car.name)

    def on_abandon(reason: EndReason, detail: str) -> None:
        fail(f"{reason.sentences(detail)} The recording is in {folders[-1]}.")
        os._exit(EXIT_SAFETY_STOP)

    place_by_hand = ask_to_place(bar, "use --no-place or a terminal")
    return {"on_start": on_start, "place_by_hand": place_by_hand, "on_abandon": on_abandon}


@contextmanager
def search_callbacks(name: str) -> Iterator[dict[str, Any]]:
    """Callbacks ``progress`` and ``stop`` of a search: a bar in percent, and ^C. A second ^C ends the program."""
    with Interrupts(second_raises=True) as interrupts, progress() as bar:
        row = bar.add_task(name, total=100, note="")
        yield {
            "progress": lambda activity, share: bar.update(row, completed=round(100 * share), note=activity),
            "stop": interrupts.requested.is_set,
        }


def heading(name: str) -> str:
    """Heading of a column for a figure whose name ends in its unit."""
    stem, _, unit = name.rpartition("_")
    units = {"m": "m", "rad": "rad", "mps": "m/s", "s": "s"}
    return f"{stem.replace('_', ' ')}\n[{units[unit]}]" if unit in units else name.replace("_", " ")


def figure_text(name: str, value: float) -> str:
    """A figure of a task for a table."""
    if value != value:
        return "-"
    if name == "success":
        return "yes" if value else "no"
    return f"{value:.0f}" if name == "violations" else f"{value:.2f}"
