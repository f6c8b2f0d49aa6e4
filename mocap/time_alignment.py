"""Alignment of the server's clock to the host's monotonic clock by echoes. Pure: all times are arguments.

An echo is sent at t0 and received at t2 on the host's clock and stamped t1 on the server's clock. The host's time of t1
is (t0 + t2) / 2 with an error of at most half the round trip. The echo with the shortest round trip of each interval is
used; a line through the echoes of the last minute gives offset and drift (Cristian 1989, "Probabilistic clock
synchronization"; least squares with a prior on the drift).
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

INTERVAL_S = 1.0
"""Interval from which only the echo with the shortest round trip is used [s]."""
MAX_ROUND_TRIP_S = 1.0
"""Longest valid round trip [s]."""
MAX_ECHOES = 60
"""Number of intervals in the fit."""
DRIFT_PRIOR = 100e-6
"""Prior standard deviation of the drift [s/s]: crystals are within 100 ppm."""
STEP_LIMIT_S = 5e-3
"""Deviation of an echo from the line, beyond its uncertainty, that indicates a step of the server's clock [s]."""
TRANSIT_LIMIT_S = 1.0
"""Longest time on the server and longest transit of a frame with consistent stamps [s]."""
STEP_COUNT = 3
"""Number of consecutive deviating echoes after which the alignment restarts."""


@dataclass(frozen=True, slots=True)
class Echo:
    """A completed echo: server and host time of the same instant, and the round trip [s]."""

    server_s: float
    host_s: float
    round_trip_s: float


@dataclass(frozen=True, slots=True)
class Exposure:
    """Time of exposure of a frame on the host's clock [s].

    ``is_aligned`` is False if the time was estimated from the time of arrival; ``is_inconsistent`` is True if the
    stamps contradict the time of arrival, so that a new echo should be sent.
    """

    capture_s: float
    on_server_s: float
    is_aligned: bool
    is_inconsistent: bool = False


class ClockAlignment:
    """Maps ticks of the server's clock to the host's monotonic clock."""

    def __init__(self, clock_hz: float) -> None:
        self.clock_hz = clock_hz
        self.echoes = 0
        self.resets = 0
        self._best: deque[Echo] = deque(maxlen=MAX_ECHOES)
        self._interval: int | None = None
        self._n_step_echoes = 0
        self._reference: Echo | None = None
        self._offset_s = 0.0
        self._drift = 0.0

    @property
    def is_aligned(self) -> bool:
        """Whether an echo has been received."""
        return self._reference is not None

    @property
    def is_uncertain(self) -> bool:
        """Whether the last echoes indicate a step of the server's clock."""
        return self._n_step_echoes > 0

    @property
    def drift_ppm(self) -> float:
        """Rate of the host's clock relative to the server's [ppm]."""
        return self._drift * 1e6

    @property
    def round_trip_s(self) -> float:
        """Smallest round trip among the echoes in use [s]; NaN before the first."""
        return min((echo.round_trip_s for echo in self._best), default=float("nan"))

    def add_echo(self, sent_s: float, server_ticks: int, received_s: float) -> None:
        """Add an echo: host time sent [s], server's stamp, host time received [s].

        An echo with a round trip below zero or above MAX_ROUND_TRIP_S is ignored.
        """
        round_trip_s = received_s - sent_s
        if not 0.0 <= round_trip_s <= MAX_ROUND_TRIP_S or self.clock_hz <= 0.0:
            return
        echo = Echo(server_ticks / self.clock_hz, 0.5 * (sent_s + received_s), round_trip_s)
        self.echoes += 1
        if self._reference is not None:
            off_s = abs(echo.host_s - self._to_host(echo.server_s))
            self._n_step_echoes = self._n_step_echoes + 1 if off_s > STEP_LIMIT_S + 0.5 * round_trip_s else 0
            if 0 < self._n_step_echoes < STEP_COUNT:
                return
            if self._n_step_echoes >= STEP_COUNT:
                self._reset()
        interval = int(received_s / INTERVAL_S)
        if interval != self._interval:
            self._interval = interval
            self._best.append(echo)
        elif round_trip_s < self._best[-1].round_trip_s:
            self._best[-1] = echo
        else:
            return
        self._fit()

    def exposure(self, exposed_ticks: int, transmit_ticks: int, received_s: float) -> Exposure:
        """Time of exposure of a frame that arrived at ``received_s`` [s, host monotonic].

        Without stamps or a clock it is the time of arrival. Without an echo it is the time of arrival less the time
        on the server; also if the stamps lie after the arrival (a step of the server's clock). Stamps long before
        the arrival are used, since the frame may have been delayed.

        Args:
            exposed_ticks: Server stamp of the exposure; 0 for none.
            transmit_ticks: Server stamp of the transmission, 0 for none.
            received_s: Host time of arrival.
        """
        if exposed_ticks <= 0 or self.clock_hz <= 0.0:
            return Exposure(received_s, 0.0, is_aligned=False)
        on_server_s = max(transmit_ticks - exposed_ticks, 0) / self.clock_hz
        if on_server_s > TRANSIT_LIMIT_S:
            on_server_s = 0.0  # implausible: the stamps are of two clocks
        if self._reference is None:
            return Exposure(received_s - on_server_s, on_server_s, is_aligned=False)
        capture_s = self._to_host(exposed_ticks / self.clock_hz)
        transit_s = received_s - capture_s - on_server_s
        if transit_s < -STEP_LIMIT_S:
            return Exposure(received_s - on_server_s, on_server_s, is_aligned=False, is_inconsistent=True)
        return Exposure(capture_s, on_server_s, is_aligned=True, is_inconsistent=transit_s > TRANSIT_LIMIT_S)

    def _to_host(self, server_s: float) -> float:
        assert self._reference is not None
        since_s = server_s - self._reference.server_s
        return self._reference.host_s + since_s + self._offset_s + self._drift * since_s

    def _reset(self) -> None:
        self._best.clear()
        self._interval = None
        self._reference = None
        self._n_step_echoes = 0
        self._drift = 0.0
        self.resets += 1

    def _fit(self) -> None:
        """Fit a weighted line to host - server over server time, relative to the newest echo for precision."""
        reference = self._best[-1]
        quickest_s = min(echo.round_trip_s for echo in self._best)
        total = mean_x = mean_y = 0.0
        points = []
        for echo in self._best:
            # Standard deviation of the stamp within the round trip: the excess over the shortest round trip is
            # queueing, possibly on one side only. The floor limits the weight of a single echo.
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
