"""What can go wrong between cameras and client, for the emulated server to do on purpose."""

from __future__ import annotations

import random
from dataclasses import dataclass

from mocap.natnet.models import BitstreamVersion


@dataclass(frozen=True, slots=True)
class ServerFaults:
    """Faults of an emulated server; assign a new one to ``NatNetServer.faults`` at any time. Shares are in [0, 1]."""

    latency_s: float = 0.0
    """Every frame leaves this much after it was due."""
    jitter_s: float = 0.0
    """And by a random delay up to this, which may swap frames."""
    loss: float = 0.0
    """Share of frames that are not sent."""
    occlusion: float = 0.0
    """Share of frames in which no body is tracked; 1 hides the bodies for good."""
    garbage: float = 0.0
    """Share of frames followed by a datagram of random bytes."""
    truncation: float = 0.0
    """Share of frames followed by half a frame."""
    repetition: float = 0.0
    """Share of frames that are sent twice."""
    frozen: bool = False
    """Frames go on with fresh stamps and repeat the last pose."""
    silent: bool = False
    """No frames at all."""
    deaf: bool = False
    """No answers to anything."""
    frame_version: BitstreamVersion | None = None
    """Frames are written in this version whatever was announced."""
    clock_offset_s: float = 0.0
    """Added to the server's clock."""
    clock_drift_ppm: float = 0.0
    """How much too fast the server's clock runs."""

    def garbled(self, datagram: bytes, rng: random.Random) -> list[bytes]:
        """What is sent in place of ``datagram``."""
        sent = [] if rng.random() < self.loss else [datagram]
        if sent and rng.random() < self.repetition:
            sent.append(datagram)
        if rng.random() < self.truncation:
            sent.append(datagram[: rng.randrange(len(datagram))])
        if rng.random() < self.garbage:
            sent.append(rng.randbytes(rng.randrange(1, 1400)))
        return sent
