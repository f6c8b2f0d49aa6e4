"""Measurement of the motor controller's time-out: no command is sent until the firmware releases the motor. Pure."""

from __future__ import annotations

import math

MAX_TIMEOUT_S = 2.0
"""Longest time without a command [s]. A longer time-out does not protect: at 4 m/s a car drives 8 m in this time."""
ADVISED_TIMEOUT_S = 0.35
"""Longest time [s] from the last command to the release of the motor that gives no warning.

300 ms, the longest advised time-out, and 50 ms for the measurement.
"""
UNREPORTED_TIMEOUT = (
    "the firmware does not report its time-out. Lift the wheels, unplug the USB or CAN cable of the motor controller "
    "while they turn, and see that they stop."
)


class TimeoutMeasurement:
    """Measures the time from the last command to the release of the motor that the telemetry reports.

    ``result_s`` is NaN before a measurement has ended, and infinite if the motor was not released.
    """

    def __init__(self) -> None:
        self.result_s = math.nan
        self._since_s: float | None = None
        self._was_controlled = False

    @property
    def is_running(self) -> bool:
        """Whether no command may be sent."""
        return self._since_s is not None

    def start(self, t_command_s: float) -> None:
        """Start at the time of the last command [s]."""
        self.result_s, self._since_s, self._was_controlled = math.nan, t_command_s, False

    def cancel(self) -> None:
        """End without a result; no effect unless it is running."""
        self._since_s = None

    def advance(self, now_s: float) -> None:
        """End with an infinite result if the motor is not released for too long."""
        if self._since_s is not None and now_s - self._since_s > MAX_TIMEOUT_S:
            self.result_s, self._since_s = math.inf, None

    def note(self, t_s: float, is_released: bool) -> None:
        """Note telemetry that arrived at ``t_s`` [s]; a release before the last command does not count."""
        if self._since_s is None:
            return
        if not is_released:
            self._was_controlled = True
        elif self._was_controlled:
            self.result_s, self._since_s = t_s - self._since_s, None
