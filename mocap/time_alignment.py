"""Server clock to host monotonic clock, from echoes of small round-trip time. Pure: all times are arguments.

An echo sent at t0 and received at t2 on the host's clock was stamped t1 on the server's between them, so the host's
time of t1 is (t0 + t2) / 2, wrong by at most half the round trip. The quickest echo of each short interval is kept,
and a line through those of the last minute gives offset and drift (Cristian 1989, "Probabilistic clock
synchronization"; the line by least squares with a prior on the drift).
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

INTERVAL_S = 1.0
"""Of the echoes of one interval only the quickest counts."""
MAX_ROUND_TRIP_S = 1.0
"""Slower echoes are taken for garbage."""
WINDOW = 60
"""Intervals that are kept."""
DRIFT_PRIOR = 100e-6
"""Standard deviation of the drift [s/s] before anything is known: crystals are within 100 ppm."""
STEP_LIMIT_S = 5e-3
"""An echo this far beyond its own uncertainty off the line tells of a server clock that was set anew."""
TRANSIT_LIMIT_S = 1.0
"""No frame takes longer on the server, and one that takes longer on the way waited or bears a stamp from before."""
STEP_COUNT = 3
"""Echoes in a row that must agree on such a step before the past is forgotten."""


@dataclass(frozen=True, slots=True)
class Echo:
    """A finished echo: server and host time of the same moment, and the round trip [s]."""

    server_s: float
    host_s: float
    round_trip_s: float


@dataclass(frozen=True, slots=True)
class Exposure:
    """When a frame was exposed, on the host's clock.

    ``is_aligned`` is False where that had to be estimated from the time of arrival; ``is_odd`` is True where the stamps
    and the time of arrival do not go together, so that a new echo is worth sending at once.
    """

    capture_s: float
    on_server_s: float
    is_aligned: bool
    is_odd: bool = False


class ClockAlignment:
    """Maps ticks of the server's clock to the host's monotonic clock."""

    def __init__(self, clock_hz: float) -> None:
        self.clock_hz = clock_hz
        self.echoes = 0
        self.resets = 0
        self._best: deque[Echo] = deque(maxlen=WINDOW)
        self._interval: int | None = None
        self._strangers = 0
        self._reference: Echo | None = None
        self._offset_s = 0.0
        self._drift = 0.0

    @property
    def is_aligned(self) -> bool:
        """True once there was an echo."""
        return self._reference is not None

    @property
    def is_uncertain(self) -> bool:
        """True while the last echoes suggest that the server clock was set anew."""
        return self._strangers > 0

    @property
    def drift_ppm(self) -> float:
        """How much faster the host's clock runs than the server's [ppm]."""
        return self._drift * 1e6

    @property
    def round_trip_s(self) -> float:
        """Smallest round trip among the echoes in use [s]; NaN before the first."""
        return min((echo.round_trip_s for echo in self._best), default=float("nan"))

    def add_echo(self, sent_s: float, server_ticks: int, received_s: float) -> None:
        """Take one echo: host time sent, server's stamp, host time received.

        One with a round trip below zero or beyond MAX_ROUND_TRIP_S says nothing and is ignored.
        """
        round_trip_s = received_s - sent_s
        if not 0.0 <= round_trip_s <= MAX_ROUND_TRIP_S or self.clock_hz <= 0.0:
            return
        echo = Echo(server_ticks / self.clock_hz, 0.5 * (sent_s + received_s), round_trip_s)
        self.echoes += 1
        if self._reference is not None:
            off_s = abs(echo.host_s - self._to_host(echo.server_s))
            self._strangers = self._strangers + 1 if off_s > STEP_LIMIT_S + 0.5 * round_trip_s else 0
            if 0 < self._strangers < STEP_COUNT:
                return
            if self._strangers >= STEP_COUNT:
                self._forget()
        interval = int(received_s / INTERVAL_S)
        if interval != self._interval:
            self._interval = interval
            self._best.append(echo)
        elif round_trip_s < self._best[-1].round_trip_s:
            self._best[-1] = echo
        else:
            return
        self._fit()

    def to_host_s(self, server_ticks: int) -> float:
        """Host monotonic time [s] of a server stamp; NaN before the first echo."""
        return self._to_host(server_ticks / self.clock_hz) if self._reference is not None else float("nan")

    def exposure(self, exposed_ticks: int, transmit_ticks: int, received_s: float) -> Exposure:
        """Moment of exposure of a frame that arrived at ``received_s`` [s, host monotonic].

        Without stamps or a clock it is the time of arrival; without an echo, that less the time on the server. The
        same where the stamps lie after the arrival, which cannot be: the server's clock was set anew. One too far
        before it may be true, of a frame that waited, and is kept.

        Args:
            exposed_ticks: Server stamp of the exposure, 0 for none.
            transmit_ticks: Server stamp of the transmission, 0 for none.
            received_s: Host time of arrival.
        """
        if exposed_ticks <= 0 or self.clock_hz <= 0.0:
            return Exposure(received_s, 0.0, is_aligned=False)
        on_server_s = max(transmit_ticks - exposed_ticks, 0) / self.clock_hz
        if on_server_s > TRANSIT_LIMIT_S:
            on_server_s = 0.0  # stamps of two clocks: no frame spends so long there
        if self._reference is None:
            return Exposure(received_s - on_server_s, on_server_s, is_aligned=False)
        capture_s = self._to_host(exposed_ticks / self.clock_hz)
        transit_s = received_s - capture_s - on_server_s
        if transit_s < -STEP_LIMIT_S:
            return Exposure(received_s - on_server_s, on_server_s, is_aligned=False, is_odd=True)
        return Exposure(capture_s, on_server_s, is_aligned=True, is_odd=transit_s > TRANSIT_LIMIT_S)

    def _to_host(self, server_s: float) -> float:
        assert self._reference is not None
        since_s = server_s - self._reference.server_s
        return self._reference.host_s + since_s + self._offset_s + self._drift * since_s

    def _forget(self) -> None:
        self._best.clear()
        self._interval = None
        self._reference = None
        self._strangers = 0
        self._drift = 0.0
        self.resets += 1

    def _fit(self) -> None:
        """Weighted line through host - server over server time, relative to the newest echo to keep all digits."""
        reference = self._best[-1]
        quickest_s = min(echo.round_trip_s for echo in self._best)
        total = mean_x = mean_y = 0.0
        points = []
        for echo in self._best:
            # Standard deviation of the stamp's place in the round trip: what exceeds the quickest is queueing, and
            # may lie on one side alone. The floor keeps a lucky echo from weighing everything.
            sigma_s = 1e-5 + 0.05 * quickest_s + 0.5 * (echo.round_trip_s - quickest_s)
            x = echo.server_s - reference.server_s
            y = (echo.host_s - reference.host_s) - x
            weight = 1.0 / (sigma_s * sigma_s)
            points.append((weight, x, y))
            total += weight
            mean_x += weight * x
            mean_y += weight * y
        mean_x /= total
        mean_y /= total
        spread = 1.0 / (DRIFT_PRIOR * DRIFT_PRIOR)
        slope = 0.0
        for weight, x, y in points:
            spread += weight * (x - mean_x) ** 2
            slope += weight * (x - mean_x) * (y - mean_y)
        self._drift = slope / spread
        self._offset_s = mean_y - self._drift * mean_x
        self._reference = reference
