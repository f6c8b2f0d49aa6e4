"""Faults of a wire that can be switched while an emulator runs."""

from __future__ import annotations

import random
from dataclasses import dataclass, field


@dataclass(slots=True)
class WireFaults:
    """Faults of the wire between host and firmware. Shares count frames in both directions.

    ``drops_replies`` drops all replies of the firmware, ``stops_reading`` leaves the bytes of the host unread until
    its buffer is full, ``drop_share`` loses frames, ``corrupt_share`` flips one bit.
    """

    drops_replies: bool = False
    stops_reading: bool = False
    drop_share: float = 0.0
    corrupt_share: float = 0.0
    seed: int = 0
    dropped: int = 0
    corrupted: int = 0
    _random: random.Random = field(init=False)

    def __post_init__(self) -> None:
        """Seed the random numbers."""
        self._random = random.Random(self.seed)

    def transmit(self, data: bytes) -> bytes:
        """Transmit a frame: unchanged, with one flipped bit, or lost (empty)."""
        if self.drop_share and self._random.random() < self.drop_share:
            self.dropped += 1
            return b""
        if data and self.corrupt_share and self._random.random() < self.corrupt_share:
            self.corrupted += 1
            broken = bytearray(data)
            broken[self._random.randrange(len(broken))] ^= 1 << self._random.randrange(8)
            return bytes(broken)
        return data
