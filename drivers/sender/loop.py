"""The loop of the sender: it owns the device and sends at absolute deadlines.

It runs in a separate process (``process``), whose only other thread opens the device; for a bus within one process it
runs in a thread.
"""

from __future__ import annotations

import contextlib
import select
import socket
import time
from collections.abc import Callable

import numpy as np

from carlab.core.errors import ActuatorFaultError, NotReadyError
from drivers.calibration import ActuatorCalibration, DeviceCommand
from drivers.config import ActuatorConfig
from drivers.device import Device, FirmwareIdentity
from drivers.sender.logic import NEUTRAL_FRAMES, NEUTRAL_SPAN_S, Order, SenderLogic, SenderState
from drivers.sender.opening import Opening
from drivers.sender.slots import Slot
from drivers.sender.status import SenderStatus

MAX_RATE_FACTOR = 4
"""Upper limit of the send rate, as a multiple of ``rate_hz``, if the main process wakes the sender often."""
MAX_DECISION_AGE_S = 0.01
"""Largest age of a decision that may be written [s]; an older one means that the process was suspended in between."""
MAX_DECISIONS = 3
"""Number of decisions in one tick after which neutral is written."""
MIN_SUSPENSION_S = 0.05
"""Shortest suspension of the computer that is noticed [s]; the clocks do not drift against each other."""
HANDSHAKE_PERIOD_S = 0.1
RECONNECT_PERIODS_S = (0.1, 0.2, 0.5, 1.0, 2.0)
LATENESS_WINDOW = 4096
LATENESS_UPDATE_DEADLINES = 50


