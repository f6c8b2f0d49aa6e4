"""The interface of motion-capture systems."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol, Self, runtime_checkable

from carlab.core.quantities import PoseSample


@runtime_checkable
class PoseSource(Protocol):
    """Source of poses of one rigid body in ``map``. Constructing does nothing; ``open`` connects."""

    def open(self) -> None:
        """Connect and start receiving. Idempotent. Raises NotReadyError with all reasons."""

    def latest(self) -> PoseSample | None:
        """The newest sample, tracked or not; None before the first. Never blocks."""

    def since(self, sequence: int) -> tuple[PoseSample, ...]:
        """Samples received after this sequence number, oldest first; only a bounded number is stored."""

    def wait_for(self, sequence: int, timeout_s: float) -> PoseSample | None:
        """Wait for a sample after ``sequence``; None after ``timeout_s``."""

    def statistics(self) -> Mapping[str, float]:
        """Rates, losses and latencies; the names end in their units."""

    def problems(self) -> tuple[str, ...]:
        """Reasons why the poses may be wrong (a wrong axis, invalid poses ...), as sentences with remedies.

        Empty without a reason. Does not block.
        """

    def close(self) -> None:
        """Disconnect. Idempotent, and safe after a failed open."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *exc_info: object) -> None: ...
