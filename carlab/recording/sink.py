"""Sinks: the common base of the file writers of an episode's documents."""

from __future__ import annotations

import contextlib
import errno
import math
import os
import shutil
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from carlab.core.documents import Document, EpisodeEnded, EpisodeStarted, Tick, Transition
from carlab.core.errors import DataError
from carlab.core.outcome import EndReason

PARTIAL_SUFFIX = ".partial"
DISK_FULL = frozenset({errno.ENOSPC, errno.EDQUOT})
MIN_FREE_BYTES = 20_000_000
"""Minimum free space of the disk for a new recording [bytes]."""
TOO_LITTLE_SPACE = f"less than {MIN_FREE_BYTES / 1e6:.0f} MB are free"


@dataclass(frozen=True, slots=True)
class LogLine:
    """One line of the program's log. ``level`` is the number of the standard library's logging (20 is INFO)."""

    wall_ns: int
    level: int
    name: str
    message: str


Item = Document | LogLine


def partial_path(path: Path) -> Path:
    """Path of an incomplete file: ``0001.mcap`` -> ``0001.mcap.partial``."""
    return path.with_name(path.name + PARTIAL_SUFFIX)


def claim(path: Path) -> Path:
    """Create the folder of a new file and return its ``.partial`` path.

    Raises OSError, before the car moves, if the file exists or the disk is nearly full.
    """
    if path.exists():
        raise FileExistsError(errno.EEXIST, "is already there", str(path))
    make_folder(path.parent)
    if shutil.disk_usage(path.parent).free < MIN_FREE_BYTES:
        raise OSError(errno.ENOSPC, TOO_LITTLE_SPACE, str(path))
    return partial_path(path)


def make_folder(folder: Path) -> None:
    """Create a folder and its parents. Raises OSError if a file has that path."""
    if folder.exists() and not folder.is_dir():
        raise NotADirectoryError(errno.ENOTDIR, "is a file", str(folder))
    folder.mkdir(parents=True, exist_ok=True)


def describe_os_error(error: OSError, path: Path | str) -> str:
    """One sentence with the remedy for a file that could not be written."""
    if error.errno in DISK_FULL:
        space = f"free some space{_disk_of(Path(path))}"
        why = TOO_LITTLE_SPACE if error.strerror == TOO_LITTLE_SPACE else "the disk is full"
        return f"{path} could not be written because {why}; {space} and start again."
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        return f"{path} may not be written; check the permissions of its folder or choose another folder."
    if isinstance(error, FileExistsError) and str(error.filename).endswith(PARTIAL_SUFFIX):
        return (
            f"{error.filename} exists: another command writes it, or one was interrupted; move or remove this file if "
            "no command writes it, or choose another name."
        )
    if isinstance(error, FileExistsError):
        return f"{path} exists and recordings are never overwritten; choose another name."
    if isinstance(error, NotADirectoryError):
        return f"{path} cannot be created because a file has the path of its folder; choose another folder."
    if isinstance(error, FileNotFoundError):
        return (
            f"{path} could not be written because its folder does not exist; create the folder or choose another one."
        )
    return f"{path} could not be written: {error.strerror or error}; check the disk, then start again."


@contextlib.contextmanager
def writing(path: Path | str) -> Iterator[None]:
    """Context that writes ``path``. Raises DataError, with the remedy, in place of OSError."""
    try:
        yield
    except OSError as error:
        raise DataError(describe_os_error(error, path)) from error


def _disk_of(path: Path) -> str:
    """The disk of a path and its free space, as text; empty if unknown."""
    folder = path.absolute()
    while not os.path.ismount(folder) and folder != folder.parent:
        folder = folder.parent
    try:
        return f" on the disk of {folder} ({shutil.disk_usage(folder).free / 1e6:.1f} MB free)"
    except OSError:
        return ""


class Sink(ABC):
    """Writer of the documents of one episode.

    Constructing does nothing. ``open`` creates the file; ``write`` takes documents in order, and an EpisodeEnded
    completes the file at once. Later documents are ignored, so that the first EpisodeEnded of any thread counts.
    ``close`` before an EpisodeEnded completes the file as CRASHED. Calls must come from one thread at a time.
    """

    def __init__(self) -> None:
        self._started: EpisodeStarted | None = None
        self._early: list[Item] = []
        self._finished = False
        self._last_t_s = math.nan
        self._steps = 0
        self._total_reward = 0.0

    @abstractmethod
    def open(self) -> None:
        """Create the file. Raises DataError if that fails."""

    @abstractmethod
    def flush(self) -> None:
        """Pass everything written so far to the system, so that a kill loses none. Raises OSError if that fails."""

    @abstractmethod
    def abandon(self) -> None:
        """Release all resources and leave the file unchanged; never raises."""

    @abstractmethod
    def _write(self, item: Item) -> None:
        """Write one document; the EpisodeStarted comes first."""

    @abstractmethod
    def _finish(self) -> None:
        """Complete the file and rename it; called after an EpisodeEnded."""

    @property
    def finished(self) -> bool:
        """Whether the file is complete or abandoned, so that no more is written."""
        return self._finished

    def write(self, item: Item) -> None:
        """Write one document or log line. Raises OSError or DataError if that fails."""
        if self._finished:
            return
        if isinstance(item, EpisodeStarted):
            if self._started is not None:
                raise DataError("A second episode was sent to a file of one; make a new recorder for each episode.")
            self._started = item
            self._last_t_s = item.t_s
            self._write(item)
            early, self._early = self._early, []
            for waiting in early:
                self.write(waiting)
            return
        if self._started is None:
            self._early.append(item)
            return
        if isinstance(item, Tick):
            self._steps = item.step + 1
        elif isinstance(item, Transition):
            self._total_reward += item.reward
        if not isinstance(item, LogLine):
            self._last_t_s = item.t_s
        self._write(item)
        if isinstance(item, EpisodeEnded):
            self._finish()
            self._finished = True

    def close(self, reason: EndReason = EndReason.CRASHED, detail: str = "") -> None:
        """Complete the file. An episode that has not ended is marked with ``reason``. Idempotent.

        Raises the errors of ``write``.
        """
        if self._finished:
            return
        if self._started is None:
            self.abandon()
            self._finished = True
            return
        self.write(EpisodeEnded(self._last_t_s, reason, detail, self._steps, self._total_reward))
