"""The folder of one run: its files and the environment of the run.

runs/2026-11-21_134500_<name>/
    config.toml          the car file of the run
    environment.json     program, git, packages, host, start
    episodes/0001.mcap   one recording per episode, also as 0001.rrd
    episodes/stopped/    episodes of a learning run that a person ended or that have no tick; they are driven again
    models/0001/         learned models and policies of a learning run
    log.jsonl            the program's log, one JSON object per line
    result.json          the result of the run
    .lock                an empty file; the process of a run holds its lock
"""

from __future__ import annotations

import contextlib
import fcntl
import importlib.metadata
import itertools
import json
import logging
import os
import platform
import re
import shutil
import subprocess
import sys
import unicodedata
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Self

from carlab.core.clock import wall_clock_ns
from carlab.core.errors import ConfigError, DataError
from carlab.core.json_files import read_json
from carlab.core.version import VERSION
from carlab.recording.atomic_files import write_json
from carlab.recording.sink import writing

_PACKAGES = (
    *("numpy", "scipy", "torch", "gymnasium", "stable-baselines3", "rerun-sdk", "mcap", "protobuf", "pyarrow"),
    *("python-can", "pyserial", "cantools"),
)
log = logging.getLogger(__name__)

RESULT_FILE, LOCK_FILE = "result.json", ".lock"
_EPISODE_FILE = re.compile(r"(\d+)\.(?:mcap|rrd)(?:\.partial)?")


@dataclass(frozen=True, slots=True)
class RunDirectory:
    """A run's folder. Create one with ``create`` or resume one with ``open_existing``."""

    path: Path

    @classmethod
    def create(cls, root: Path | str, name: str, *, config_toml: str = "") -> Self:
        """Create ``root/<date>_<time>_<name>`` with the folder of its episodes, its configuration and environment.

        If this fails or is interrupted, no folder remains.

        Args:
            root: Folder of all runs, usually ``runs``.
            name: Name of the run; characters that are invalid in file names become ``-``.
            config_toml: The car file of the run.

        Raises:
            DataError: The folder cannot be written.
        """
        stamp = datetime.fromtimestamp(wall_clock_ns() * 1e-9).strftime("%Y-%m-%d_%H%M%S")
        slug = re.sub(r"[^\w.-]+", "-", unicodedata.normalize("NFC", name)).strip("-.") or "run"
        base = Path(root) / f"{stamp}_{slug}"
        if base.parent.exists() and not base.parent.is_dir():
            raise DataError(f"{base.parent} is a file, not a folder for runs; choose another folder.")
        facts = environment()
        with writing(base):
            base.parent.mkdir(parents=True, exist_ok=True)
            for number in itertools.count(1):
                path = base if number == 1 else base.with_name(f"{base.name}-{number}")
                with contextlib.suppress(FileExistsError):
                    path.mkdir()
                    break
            run = cls(path)
            try:
                run.episodes.mkdir()
                (path / "config.toml").write_text(config_toml, encoding="utf-8")
                run.write_json("environment.json", facts)
            except BaseException:
                shutil.rmtree(path, ignore_errors=True)
                raise
        return run

    @classmethod
    def open_existing(cls, path: Path | str) -> Self:
        """Resume a run.

        Raises:
            DataError: ``path`` is no run's folder, contains a symbolic link, or cannot be written.
        """
        path = Path(path)
        if not (path / "environment.json").is_file():
            raise DataError(
                f"{path} is not a run's folder (it has no environment.json); name one such as runs/2026-..."
            )
        if link := next((entry for entry in path.rglob("*") if entry.is_symlink()), None):
            raise DataError(
                f"{link} is a symbolic link, through which a run could write outside its folder; replace it by a copy."
            )
        run = cls(path)
        with writing(path):
            run.episodes.mkdir(exist_ok=True)
        return run

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Context in which no other process may write the run; the lock ends with the process at the latest.

        Raises:
            ConfigError: another run holds the lock.
            DataError: the file of the lock cannot be opened.
        """
        path = self.path / LOCK_FILE
        with writing(path):
            file = path.open("ab")
        with file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise ConfigError(f"{self.path} is in use by another run; wait until that run ends.") from error
            except OSError as error:  # a file system without locks
                log.warning("%s cannot be locked (%s); resume it in one process only.", self.path, error.strerror)
            yield

    @property
    def episodes(self) -> Path:
        """Folder of the recordings."""
        return self.path / "episodes"

    @property
    def stopped(self) -> Path:
        """Folder of the recordings of episodes that are driven again; it may be missing."""
        return self.episodes / "stopped"

    @property
    def models(self) -> Path:
        """Folder of the models and policies of a learning run; it is missing before the first one is written."""
        return self.path / "models"

    @property
    def config_toml(self) -> str:
        """The resolved configuration as text."""
        return (self.path / "config.toml").read_text(encoding="utf-8")

    def next_episode(self) -> int:
        """One more than the highest number of a complete or partial recording; numbers start at 1."""
        folders = (folder for folder in (self.episodes, self.stopped) if folder.is_dir())
        names = (_EPISODE_FILE.fullmatch(entry.name) for folder in folders for entry in folder.iterdir())
        return 1 + max((int(match[1]) for match in names if match), default=0)

    def episode_path(self, number: int, suffix: str = ".mcap") -> Path:
        """Path of a file of an episode: ``episodes/0001.mcap``."""
        return self.episodes / f"{number:04d}{suffix}"

    def move_to_stopped(self, recording: Path) -> None:
        """Move an episode's files into ``stopped``. Raises DataError if that fails."""
        with writing(self.stopped):
            self.stopped.mkdir(exist_ok=True)
            for file in (recording.with_suffix(".rrd"), recording):
                if file.is_file():
                    os.replace(file, self.stopped / file.name)

    def recordings(self, *, partial: bool = False) -> list[Path]:
        """The complete MCAP recordings in order; with ``partial`` also the incomplete ones.

        A file whose name is not the number of an episode, such as a copy, is no recording of the run.
        """
        ends = (".mcap", ".mcap.partial") if partial else (".mcap",)
        entries = [entry for entry in self.episodes.iterdir() if _EPISODE_FILE.fullmatch(entry.name)]
        return sorted(entry for entry in entries if entry.name.endswith(ends))

    def log_handler(self) -> logging.Handler:
        """A logging handler that appends to log.jsonl; the caller adds, removes and closes it.

        Raises:
            DataError: the file cannot be opened.
        """
        with writing(self.path / "log.jsonl"):
            handler = _LogFile(self.path / "log.jsonl", encoding="utf-8", errors="backslashreplace")
        handler.setLevel(logging.INFO)
        handler.setFormatter(JsonFormatter())
        return handler

    @property
    def result_rows(self) -> list[dict[str, Any]]:
        """The episodes in result.json; empty if the file is missing or cannot be read."""
        try:
            rows = read_json(self.path / RESULT_FILE)["episodes"]
            return [row for row in rows if isinstance(row, dict) and type(row.get("episode")) is int]
        except (OSError, ValueError, KeyError, TypeError):
            return []

    def write_json(self, name: str, content: Mapping[str, Any]) -> None:
        """Write a JSON file atomically. Raises DataError if that fails."""
        write_json(self.path / name, content, default=str)


