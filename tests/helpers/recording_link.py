"""A link of bytes or frames that records what is written."""

from __future__ import annotations

from typing import Any


class RecordingLink:
    """A link without a device."""

    def __init__(self) -> None:
        self.opens = 0
        self.written: list[Any] = []

    def open(self) -> None: ...
    def close(self) -> None: ...
    def fileno(self) -> None: ...
    def read(self) -> bytes:
        return b""

    def write(self, message: Any) -> None:
        self.written.append(message)
