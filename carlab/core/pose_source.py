"""What a car needs of a motion-capture system."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol, Self, runtime_checkable

from carlab.core.quantities import PoseSample


@runtime_checkable
class PoseSource(Protocol):
    """Delivers poses of one rigid body in ``map``. Constructing does nothing; ``open`` connects."""

    def open(self) -> None:
        """Connect and start to receive. Idempotent. Raises NotReadyError with every reason."""

    def latest(self) -> PoseSample | None:
        """The newest sample, tracked or not; None before the first. Never blocks."""

    def since(self, sequence: int) -> tuple[PoseSample, ...]:
        """Samples received after the one with this sequence number, oldest first (a bounded number is kept)."""

    def wait_for(self, sequence: int, timeout_s: float) -> PoseSample | None:
        """Block until a sample newer than ``sequence`` is there; None after ``timeout_s``."""

    def statistics(self) -> Mapping[str, float]:
        """Rates, losses and latencies; the names end in their units."""

    def close(self) -> None:
        """Disconnect. Idempotent, and safe after a failed open."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *exc_info: object) -> None: ...
