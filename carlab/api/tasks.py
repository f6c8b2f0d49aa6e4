"""The argument ``task`` of ``drive``, ``learn`` and ``check``."""

from __future__ import annotations

import pickle
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from carlab.core.errors import ConfigError
from carlab.core.keep_out import Corners
from carlab.core.task import Task
from carlab.experiment.episodes.task_check import check_task

if TYPE_CHECKING:
    from carlab.core.task_choice import TaskChoice
    from carlab.core.track import Track


def given_task(task: str | Task | None, track: Path | str | None, car_track: Track | None) -> TaskChoice | None:
    """The task of the arguments; None without one.

    Args:
        task: name, FILE.py:CLASS, or an object; None with ``track``: laps.
        track: CSV file of ``laps``.
        car_track: track of the car file, for ``laps`` without a CSV file.

    Raises:
        ConfigError: unknown task, or an error in the track.
    """
    from carlab.core.task_choice import choose_task
    from carlab.core.track import read_track

    if task is None and track is None:
        return None
    given = None if track is None else read_track(track)
    return choose_task("laps" if task is None else task, given or (car_track if task == "laps" else None))


def check_trainable(choice: TaskChoice) -> None:
    """Raise ConfigError if the process that trains cannot import the class of a task object."""
    if choice.given is None:
        return
    main_file = getattr(sys.modules["__main__"], "__file__", None)
    try:
        pickle.dumps(choice.given)
        reason = "it is defined in a notebook or at a prompt"
        is_importable = choice.given.__module__ != "__main__" or (main_file is not None and Path(main_file).is_file())
    except Exception as error:
        reason, is_importable = str(error), False
    if not is_importable:
        raise ConfigError(
            f"The process that trains cannot import the task {choice.name} ({reason}); define its class at the top "
            "level of a file, and import it or name it as FILE.py:CLASS."
        )


def load_checked(choice: TaskChoice, arena_m: Corners) -> Task:
    """Make the task and check it. Raises ConfigError with the error of the task.

    Args:
        choice: the task.
        arena_m: arena of the car; empty without one.
    """
    task = choice.load()
    check_task(task, arena_m)
    return task
