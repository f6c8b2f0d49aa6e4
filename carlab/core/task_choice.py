"""The task of ``--task``: one of carlab's by name, or a class in a user's file that the command line names.

A run folder keeps the name of a task and its track, and of a user's task the SHA-256 of its file; never code.
"""

from __future__ import annotations

import functools
import hashlib
import inspect
import shlex
import sys
import types
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from carlab.core.errors import ConfigError
from carlab.core.path_tasks import LapTask, PathTask
from carlab.core.task import ObstacleParkingTask, ParkingTask, Task
from carlab.core.track import Track, track_from_table

TASKS: dict[str, type[Task]] = {
    "parking": ParkingTask,
    "obstacles": ObstacleParkingTask,
    "path": PathTask,
    "laps": LapTask,
}


@dataclass(frozen=True, slots=True)
class TaskChoice:
    """A task that another process and a later run can find again.

    Attributes:
        name: a key of ``TASKS``, or FILE.py:CLASS without the folder of the file.
        track: of ``laps``; None: the default oval.
        sha256: of a user's file; empty for a task of carlab.
        file: path of a user's file; a run folder does not keep it.
        given: a task of a Python program, which is used as it is.
    """

    name: str = "parking"
    track: Track | None = None
    sha256: str = ""
    file: str = ""
    given: Task | None = None

    def load(self) -> Task:
        """Make the task; a user's file is executed. Raises ConfigError if that fails or the file has changed."""
        if self.given is not None:
            return self.given
        if self.track is not None:
            return LapTask(track=self.track)
        if self.name in TASKS:
            return TASKS[self.name]()
        return _task_of_file(self.file, self.name.rpartition(":")[2], self.sha256)

    def to_table(self) -> dict[str, Any]:
        """Values for the JSON file of a run folder."""
        track = None if self.track is None else self.track.to_table()
        return {"name": self.name, "sha256": self.sha256, "track": track}

    @classmethod
    def from_table(cls, table: Mapping[str, Any]) -> TaskChoice:
        """Read the output of ``to_table``; runs no code. Raises TypeError, KeyError or ValueError."""
        name, sha256, track = table["name"], table["sha256"], table["track"]
        if not (isinstance(name, str) and isinstance(sha256, str) and (sha256 or name in TASKS)):
            raise ValueError(f"unknown task {name!r}")
        if track is not None and (sha256 or TASKS[name] is not LapTask):
            raise ValueError(f"the task {name} has no track")
        return cls(name, None if track is None else track_from_table(track, "the run's track"), sha256)

    def named_again(self, given: TaskChoice | None) -> TaskChoice:
        """The task of an earlier run, with the file that a person names again.

        Raises:
            ConfigError: the file is needed and not given, or another task is given.
        """
        if given is None:
            if self.sha256:
                raise ConfigError(
                    f"This run has the task {self.name}, whose code a run folder does not keep; name the file again: "
                    f"--task {shlex.quote(f'PATH/{self.name}')}."
                )
            return self
        if given.name != self.name or (given.track is not None and given.track != self.track):
            track = " on another track" if given.name == self.name else ""
            raise ConfigError(
                f"--task {given.name}: this run was started with {self.name}{track}; remove the option, or start a new "
                "run."
            )
        if given.sha256 != self.sha256:
            raise ConfigError(
                f"--task {given.name}: the file differs from the one that this run was started with (SHA-256 "
                f"{given.sha256[:8]}, not {self.sha256[:8]}); restore it, or start a new run."
            )
        return given if self.sha256 else self


def choose_task(task: str | Task, track: Track | None = None) -> TaskChoice:
    """The task of a name, of FILE.py:CLASS, or of an object. Raises ConfigError for an unknown one.

    ``track`` is for ``laps``, by default the oval.
    """
    if isinstance(task, type):
        raise ConfigError(f"--task {task.__name__}: it is a class; give an object of it, {task.__name__}(...).")
    if not isinstance(task, str):
        return TaskChoice(type(task).__name__, sha256=_source_sha256(type(task)), given=task)
    if track is not None and task != "laps":
        raise ConfigError(f"--track needs --task laps; --task {task} has none.")
    if task in TASKS:
        return TaskChoice(task, track)
    file, _, class_name = task.rpartition(":")
    if task.endswith(".py"):
        raise ConfigError(f"--task {task}: add the name of the class, for example {task}:MyTask.")
    if not file.endswith(".py") or not class_name.isidentifier():
        raise ConfigError(f"--task {task}: choose one of {', '.join(TASKS)}, or FILE.py:CLASS.")
    path = Path(file).absolute()
    return TaskChoice(f"{path.name}:{class_name}", sha256=_sha256(_read(path)), file=str(path))


def _source_sha256(kind: type) -> str:
    """SHA-256 of the file that defines a class; of its name if there is no file."""
    try:
        return _sha256(Path(inspect.getfile(kind)).read_bytes())
    except (OSError, TypeError):
        return _sha256(kind.__qualname__.encode())


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise ConfigError(f"--task: {path} cannot be read ({error.strerror}); name an existing file.") from error


@functools.lru_cache(maxsize=8)
def _task_of_file(file: str, class_name: str, sha256: str) -> Task:
    """Execute a user's file and make a task of one of its classes."""
    path = Path(file)
    content = _read(path)
    if _sha256(content) != sha256:
        raise ConfigError(f"--task: {path.name} was changed during the run; restore it, or start a new run.")
    module = types.ModuleType(f"carlab_task_{sha256[:16]}")
    module.__file__ = file
    sys.modules[module.__name__] = module  # Dataclasses look their module up.
    try:
        exec(compile(content, file, "exec"), module.__dict__)
    except (Exception, SystemExit) as error:
        raise ConfigError(f"--task: {path.name} cannot be loaded: {type(error).__name__}: {error}.") from error
    kind = module.__dict__.get(class_name)
    if not isinstance(kind, type):
        classes = [n for n, v in module.__dict__.items() if isinstance(v, type) and v.__module__ == module.__name__]
        known = f"; it has {', '.join(classes)}" if classes else ""
        raise ConfigError(f"--task: {path.name} has no class {class_name}{known}.")
    if not issubclass(kind, Task):
        raise ConfigError(
            f"--task: {class_name} in {path.name} is not derived from carlab.core.task.Task; write "
            f"'class {class_name}(Task):'."
        )
    try:
        return kind()
    except (Exception, SystemExit) as error:
        raise ConfigError(f"--task: {class_name}() fails: {type(error).__name__}: {error}.") from error


PARKING = TaskChoice()
