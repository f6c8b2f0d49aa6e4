"""Log of the commands and events of an emulated firmware, with times on the host's monotonic clock."""

from __future__ import annotations

import errno
import json
import logging
import queue
import threading
from collections import deque
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TextIO

logger = logging.getLogger(__name__)

MAX_ENTRIES = 500_000
MOTOR_NAMES = frozenset({"current", "brake", "duty", "rpm"})


@dataclass(frozen=True, slots=True)
class LogEntry:
    """A decoded command (``current``, ``brake``, ``duty``, ``rpm``, ``servo``, ``firmware``, ``values``, ``alive``)
    or an event (``open``, ``first_byte``, ``hang_up``, ``motor_timeout``, ``unplug``, ``replug``, ``close``).
    """  # noqa: D205

    t_s: float
    name: str
    value: float = 0.0


class CommandLog:
    """Entries in memory and, if a path is given, in a file of JSON lines, each of which is flushed.

    A thread writes the file, since a busy disk would delay the emulated firmware. The file is for people. If it cannot
    be written, the log warns once and continues in memory. It does not warn if the folder is missing: a run that ends
    before its first episode removes its folder.
    """

    def __init__(self, path: Path | None = None) -> None:
        self.path = path
        self._entries: deque[LogEntry] = deque(maxlen=MAX_ENTRIES)
        self._lock = threading.Condition()
        self._unwritten: queue.SimpleQueue[LogEntry | None] = queue.SimpleQueue()
        self._writer: threading.Thread | None = None

    def open(self) -> None:
        """Open the file if a path was given; entries are appended. Idempotent."""
        if self.path is None or self._writer is not None:
            return
        try:
            file = self.path.open("a", encoding="utf-8")
        except FileNotFoundError:
            return
        except OSError as error:
            self._warn(error)
            return
        self._unwritten = queue.SimpleQueue()
        self._writer = threading.Thread(target=self._write, args=(file,), name="command-log", daemon=True)
        self._writer.start()

    def add(self, t_s: float, name: str, value: float = 0.0) -> None:
        """Append an entry, without waiting for the file."""
        entry = LogEntry(t_s, name, value)
        with self._lock:
            self._entries.append(entry)
            if self._writer is not None and self._writer.is_alive():
                self._unwritten.put(entry)
            self._lock.notify_all()

    def entries(self, *names: str, since_s: float = float("-inf")) -> list[LogEntry]:
        """Entries with one of ``names`` (all if none is given) from ``since_s`` on, oldest first."""
        with self._lock:
            return [e for e in self._entries if (not names or e.name in names) and e.t_s >= since_s]

    def motor(self, since_s: float = float("-inf")) -> list[LogEntry]:
        """Motor commands, oldest first."""
        return self.entries(*MOTOR_NAMES, since_s=since_s)

    def wait_for(self, name: str, timeout_s: float, since_s: float = float("-inf")) -> LogEntry | None:
        """Wait for the first entry of that name from ``since_s`` on; None after ``timeout_s``."""
        with self._lock:
            self._lock.wait_for(lambda: self._first(name, since_s) is not None, timeout_s)
            return self._first(name, since_s)

    def close(self) -> None:
        """Write the last entries and close the file; the entries in memory stay."""
        self._unwritten.put(None)
        if self._writer is not None:
            self._writer.join()
            self._writer = None

    def _write(self, file: TextIO) -> None:
        """Body of the writer thread."""
        try:
            with file:
                while (entry := self._unwritten.get()) is not None:
                    file.write(json.dumps(asdict(entry)) + "\n")
                    file.flush()
        except OSError as error:
            self._warn(error)

    def _warn(self, error: OSError) -> None:
        logger.warning(
            "The log of the emulated firmware cannot be written to %s (%s); %s.",
            self.path,
            error.strerror or error,
            _remedy(error),
        )

    def _first(self, name: str, since_s: float) -> LogEntry | None:
        return next((e for e in self._entries if e.name == name and e.t_s >= since_s), None)


def _remedy(error: OSError) -> str:
    """What a person can do about a log file that cannot be written."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return "free some disk space"
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        return "check its permissions or choose another file"
    return "choose another file"


def read_log(path: Path) -> list[LogEntry]:
    """Read the entries of a JSON-lines file, also while it is being written (an incomplete last line is ignored)."""
    lines = path.read_text(encoding="utf-8").split("\n")[:-1] if path.exists() else []
    return [LogEntry(**json.loads(line)) for line in lines]
