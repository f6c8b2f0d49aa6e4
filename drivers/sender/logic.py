"""State machine of the sender: arming, watchdog, latched faults and neutral. Pure; time is an argument."""

from __future__ import annotations

import enum
import struct
from dataclasses import dataclass

from drivers.calibration import ActuatorCalibration, DeviceCommand, MotorKind
from drivers.config import ActuatorConfig
from drivers.device import FirmwareIdentity, Telemetry
from drivers.sender.timeout_measurement import UNREPORTED_TIMEOUT, TimeoutMeasurement

NEUTRAL_FRAMES = 3
NEUTRAL_SPAN_S = 0.12
"""The controller must receive neutral over at least 60 ms. It may receive the first frame late: twice that."""

MAX_LAST_BRAKING_S = 1.5
"""Longest time for which neutral brakes a rolling car before the sender ends [s]: at 3 m/s2 it stops from 4.5 m/s.

It is shorter than the time for which the main process waits for the end of the sender."""
REST_ERPM = 200.0
"""Largest motor speed of a car at rest [electrical rev/min], the default limit for arming."""
SAFETY_STOP = "The car was stopped for safety; check the car, then reset the fault and arm again."


class SenderState(enum.IntEnum):
    """State of the sender. It sends commands in ARMED only, otherwise neutral."""

    DISCONNECTED = 0
    CONNECTED = 1
    ARMED = 2
    STOPPING = 3
    FAULT = 4


class Request(enum.IntEnum):
    """Request of the main process. Each new request has a higher epoch."""

    NONE = 0
    ARM = 1
    STOP = 2
    STOP_AND_LATCH = 3
    RESET_FAULT = 4
    SHUT_DOWN = 5
    MEASURE_TIMEOUT = 6


_ORDER = struct.Struct("<QBQdBii")


@dataclass(frozen=True, slots=True)
class Order:
    """Message of the main process to the sender: its last request, and the newest command since.

    The command is used only if the request is ARM; its ``number`` is 0 until the first command of an epoch.
    """

    epoch: int
    request: Request
    number: int
    t_issued_s: float
    command: DeviceCommand

    def pack(self) -> bytes:
        """Bytes for a slot."""
        c = self.command
        return _ORDER.pack(
            self.epoch, self.request, self.number, self.t_issued_s, c.motor_kind, c.motor_steps, c.servo_steps
        )

    @classmethod
    def unpack(cls, data: bytes) -> Order:
        """Inverse of ``pack``."""
        epoch, request, number, t_issued_s, kind, motor, servo = _ORDER.unpack(data)
        return cls(epoch, Request(request), number, t_issued_s, DeviceCommand(MotorKind(kind), motor, servo))


ORDER_SIZE = _ORDER.size


