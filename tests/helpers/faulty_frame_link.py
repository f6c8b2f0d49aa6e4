"""A CAN bus that fails on command."""

from __future__ import annotations

from carlab.core.errors import ActuatorFaultError
from drivers.links.link import CanFrame, FrameLink


class FaultyFrameLink:
    """A frame link whose writes and reads raise ActuatorFaultError while ``failure`` is set, like an unplugged bus."""

    def __init__(self, link: FrameLink) -> None:
        self.link = link
        self.failure: str | None = None
        self.opens = 0

    def open(self) -> None:
        """Open the link."""
        self.link.open()

    def write(self, frame: CanFrame) -> None:
        """Write, or raise the failure."""
        self._fail()
        self.link.write(frame)

    def read(self) -> list[CanFrame]:
        """Read, or raise the failure."""
        self._fail()
        return self.link.read()

    def fileno(self) -> int | None:
        """The link's descriptor."""
        return self.link.fileno()

    def close(self) -> None:
        """Close the link."""
        self.link.close()

    def _fail(self) -> None:
        if self.failure is not None:
            raise ActuatorFaultError(self.failure)
