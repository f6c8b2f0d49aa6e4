"""What a wire offers to a device: bytes or frames, and what has passed over it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True, slots=True)
class CanFrame:
    """A data frame with a 29-bit identifier."""

    identifier: int
    data: bytes


@dataclass(slots=True)
class LinkStatistics:
    """Counts since the link was constructed."""

    bytes_out: int = 0
    bytes_in: int = 0
    frames_out: int = 0
    frames_in: int = 0
    writes: int = 0
    discarded_bytes: int = 0
    error_frames: int = 0
    opens: int = 0


class ByteLink(Protocol):
    """A stream of bytes. Constructing does nothing. Every failure after ``open`` is an ActuatorFaultError."""

    statistics: LinkStatistics

    def open(self) -> None:
        """Connect; raises NotReadyError with the next step."""

    def write(self, data: bytes) -> None:
        """Hand over all bytes within the link's write time-out, or raise; never leaves old bytes waiting."""

    def read(self) -> bytes:
        """What has arrived; empty where there is nothing. Never blocks."""

    def fileno(self) -> int | None:
        """A descriptor that becomes readable when bytes arrive; None where there is none."""

    def close(self) -> None:
        """Disconnect in bounded time. Idempotent; safe after a failure."""


class FrameLink(Protocol):
    """A bus of frames, like ``ByteLink``."""

    statistics: LinkStatistics

    def open(self) -> None:
        """Connect; raises NotReadyError with the next step."""

    def write(self, frame: CanFrame) -> None:
        """Send a frame at once or raise; never queue it for later."""

    def read(self) -> list[CanFrame]:
        """Frames that have arrived, oldest first. Never blocks."""

    def fileno(self) -> int | None:
        """A descriptor that becomes readable when frames arrive; None where there is none."""

    def close(self) -> None:
        """Disconnect in bounded time. Idempotent; safe after a failure."""