class SenderLoop:
    """Sends the decisions of ``SenderLogic`` over a device until the main process requests shutdown or has ended."""

    def __init__(
        self,
        device: Device,
        config: ActuatorConfig,
        calibration: ActuatorCalibration,
        orders: Slot,
        statuses: Slot,
        wake: socket.socket,
        is_main_alive: Callable[[], bool],
        *,
        is_realtime: bool = False,
    ) -> None:
        self.device = device
        self.config = config
        self.logic = SenderLogic(config, calibration)
        self._orders = orders
        self._statuses = statuses
        self._wake = wake
        self._is_main_alive = is_main_alive
        self._is_realtime = is_realtime
        self._period_s = 1.0 / config.rate_hz
        self._is_link_open = False
        self._opening: Opening | None = None
        self._is_wake_open = True
        self._is_woken = False
        self._next_poll_s = 0.0
        self._next_connect_s = 0.0
        self._failed_connects = 0
        self._t_written_s = float("nan")
        self._late_s = np.zeros(LATENESS_WINDOW)
        self._late_ms = (0.0, 0.0, 0.0)
        self._deadlines = 0
        self._skipped = 0
        self._needs_version = True
        self._suspended_s = _time_suspended_s()

    def run(self) -> None:
        """Connect and send until shutdown; always closes the device and publishes a last status.

        If the device cannot be opened at first, it ends. After an unexpected error it sends neutral first.
        """
        try:
            self._run()
        except NotReadyError as error:
            self.logic.link_failed(str(error))
        except Exception as error:
            self._send_last_neutral()
            self.logic.link_failed(
                f"the sender failed ({type(error).__name__}: {error}); close the car and open it again."
            )
            raise
        finally:
            if self._opening is None:
                self.device.close()
            self._publish(is_ended=True)

    def _run(self) -> None:
        deadline_s = time.monotonic()
        while not self.logic.is_finished:
            is_deadline = self._wait(deadline_s)
            now_s = time.monotonic()
            self._tick(now_s)
            if is_deadline:
                self._note_lateness(now_s - deadline_s)
            # A deadline within the shortest period has just been served; missed deadlines are skipped.
            if is_deadline or deadline_s - now_s < self._period_s / MAX_RATE_FACTOR:
                missed = max(0, int((now_s - deadline_s) / self._period_s))
                self._skipped += missed
                deadline_s += (missed + 1) * self._period_s

    def _send_last_neutral(self) -> None:
        """Write neutral three times over 120 ms, if the link is open and the firmware known; ignores errors."""
        for _ in range(NEUTRAL_FRAMES if self._is_link_open and self.logic.is_ready_to_send else 0):
            with contextlib.suppress(Exception):
                self.device.send(self.logic.neutral)
            time.sleep(NEUTRAL_SPAN_S / (NEUTRAL_FRAMES - 1))

    def _wait(self, deadline_s: float) -> bool:
        """Wait for the deadline (True) or for an order that may be sent earlier (False); reads replies meanwhile."""
        earliest_s = time.monotonic() + self._period_s / MAX_RATE_FACTOR
        while (now_s := time.monotonic()) < deadline_s:
            if self._is_woken and now_s >= earliest_s:
                self._is_woken = False
                return False
            until_s = min(deadline_s, earliest_s) if self._is_woken else deadline_s
            watched: list[int] = []
            if self._is_wake_open and not self._is_woken:
                watched.append(self._wake.fileno())
            link = self.device.fileno() if self._is_link_open else None
            if link is not None:
                watched.append(link)
            readable, _, _ = select.select(watched, [], [], max(0.0, until_s - now_s))
            if self._is_wake_open and self._wake.fileno() in readable:
                self._drain_wake()
            if link in readable:
                self._receive(time.monotonic())
        self._is_woken = False
        return True

    def _drain_wake(self) -> None:
        try:
            data = self._wake.recv(4096)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        self._is_woken = True
        if not data:
            self._is_wake_open = False
            self.logic.main_lost()

    def _tick(self, now_s: float) -> None:
        if self._is_wake_open and not self._is_main_alive():
            self._is_wake_open = False
            self.logic.main_lost()
        if (suspended_s := _time_suspended_s()) - self._suspended_s > MIN_SUSPENSION_S:
            self._suspended_s = suspended_s
            self.logic.resumed()
        self._take_order(now_s)
        self._receive(now_s)
        self._connect(now_s)
        before = self.logic.sent_number
        command, decided_s = self._decide()
        try:
            if command is not None and self._is_link_open:
                self.device.send(command)
                self.logic.written(decided_s, command)
                if self.logic.sent_number != before:
                    self._t_written_s = decided_s
            self._poll(now_s)
        except ActuatorFaultError as error:
            self._link_failed(str(error))
        self._publish()

    def _take_order(self, now_s: float) -> None:
        newest = self._orders.read()
        if newest is not None:
            self.logic.order(now_s, Order.unpack(newest[1]))

    def _decide(self) -> tuple[DeviceCommand | None, float]:
        """Return the command to write and the time just before the write.

        The process may be suspended between decision and write (SIGSTOP, a busy host). Then the command may be too
        old, or the main process may have latched a fault; a new decision from the newest order replaces the old one.
        """
        for _ in range(MAX_DECISIONS):
            decided_s = time.monotonic()
            self._take_order(decided_s)
            command = self.logic.decide(decided_s)
            write_s = time.monotonic()
            if write_s - decided_s <= MAX_DECISION_AGE_S:
                return command, write_s
        return (None if command is None else self.logic.neutral), write_s

    def _poll(self, now_s: float) -> None:
        if not self._is_link_open or now_s < self._next_poll_s - 0.25 * self._period_s:
            return
        version = self.logic.version
        if version is None or self._needs_version:
            self._next_poll_s = now_s + HANDSHAKE_PERIOD_S
            self.device.request_firmware()
        elif version.refusal() is None:
            self._next_poll_s = now_s + 1.0 / self.config.telemetry_rate_hz
            self.device.request_telemetry()

    def _receive(self, now_s: float) -> None:
        if not self._is_link_open:
            return
        try:
            for reply in self.device.receive(now_s):
                if isinstance(reply, FirmwareIdentity):
                    self._needs_version = False
                    self._next_poll_s = now_s
                    self.logic.link_up()
                    self.logic.firmware(reply)
                else:
                    self.logic.telemetry(now_s, reply)
        except ActuatorFaultError as error:
            self._link_failed(str(error))

    def _link_failed(self, text: str) -> None:
        """Close the link after a last neutral command, where the link still takes one, and latch a fault."""
        if self.logic.is_ready_to_send:
            with contextlib.suppress(ActuatorFaultError):
                self.device.send(self.logic.neutral)
        self._is_link_open = False
        self.device.close()
        self.logic.link_failed(text)
        self._failed_connects = 0
        self._next_connect_s = time.monotonic() + RECONNECT_PERIODS_S[0]

    def _connect(self, now_s: float) -> None:
        """Open a closed link without waiting for it; after a lost link the fault stays latched.

        Only a version request is sent at first. Raises NotReadyError if the first attempt fails.
        """
        if self._is_link_open or now_s < self._next_connect_s or self.logic.is_finished:
            return
        if self._opening is None:
            self._opening = Opening(self.device)
        if not self._opening.is_over:
            return
        opening, self._opening = self._opening, None
        try:
            opening.require_success()
        except NotReadyError:
            if self.logic.state == SenderState.DISCONNECTED:
                raise
            wait = RECONNECT_PERIODS_S[min(self._failed_connects, len(RECONNECT_PERIODS_S) - 1)]
            self._failed_connects += 1
            self._next_connect_s = now_s + wait
            return
        self._is_link_open = True
        self._needs_version = True
        self._next_poll_s = now_s

    def _note_lateness(self, late_s: float) -> None:
        """Record the lateness of a deadline [s]; update the percentiles every ``LATENESS_UPDATE_DEADLINES``."""
        self._late_s[self._deadlines % LATENESS_WINDOW] = late_s
        self._deadlines += 1
        if self._deadlines % LATENESS_UPDATE_DEADLINES == 1:
            kept = self._late_s[: min(self._deadlines, LATENESS_WINDOW)]
            p50, p99, top = (float(v) * 1e3 for v in np.percentile(kept, (50, 99, 100)))
            self._late_ms = (p50, p99, top)

    def _publish(self, *, is_ended: bool = False) -> None:
        logic, counters = self.logic, self.device.counters
        late = self._late_ms
        version, values = logic.version, logic.values
        status = SenderStatus(
            t_published_s=time.monotonic(),
            state=SenderState.DISCONNECTED if is_ended and not logic.fault else logic.state,
            epoch=logic.epoch,
            is_neutral_settled=logic.is_neutral_settled,
            is_link_open=self._is_link_open,
            is_sending=logic.is_ready_to_send,
            is_realtime=self._is_realtime,
            is_ended=is_ended,
            firmware_major=version.major if version else 0,
            firmware_minor=version.minor if version else 0,
            t_telemetry_s=_known(logic.t_values_s),
            erpm=_known(None if values is None else values.erpm),
            input_v=_known(None if values is None else values.input_v),
            tachometer_steps=_known(None if values is None else values.tachometer_steps),
            fault_code=0 if values is None else values.fault_code or 0,
            is_motor_released=values is not None and bool(values.motor_timeout_active),
            motor_timeout_s=logic.timeout.result_s,
            sent_number=logic.sent_number,
            t_issued_s=logic.t_sent_issued_s,
            t_written_s=self._t_written_s,
            late_p50_ms=late[0],
            late_p99_ms=late[1],
            late_max_ms=late[2],
            skipped_ticks=self._skipped,
            frames=logic.frames,
            neutral_frames=logic.neutral_frames,
            watchdog_trips=logic.watchdog_trips,
            crc_errors=counters.crc_errors,
            garbage_bytes=counters.garbage_bytes,
            link_opens=counters.link_opens,
            hardware=version.hardware[:60] if version else "",
            fault=logic.fault[:600],
            refusal=logic.refusal[:600],
        )
        self._statuses.write(status.pack())


def _time_suspended_s() -> float:
    """Time for which the computer has been suspended [s]; ``time.monotonic`` stands still meanwhile (Linux).

    If this process is interrupted between the two readings, the result is too small.
    """
    return time.clock_gettime(time.CLOCK_BOOTTIME) - time.monotonic()


def _known(value: float | None) -> float:
    return float("nan") if value is None else value
