"""Counts and percentiles of a stream of frames. Pure: times are arguments."""

from __future__ import annotations

from collections import deque

import numpy as np

REORDER_WINDOW = 100
"""A frame number this far back means that the server has restarted its count."""
RESTART_RUN = 10
"""So does this number of consecutive late frames with increasing numbers."""
MALFORMED_RUN = 10
"""Number of consecutive datagrams that cannot be decoded after which the stream counts as unreadable."""


class StreamStatistics:
    """Classifies frames by their numbers; collects counts and latencies."""

    def __init__(self, window: int = 1000) -> None:
        self.frames = 0
        self.lost = 0
        self.out_of_order = 0
        self.repeated = 0
        self.malformed = 0
        self.malformed_run = 0
        self.foreign = 0
        self.mistimed = 0
        self.restarts = 0
        self.foreign_address = ""
        self.last_error = ""
        self._newest: int | None = None
        self._missing: set[int] = set()
        self._late_run = (0, 0)
        self._base = 0
        self._received_s: deque[float] = deque(maxlen=window)
        self._latency_s: deque[float] = deque(maxlen=window)
        self._system_latency_s: deque[float] = deque(maxlen=window)

    def accept(self, frame_number: int, received_s: float) -> int | None:
        """Count a frame; return its sequence number, or None for a repeated or late frame.

        Sequence numbers are the server's frame numbers with an offset after a restart of the server, so that they
        keep increasing.
        """
        self.malformed_run = 0
        if self._newest is None:
            self._newest = frame_number - 1
        step = frame_number - self._newest
        if step <= -REORDER_WINDOW or (step <= 0 and self._is_restart(frame_number)):
            self.restarts += 1
            self._base += self._newest + 1 - frame_number
            self._missing.clear()
            step = 1
        elif step <= 0:
            self._count_late(frame_number)
            return None
        if step > 1:
            self.lost += step - 1
            self._missing.update(range(max(self._newest + 1, frame_number - REORDER_WINDOW), frame_number))
            self._missing = {n for n in self._missing if n > frame_number - REORDER_WINDOW}
        self._late_run = (0, 0)
        self._newest = frame_number
        self.frames += 1
        self._received_s.append(received_s)
        return frame_number + self._base

    def _is_restart(self, frame_number: int) -> bool:
        length, before = self._late_run
        self._late_run = (length + 1 if length and frame_number > before else 1, frame_number)
        return self._late_run[0] >= RESTART_RUN

    def _count_late(self, frame_number: int) -> None:
        """Count a frame that is late (out of order) or repeated."""
        if frame_number in self._missing:
            self._missing.remove(frame_number)
            self.lost -= 1
            self.out_of_order += 1
        else:
            self.repeated += 1

    def add_latency(self, latency_s: float, system_latency_s: float) -> None:
        """Add the latencies [s] from exposure to arrival, and from exposure to transmission (server stamps)."""
        self._latency_s.append(latency_s)
        self._system_latency_s.append(system_latency_s)

    def add_malformed(self, text: str) -> None:
        """Count a datagram that could not be decoded."""
        self.malformed += 1
        self.malformed_run += 1
        self.last_error = text

    def rate_hz(self) -> float:
        """Mean rate over the frames in the window; NaN for fewer than two."""
        times = self._received_s
        if len(times) < 2 or times[-1] <= times[0]:
            return float("nan")
        return (len(times) - 1) / (times[-1] - times[0])

    def as_mapping(self) -> dict[str, float]:
        """All counts and percentiles; NaN if not measured."""
        p50, p99 = _percentiles_ms(self._latency_s)
        return {
            "frames": float(self.frames),
            "lost": float(self.lost),
            "out_of_order": float(self.out_of_order),
            "repeated": float(self.repeated),
            "malformed": float(self.malformed),
            "foreign": float(self.foreign),
            "mistimed": float(self.mistimed),
            "restarts": float(self.restarts),
            "rate_hz": self.rate_hz(),
            "latency_p50_ms": p50,
            "latency_p99_ms": p99,
            "server_latency_p50_ms": _percentiles_ms(self._system_latency_s)[0],
        }


def _percentiles_ms(values_s: deque[float]) -> tuple[float, float]:
    if not values_s:
        return float("nan"), float("nan")
    p50, p99 = np.percentile(np.array(values_s), [50, 99]) * 1e3
    return float(p50), float(p99)
