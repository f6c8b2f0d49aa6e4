"""A file that takes whatever another writer sends through a pipe, and remembers errors instead of passing them on.

rerun writes files in a thread of its own; when that thread meets a full disk, later calls may wait for ever, and so
may the program's exit. Through a pipe that is always emptied rerun never meets an error: they all happen here.
"""

from __future__ import annotations

import contextlib
import os
import select
import threading
from pathlib import Path
from typing import IO

_READ_BYTES = 1 << 16
_LOOK_S = 0.1


class DrainedFile:
    """Copies a pipe into a new file in a thread of its own.

    Args:
        path: The file to make; must not be there yet.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: IO[bytes] | None = None
        self._ends: tuple[int, int] | None = None
        self._thread: threading.Thread | None = None
        self._complete = threading.Event()
        self._error: OSError | None = None

    def open(self) -> None:
        """Make the file. Raises OSError."""
        self._file = self._path.open("xb", buffering=0)

    def start(self) -> Path:
        """Start to copy; returns the path that the other writer must open."""
        if self._file is None:
            raise OSError(f"{self._path} is not open")
        self._ends = os.pipe()
        self._thread = threading.Thread(
            target=self._copy, args=(self._ends[0], self._file), name="carlab-rrd", daemon=True
        )
        self._thread.start()
        return Path(f"/dev/fd/{self._ends[1]}")

    def check(self) -> None:
        """Raise the OSError that writing met, if any."""
        if self._error is not None:
            raise self._error

    def close(self, timeout_s: float = 5.0) -> None:
        """Copy what is still in the pipe and close the file; the other writer has closed its end. Idempotent."""
        self._complete.set()
        if self._thread is not None and self._thread.is_alive():
            self._thread.join(timeout_s)
            if self._thread.is_alive():
                return
        if self._ends is not None:
            for end in self._ends:
                os.close(end)
            self._ends = None
        if self._file is not None:
            with contextlib.suppress(OSError):
                self._file.close()

    def _copy(self, end: int, file: IO[bytes]) -> None:
        while True:
            complete = self._complete.is_set()  # asked before looking, so that nothing is left in the pipe
            if not select.select([end], [], [], 0.0 if complete else _LOOK_S)[0]:
                if complete:
                    break
                continue
            data = os.read(end, _READ_BYTES)
            if not data:
                break
            if self._error is None:
                try:
                    view = memoryview(data)
                    while view:
                        view = view[file.write(view) :]
                except OSError as error:
                    self._error = error
        if self._error is None:
            try:
                os.fsync(file.fileno())
            except OSError as error:
                self._error = error
