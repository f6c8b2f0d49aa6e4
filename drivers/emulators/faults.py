"""Faults of a wire, switched on and off while an emulator runs."""

from __future__ import annotations

import random
from dataclasses import dataclass, field

from carlab.core.errors import ActuatorFaultError
from drivers.links.link import CanFrame, FrameLink, LinkStatistics


@dataclass(slots=True)
class WireFaults:
    """What is wrong with the wire between host and firmware. Shares are of frames, both ways.

    ``is_silent`` swallows what the firmware says, ``is_deaf`` leaves unread what the host says (it backs up),
    ``drop_share`` loses frames, ``corrupt_share`` flips a bit in them, ``reply_delay_s`` holds replies back.
    """

    is_silent: bool = False
    is_deaf: bool = False
    drop_share: float = 0.0
    corrupt_share: float = 0.0
    reply_delay_s: float = 0.0
    seed: int = 0
    dropped: int = 0
    corrupted: int = 0
    _random: random.Random = field(init=False)

    def __post_init__(self) -> None:
        """Seed the dice."""
        self._random = random.Random(self.seed)

    def pass_on(self, data: bytes) -> bytes:
        """What is left of a frame after the wire: itself, one with a flipped bit, or nothing."""
        if self.drop_share and self._random.random() < self.drop_share:
            self.dropped += 1
            return b""
        if data and self.corrupt_share and self._random.random() < self.corrupt_share:
            self.corrupted += 1
            broken = bytearray(data)
            broken[self._random.randrange(len(broken))] ^= 1 << self._random.randrange(8)
            return bytes(broken)
        return data


class FaultyFrameLink:
    """A frame link with a switch: while ``failure`` is set every write and read raises it, as an unplugged bus does."""

    def __init__(self, link: FrameLink) -> None:
        self.link = link
        self.failure: str | None = None
        self.statistics: LinkStatistics = link.statistics

    def open(self) -> None:
        """Open the link."""
        self.link.open()

    def write(self, frame: CanFrame) -> None:
        """Write, or fail as switched."""
        self._fail()
        self.link.write(frame)

    def read(self) -> list[CanFrame]:
        """Read, or fail as switched."""
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
