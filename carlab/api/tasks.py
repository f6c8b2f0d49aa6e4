"""The argument ``task`` of ``drive``, ``learn`` and ``check``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from carlab.core.keep_out import Corners
    from carlab.core.task import Task
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
    return choose_task(task or "laps", given or (car_track if task == "laps" else None))


def load_checked(choice: TaskChoice, arena_m: Corners) -> Task:
    """Make the task; check it if it is a user's or has a path. Raises ConfigError with the error of the task.

    Args:
        choice: the task.
        arena_m: arena of the car; empty without one.
    """
    from carlab.core.task import RecordedTask
    from carlab.experiment.episodes.task_check import check_task

    task = choice.load()
    if not isinstance(task, RecordedTask) and (choice.sha256 or task.path_m):
        check_task(task, arena_m)
    return task