class SenderLogic:
    """The state machine of the sender.

    The methods ``link_up``, ``firmware``, ``telemetry``, ``link_failed``, ``order``, ``resumed`` and ``main_lost`` are
    its events; ``decide`` returns the command to write. It returns neutral unless the sender is ARMED, the command was
    issued in the current epoch, is younger than the watchdog's deadline, lies within the calibration's limits, and the
    telemetry is fresh. A fault stays latched until ``RESET_FAULT``; then a new ARM is needed.
    """

    def __init__(self, config: ActuatorConfig, calibration: ActuatorCalibration) -> None:
        self.config = config
        self.calibration = calibration
        self.neutral = calibration.neutral
        self.state = SenderState.DISCONNECTED
        self.fault = ""
        self.refusal = ""
        self.epoch = 0
        self.version: FirmwareIdentity | None = None
        self.values: Telemetry | None = None
        self.t_values_s: float | None = None
        self.is_finished = False
        self.timeout = TimeoutMeasurement()
        self.watchdog_trips = 0
        self.frames = 0
        self.neutral_frames = 0
        self.sent_number = 0
        self.t_sent_issued_s = 0.0
        self._is_link_up = False
        self._unready_cause = ""
        self._order: Order | None = None
        self._decided: Order | None = None
        self._is_watchdog_tripped = False
        self._t_written_s = 0.0
        self._t_first_neutral_s: float | None = None
        self._neutral_run = 0
        self._is_neutral_settled = False
        self._is_shutting_down = False

    @property
    def is_ready_to_send(self) -> bool:
        """Whether more than a version request may be sent: the link is open and the firmware is supported."""
        return self._is_link_up and self.version is not None and self.version.refusal() is None

    @property
    def is_neutral_settled(self) -> bool:
        """Whether neutral has been sent at least three times over at least 120 ms since the last moving command."""
        return self._is_neutral_settled

    def link_up(self) -> None:
        """Event: the link is open, the firmware is still unknown."""
        self._is_link_up = True

    def link_failed(self, text: str) -> None:
        """Event: the link has failed; latches a fault, except during shutdown."""
        self.t_values_s = None
        self._latch_unready(text)
        if self._is_shutting_down:
            self.is_finished = True

    def firmware(self, version: FirmwareIdentity) -> None:
        """Event: version received; a different board or an unsupported version latches a fault."""
        if self.version is not None and version.uuid != self.version.uuid:
            self._latch_unready(f"a different {self.config.device_kind.name} answers; close the car and open it again.")
            return
        self.version = version
        if (refusal := version.refusal()) is not None:
            self._latch_unready(refusal)

    def telemetry(self, t_s: float, values: Telemetry) -> None:
        """Event: telemetry received; a fault of the firmware or its kill switch latches a fault.

        Telemetry without a fault code is a broadcast: it does not show that the firmware receives commands.
        """
        self.values = values if self.values is None else self.values.updated(values)
        if values.fault_code is not None:
            self.t_values_s = t_s
            if self.state == SenderState.DISCONNECTED and self.is_ready_to_send:
                self.state = SenderState.CONNECTED
        if values.motor_timeout_active is not None:
            self.timeout.note(t_s, values.motor_timeout_active)
        if (cause := self._firmware_cause()) and self.state != SenderState.DISCONNECTED:
            self._latch(cause)

    def telemetry_age_s(self, now_s: float) -> float:
        """Age of the newest telemetry [s]; infinite before the first."""
        return float("inf") if self.t_values_s is None else now_s - self.t_values_s

    def resumed(self) -> None:
        """Event: the computer was suspended; latches a fault if armed, since the last command still seems fresh."""
        if self.state == SenderState.ARMED:
            self._latch("the computer was suspended while armed; check the car, then reset the fault and arm again.")

    def main_lost(self) -> None:
        """Event: the main process has ended; the sender sends neutral and shuts down."""
        self._shut_down()

    def order(self, now_s: float, order: Order) -> None:
        """Event: order received; ignored if its epoch is older, and during shutdown."""
        if order.epoch < self.epoch or self._is_shutting_down:
            return
        if order.epoch > self.epoch:
            self.epoch = order.epoch
            self._order = None
            self.timeout.cancel()
            self._handle_request(now_s, order)
        if order.request == Request.ARM and order.number > 0:
            self._order = order

    def decide(self, now_s: float) -> DeviceCommand | None:
        """Return the command to write now, or None if none may be sent; report the written command to ``written``."""
        self._decided = None
        self._watch_telemetry(now_s)
        if not self.is_ready_to_send:
            if self._is_shutting_down:
                self.is_finished = True
            return None
        self.timeout.advance(now_s)
        return None if self.timeout.is_running else self._command(now_s)

    def written(self, now_s: float, command: DeviceCommand) -> None:
        """Count a written command; a decision that was replaced before the write does not count."""
        self.frames += 1
        self._t_written_s = now_s
        order = self._decided
        if order is not None and command is order.command:
            self.sent_number, self.t_sent_issued_s = order.number, order.t_issued_s
        self._count_neutral(now_s, command)

    def _command(self, now_s: float) -> DeviceCommand:
        order = self._order
        if self.state != SenderState.ARMED or order is None:
            return self.neutral
        age_s = now_s - order.t_issued_s
        if not self.calibration.is_within_limits(order.command):
            self._latch(f"a command beyond the calibration's limits reached the sender ({order.command}).")
        elif age_s > self.config.latch_s:
            self._trip_watchdog()
            self._latch(
                f"no command arrived for {self.config.latch_s:g} s while armed; find what delayed the control loop, "
                "then reset the fault and arm again."
            )
        elif not -self.config.watchdog_s <= age_s <= self.config.watchdog_s:
            self._trip_watchdog()
        elif self.telemetry_age_s(now_s) <= self.config.telemetry_stale_s:
            self._is_watchdog_tripped = False
            self._decided = order
            return order.command
        return self.neutral

    def _handle_request(self, now_s: float, order: Order) -> None:
        self.refusal = ""
        if order.request == Request.ARM:
            self.refusal = self._arming_refusal(now_s)
            if not self.refusal:
                self.state = SenderState.ARMED
                self._is_watchdog_tripped = False
        elif order.request == Request.STOP:
            if self.state in (SenderState.ARMED, SenderState.CONNECTED, SenderState.STOPPING):
                self._begin_neutral(SenderState.STOPPING)
            else:
                self._begin_neutral(self.state)
        elif order.request == Request.STOP_AND_LATCH:
            self._begin_neutral(self.state)
            self._latch(SAFETY_STOP)
        elif order.request == Request.RESET_FAULT:
            self._reset_fault(now_s)
        elif order.request == Request.SHUT_DOWN:
            self._shut_down()
        elif order.request == Request.MEASURE_TIMEOUT:
            self.refusal = self._measurement_refusal()
            if not self.refusal:
                self.timeout.start(self._t_written_s)

    def _arming_refusal(self, now_s: float) -> str:
        if self.state == SenderState.FAULT:
            return self.fault
        if self.state != SenderState.CONNECTED:
            return f"the sender is {self.state.name.lower()}; wait until it is connected."
        if self.telemetry_age_s(now_s) > self.config.telemetry_stale_s:
            return f"the {self.config.device_kind.name}'s telemetry is stale; check the link."
        return ""

    def _measurement_refusal(self) -> str:
        if self.state != SenderState.CONNECTED or not self._is_neutral_settled:
            return self.fault or "the time-out is measured in neutral only; stop the car."
        if self.values is None or self.values.motor_timeout_active is None:
            return UNREPORTED_TIMEOUT
        return ""

    def _reset_fault(self, now_s: float) -> None:
        if self.state != SenderState.FAULT:
            return
        if not self.is_ready_to_send:
            self.refusal = self._unready_cause
        elif self.telemetry_age_s(now_s) > self.config.telemetry_stale_s:
            name = self.config.device_kind.name
            self.refusal = f"the {name} does not answer; check its power and cable, then reset the fault again."
        elif cause := self._firmware_cause():
            self.refusal = cause
        else:
            self.fault = ""
            self.state = SenderState.CONNECTED

    def _shut_down(self) -> None:
        if not self._is_shutting_down:
            self._is_shutting_down = True
            self._order = None
            self.timeout.cancel()
            self._begin_neutral(SenderState.STOPPING if self.state != SenderState.FAULT else SenderState.FAULT)

    def _begin_neutral(self, state: SenderState) -> None:
        self.state = state
        self._order = None
        self._reset_neutral_count()

    def _reset_neutral_count(self) -> None:
        self._t_first_neutral_s, self._neutral_run, self._is_neutral_settled = None, 0, False

    def _count_neutral(self, now_s: float, command: DeviceCommand) -> None:
        if command != self.neutral:
            self._reset_neutral_count()
            return
        self.neutral_frames += 1
        self._neutral_run += 1
        if self._t_first_neutral_s is None:
            self._t_first_neutral_s = now_s
        span_s = now_s - self._t_first_neutral_s
        self._is_neutral_settled = self._neutral_run >= NEUTRAL_FRAMES and span_s >= NEUTRAL_SPAN_S
        if self._is_neutral_settled and self._is_shutting_down:
            self.is_finished = span_s >= MAX_LAST_BRAKING_S or not self._is_braking(now_s)
        elif self._is_neutral_settled and self.state == SenderState.STOPPING:
            self.state = SenderState.CONNECTED

    def _is_braking(self, now_s: float) -> bool:
        """Whether neutral brakes a car that rolls: it would coast once no command is sent any more."""
        erpm = None if self.values is None else self.values.erpm
        is_rolling = erpm is not None and abs(erpm) > REST_ERPM
        is_fresh = self.telemetry_age_s(now_s) <= self.config.telemetry_stale_s
        return self.neutral.motor_kind == MotorKind.BRAKE and is_rolling and is_fresh

    def _watch_telemetry(self, now_s: float) -> None:
        if self.state in (SenderState.DISCONNECTED, SenderState.FAULT) or self._is_shutting_down:
            return
        if self.telemetry_age_s(now_s) > self.config.telemetry_lost_s:
            name = self.config.device_kind.name
            self._latch(f"the {name} stopped answering; check its power and cable, then reset the fault.")

    def _firmware_cause(self) -> str:
        return "" if self.values is None else self.values.fault()

    def _trip_watchdog(self) -> None:
        if not self._is_watchdog_tripped:
            self._is_watchdog_tripped = True
            self.watchdog_trips += 1

    def _latch_unready(self, text: str) -> None:
        """Latch a fault of the link; the cause is the reason why a fault, also an earlier one, cannot be reset."""
        self._is_link_up = False
        self._unready_cause = text
        self._latch(text)

    def _latch(self, text: str) -> None:
        if self.state != SenderState.FAULT:
            self.fault = text
        self.state = SenderState.FAULT
        self._order = None
        self.timeout.cancel()
