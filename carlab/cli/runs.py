"""What verbs that drive a car have in common: the run's folder, and a person who puts the car at its start."""

from __future__ import annotations

import json
import logging
import shutil
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from carlab.cli.console import banner, console
from carlab.core.errors import ConfigError

if TYPE_CHECKING:
    from rich.progress import Progress

    from carlab.cars import CarChoice
    from carlab.core.quantities import CarState
    from carlab.experiment.session import EpisodeResult
    from carlab.recording.run_directory import RunDirectory


@contextmanager
def new_run(out: Path, name: str, choice: CarChoice, keep: str = "episodes") -> Iterator[RunDirectory]:
    """A run's folder, with the program's log in it. It goes again where nothing came into its folder ``keep``."""
    from carlab.recording.run_directory import RunDirectory

    run = RunDirectory.create(out, name, config_toml=choice.config_toml)
    try:
        with _logged(run, choice):
            yield run
    finally:
        if not any((run.path / keep).iterdir()):
            shutil.rmtree(run.path, ignore_errors=True)


@contextmanager
def existing_run(path: Path, choice: CarChoice) -> Iterator[RunDirectory]:
    """A run's folder that is taken up again, with the program's log going on in it."""
    from carlab.recording.run_directory import RunDirectory

    run = RunDirectory.open_existing(path)
    with _logged(run, choice):
        yield run


@contextmanager
def _logged(run: RunDirectory, choice: CarChoice) -> Iterator[None]:
    choice.log_to(run.path)
    banner(choice.car.reality, choice.car.name)
    handler = run.log_handler()
    logging.getLogger().addHandler(handler)
    try:
        yield
    finally:
        logging.getLogger().removeHandler(handler)
        handler.close()


def write_result(run: RunDirectory, results: list[EpisodeResult]) -> None:
    """Write result.json: each episode's end and figures, after those of a run that was taken up again."""
    from carlab.recording.run_directory import RESULT_FILE

    path = run.path / RESULT_FILE
    try:
        before = list(json.loads(path.read_text(encoding="utf-8"))["episodes"])
    except (OSError, ValueError, KeyError, TypeError):
        before = []
    now = {result.episode for result in results}
    episodes = [e for e in before if e.get("episode") not in now] + [
        {
            "episode": result.episode,
            "ticks": result.data.ticks,
            "return": result.total_reward,
            **{name: float(value) for name, value in result.summary.items()},
            "end_reason": result.reason.name,
            "end_detail": result.data.metadata["end_detail"],
        }
        for result in results
    ]
    run.write_result({"end_reason": results[-1].reason.name, "episodes": episodes})


def ask_to_place(bar: Progress, otherwise: str) -> Callable[[CarState], None]:
    """Ask the person there to put the car at a start. ^C at the question ends the run like ^C while driving."""

    def ask(start: CarState) -> None:
        text = f"Put the car at x {start.x_m:.2f} m, y {start.y_m:.2f} m, yaw {start.yaw_rad:.2f} rad"
        if not sys.stdin.isatty():
            raise ConfigError(f"{text}: nobody is at the keyboard to confirm it; {otherwise}.")
        bar.stop()
        handler = signal.signal(signal.SIGINT, signal.default_int_handler)
        interrupted = False
        try:
            console.input(f"{text}, step back and press Enter. ")
        except (KeyboardInterrupt, EOFError):
            interrupted = True
        finally:
            signal.signal(signal.SIGINT, handler)
        if interrupted:
            signal.raise_signal(signal.SIGINT)
        bar.start()

    return ask
