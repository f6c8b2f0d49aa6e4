"""Interfaces of links: byte streams and frame buses, with the number of openings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, TypeVar


@dataclass(frozen=True, slots=True)
class CanFrame:
    """A data frame with a 29-bit identifier."""

    identifier: int
    data: bytes


Written = TypeVar("Written", contravariant=True)
Read = TypeVar("Read", covariant=True)


class Link(Protocol[Written, Read]):
    """A link. Constructing does nothing. Every failure after ``open`` is an ActuatorFaultError."""

    @property
    def opens(self) -> int:
        """Number of openings since construction."""

    def open(self) -> None:
        """Connect. Raises NotReadyError with the remedy."""

    def write(self, item: Written, /) -> None:
        """Send all bytes within the write time-out (unsent ones are discarded), or a frame at once; else raise."""

    def read(self) -> Read:
        """Bytes (may be empty) or frames that have arrived, oldest first. Does not block."""

    def fileno(self) -> int | None:
        """File descriptor that becomes readable when bytes or frames arrive; None if there is none."""

    def close(self) -> None:
        """Disconnect in bounded time. Idempotent; safe after a failure."""


ByteLink = Link[bytes, bytes]
"""A byte stream."""
FrameLink = Link[CanFrame, list[CanFrame]]
"""A frame bus, without a queue of this program."""
