"""Interfaces of links: byte streams and frame buses, with the number of openings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True, slots=True)
class CanFrame:
    """A data frame with a 29-bit identifier."""

    identifier: int
    data: bytes


class ByteLink(Protocol):
    """A byte stream. Constructing does nothing. Every failure after ``open`` is an ActuatorFaultError."""

    @property
    def opens(self) -> int:
        """Number of openings since construction."""

    def open(self) -> None:
        """Connect. Raises NotReadyError with the remedy."""

    def write(self, data: bytes) -> None:
        """Write all bytes within the write time-out, or raise; unsent bytes are discarded."""

    def read(self) -> bytes:
        """Bytes that have arrived; may be empty. Never blocks."""

    def fileno(self) -> int | None:
        """File descriptor that becomes readable when bytes arrive; None if there is none."""

    def close(self) -> None:
        """Disconnect in bounded time. Idempotent; safe after a failure."""


class FrameLink(Protocol):
    """A frame bus, otherwise like ``ByteLink``."""

    @property
    def opens(self) -> int:
        """Number of openings since construction."""

    def open(self) -> None:
        """Connect. Raises NotReadyError with the remedy."""

    def write(self, frame: CanFrame) -> None:
        """Send a frame at once or raise, without a queue of this program."""

    def read(self) -> list[CanFrame]:
        """Frames that have arrived, oldest first. Never blocks."""

    def fileno(self) -> int | None:
        """File descriptor that becomes readable when frames arrive; None if there is none."""

    def close(self) -> None:
        """Disconnect in bounded time. Idempotent; safe after a failure."""
