"""Clocks and pacing. Apart from threads and processes at the wire, only this module reads the time."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np


@runtime_checkable
class Clock(Protocol):
    """A monotonic clock with a sleep function."""

    def now_s(self) -> float:
        """Time on this clock [s]; only differences are meaningful."""

    def sleep_until(self, t_s: float) -> None:
        """Sleep until ``now_s()`` reaches ``t_s``; returns at once if it has."""


class MonotonicClock:
    """The host's monotonic clock (``time.monotonic``), shared by all processes of the host."""

    def now_s(self) -> float:
        """Seconds of the host's monotonic clock."""
        return time.monotonic()

    def sleep_until(self, t_s: float) -> None:
        """Sleep until an absolute deadline, so that errors do not accumulate."""
        while (left_s := t_s - time.monotonic()) > 0:
            time.sleep(left_s)


class SimulatedClock:
    """A clock that advances only by ``sleep_until``: simulated episodes run faster than real time."""

    def __init__(self, start_s: float = 0.0) -> None:
        self._now_s = start_s

    def now_s(self) -> float:
        """Simulated seconds."""
        return self._now_s

    def sleep_until(self, t_s: float) -> None:
        """Advance to ``t_s``; never goes back."""
        self._now_s = max(self._now_s, t_s)


def wall_clock_ns() -> int:
    """Unix time [ns], for stamping files only."""
    return time.time_ns()


@dataclass(frozen=True, slots=True)
class TickTiming:
    """Deadline and lateness of a tick on the pacer's clock, and the number of skipped deadlines."""

    deadline_s: float
    late_s: float
    skipped: int


@dataclass(slots=True)
class Pacer:
    """Absolute deadlines one period apart; missed deadlines are skipped and counted."""

    clock: Clock
    period_s: float
    late_s: list[float] = field(default_factory=list)
    skipped: int = 0
    _start_s: float | None = None
    _periods: int = 0

    def start(self) -> float:
        """Set the first deadline to now and return it [s]."""
        self._start_s, self._periods = self.clock.now_s(), 0
        return self._start_s

    def wait(self) -> TickTiming:
        """Sleep until the next future deadline; returns the lateness of the wake-up."""
        start_s = self.start() if self._start_s is None else self._start_s
        behind_s = self.clock.now_s() - (start_s + (self._periods + 1) * self.period_s)
        skipped = int(behind_s // self.period_s) if behind_s >= self.period_s else 0
        self._periods += 1 + skipped
        deadline_s = start_s + self._periods * self.period_s
        self.clock.sleep_until(deadline_s)
        late_s = self.clock.now_s() - deadline_s
        self.skipped += skipped
        self.late_s.append(late_s)
        return TickTiming(deadline_s, late_s, skipped)

    def statistics_ms(self) -> dict[str, float]:
        """Lateness percentiles [ms] and the count of skipped ticks."""
        p50, p99, top = np.percentile(self.late_s or [0.0], [50, 99, 100]) * 1e3
        return {
            "late_p50_ms": float(p50),
            "late_p99_ms": float(p99),
            "late_max_ms": float(top),
            "skipped": float(self.skipped),
        }
