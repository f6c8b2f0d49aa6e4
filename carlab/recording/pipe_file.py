"""A file that is written through a pipe, so that the writer never gets an error.

rerun writes files in its own thread. If that thread gets an error (full disk), later calls and the program's exit may
wait for ever. Here rerun writes to a pipe that is always read; errors occur in this module and are stored.
"""

from __future__ import annotations

import contextlib
import os
import select
import threading
from pathlib import Path
from typing import IO

_READ_BYTES = 1 << 16
_POLL_S = 0.1


class PipeFile:
    """Copies a pipe into a file, which must not exist, in a separate thread."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: IO[bytes] | None = None
        self._ends: tuple[int, int] | None = None
        self._thread: threading.Thread | None = None
        self._complete = threading.Event()
        self._error: OSError | None = None

    def open(self) -> None:
        """Create the file. Raises OSError."""
        self._file = self._path.open("xb", buffering=0)

    def start(self) -> Path:
        """Start copying; returns the path that the writer must open. Raises OSError before ``open``."""
        if self._file is None:
            raise OSError(f"{self._path} is not open")
        self._ends = os.pipe()
        self._thread = threading.Thread(
            target=self._copy, args=(self._ends[0], self._file), name="carlab-rrd", daemon=True
        )
        self._thread.start()
        return Path(f"/dev/fd/{self._ends[1]}")

    def check(self) -> None:
        """Raise the stored OSError of writing, if any."""
        if self._error is not None:
            raise self._error

    def close(self, timeout_s: float = 5.0) -> None:
        """Copy the rest of the pipe and close the file after the writer has closed its end. Idempotent."""
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
            complete = self._complete.is_set()  # read before polling, so that no bytes remain in the pipe
            if not select.select([end], [], [], 0.0 if complete else _POLL_S)[0]:
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
