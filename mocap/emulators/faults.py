"""Faults between cameras and client that the emulated server can simulate."""

from __future__ import annotations

import random
from dataclasses import dataclass

from mocap.natnet.models import BitstreamVersion


@dataclass(frozen=True, slots=True)
class ServerFaults:
    """Faults of an emulated server; may be assigned to ``NatNetServer.faults`` at any time. Shares are in [0, 1]."""

    latency_s: float = 0.0
    """Delay of every frame."""
    jitter_s: float = 0.0
    """Upper limit of an additional random delay, which may reorder frames."""
    loss: float = 0.0
    """Share of frames that are not sent."""
    occlusion: float = 0.0
    """Share of frames in which no body is tracked."""
    garbage: float = 0.0
    """Share of frames followed by a datagram of random bytes."""
    truncation: float = 0.0
    """Share of frames followed by half a frame."""
    repetition: float = 0.0
    """Share of frames that are sent twice."""
    frozen: bool = False
    """Frames repeat the last pose with fresh stamps."""
    server_mode: int = 0
    """Answer to the request for the mode: 0 for live, otherwise the poses may be those of a recorded take."""
    no_frames: bool = False
    """The server sends no frames."""
    no_answers: bool = False
    """The server answers no message."""
    frame_version: BitstreamVersion | None = None
    """Version of the frames, instead of the announced version."""
    clock_offset_s: float = 0.0
    """Added to the server's clock."""
    clock_drift_ppm: float = 0.0
    """Rate error of the server's clock; positive if it runs fast."""

    def apply(self, datagram: bytes, rng: random.Random) -> list[bytes]:
        """Datagrams that are sent instead of ``datagram``."""
        sent = [] if rng.random() < self.loss else [datagram]
        if sent and rng.random() < self.repetition:
            sent.append(datagram)
        if rng.random() < self.truncation:
            sent.append(datagram[: rng.randrange(len(datagram))])
        if rng.random() < self.garbage:
            sent.append(rng.randbytes(rng.randrange(1, 1400)))
        return sent