class _LogFile(logging.FileHandler):
    """A log file that drops lines without an error while its disk is full; the recording reports the full disk."""

    def handleError(self, record: logging.LogRecord) -> None:
        """Drop a line that cannot be written; print the traceback of other errors."""
        if not isinstance(sys.exc_info()[1], OSError):
            super().handleError(record)

    def close(self) -> None:
        """Close the file; lines that cannot be written are dropped."""
        with contextlib.suppress(OSError):
            super().close()


class JsonFormatter(logging.Formatter):
    """Formats log records as JSON lines: time, level, logger, message and traceback if any."""

    def format(self, record: logging.LogRecord) -> str:
        """Format a record as one line of JSON."""
        line: dict[str, object] = {
            "time": datetime.fromtimestamp(record.created).astimezone().isoformat(timespec="milliseconds"),
            "level": record.levelname,
            "logger": record.name,
            "message": record.getMessage(),
            "thread": record.threadName,
        }
        if record.exc_info:
            line["traceback"] = self.formatException(record.exc_info)
        return json.dumps(line, ensure_ascii=False)


def environment() -> dict[str, Any]:
    """Environment of a run: versions, host, and the state of the sources in git."""
    packages = {}
    for name in _PACKAGES:
        try:
            packages[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return {
        "carlab": VERSION,
        "python": platform.python_version(),
        "host": platform.node(),
        "platform": platform.platform(),
        "cpu_count": os.cpu_count(),
        "command": sys.argv,
        "start": datetime.fromtimestamp(wall_clock_ns() * 1e-9).astimezone().isoformat(),
        "git": git_state(Path(__file__).parents[1]),
        "packages": packages,
    }


def git_state(folder: Path) -> dict[str, Any] | None:
    """Commit and whether tracked files differ from it (``dirty``); None outside a repository or without git.

    Git writes nothing to the repository: if ^C ended it while it wrote, its lock would block later git commands.
    """

    def git(*arguments: str) -> str:
        command = ("git", "--no-optional-locks", "-C", str(folder), *arguments)
        done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=10)
        return done.stdout.strip()

    try:
        return {"sha": git("rev-parse", "HEAD"), "dirty": bool(git("status", "--porcelain", "--untracked-files=no"))}
    except (OSError, subprocess.SubprocessError):
        return None
