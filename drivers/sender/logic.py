"""When the sender sends what: arming, watchdog, latch and neutral. Pure; time is an argument."""

from __future__ import annotations

import enum
import struct
from dataclasses import dataclass

from drivers.calibration import ActuatorCalibration, DeviceCommand, MotorKind
from drivers.config import ActuatorConfig
from drivers.device import FirmwareIdentity, Telemetry

NEUTRAL_FRAMES = 3
NEUTRAL_SPAN_S = 0.06


class SenderState(enum.IntEnum):
    """State of the sender. Only ARMED lets a command through."""

    DISCONNECTED = 0
    CONNECTED = 1
    ARMED = 2
    STOPPING = 3
    FAULT = 4


class Wish(enum.IntEnum):
    """What the main process wants. Each new wish has a higher epoch than the one before."""

    NONE = 0
    ARM = 1
    STOP = 2
    STOP_AND_LATCH = 3
    RESET_FAULT = 4
    SHUT_DOWN = 5


_ORDER = struct.Struct("<QBQdBii")


@dataclass(frozen=True, slots=True)
class Order:
    """The newest word of the main process: its last wish, and the newest command since.

    The command counts only while the wish is ARM; its ``number`` is 0 until the first command of an epoch.
    """

    epoch: int
    wish: Wish
    number: int
    t_issued_s: float
    command: DeviceCommand

    def pack(self) -> bytes:
        """Bytes for a slot."""
        c = self.command
        return _ORDER.pack(
            self.epoch, self.wish, self.number, self.t_issued_s, c.motor_kind, c.motor_steps, c.servo_steps
        )

    @classmethod
    def unpack(cls, data: bytes) -> Order:
        """Inverse of ``pack``."""
        epoch, wish, number, t_issued_s, kind, motor, servo = _ORDER.unpack(data)
        return cls(epoch, Wish(wish), number, t_issued_s, DeviceCommand(MotorKind(kind), motor, servo))


ORDER_SIZE = _ORDER.size


class SenderLogic:
    """The state machine of the sender.

    Feed it what happens (``link_up``, ``firmware``, ``telemetry``, ``link_failed``, ``order``, ``main_lost``) and ask
    ``decide`` what to write. Whatever happens, ``decide`` returns neutral unless the sender is ARMED, the command was
    issued in this very epoch, is younger than the watchdog's deadline, lies within the calibration's limits, and the
    telemetry is fresh. A fault stays until ``RESET_FAULT``, and arming again takes a new ARM on top.
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
        self.watchdog_trips = 0
        self.frames = 0
        self.neutral_frames = 0
        self.sent_number = 0
        self.t_sent_issued_s = 0.0
        self._is_link_up = False
        self._order: Order | None = None
        self._decided: Order | None = None
        self._t_armed_s = 0.0
        self._is_watchdog_biting = False
        self._t_first_neutral_s: float | None = None
        self._neutral_run = 0
        self._is_neutral_settled = False
        self._is_shutting_down = False

    @property
    def is_ready_to_send(self) -> bool:
        """Whether anything but a version request may be sent: the firmware is known and its ids are ours."""
        return self._is_link_up and self.version is not None and self.version.refusal() is None

    @property
    def is_neutral_settled(self) -> bool:
        """Whether neutral has been sent at least three times over at least 60 ms since the last moving command."""
        return self._is_neutral_settled

    def link_up(self) -> None:
        """The link is open; the firmware has yet to say what it is."""
        self._is_link_up = True

    def link_failed(self, text: str) -> None:
        """The link is gone: a latched fault, unless the sender was leaving anyway."""
        self._is_link_up = False
        self.t_values_s = None
        self._latch(text)
        if self._is_shutting_down:
            self.is_finished = True

    def firmware(self, version: FirmwareIdentity) -> None:
        """The firmware's answer; another board than before, or one that is too old, is a latched fault."""
        if self.version is not None and version.uuid != self.version.uuid:
            self._is_link_up = False
            self._latch(f"another {self.config.device_kind.name} answers than before; close the car and open it again.")
            return
        self.version = version
        if (refusal := version.refusal()) is not None:
            self._latch(refusal)

    def telemetry(self, t_s: float, values: Telemetry) -> None:
        """Fresh telemetry. A fault of the firmware or its kill switch latches."""
        self.values = values if self.values is None else self.values.updated(values)
        self.t_values_s = t_s
        if self.state == SenderState.DISCONNECTED and self.is_ready_to_send:
            self.state = SenderState.CONNECTED
        if (cause := self._firmware_cause()) and self.state != SenderState.DISCONNECTED:
            self._latch(cause)

    def telemetry_age_s(self, now_s: float) -> float:
        """Age of the newest telemetry; infinite before the first."""
        return float("inf") if self.t_values_s is None else now_s - self.t_values_s

    def main_lost(self) -> None:
        """The main process is gone: neutral, then leave."""
        self._shut_down()

    def order(self, now_s: float, order: Order) -> None:
        """Take the newest word of the main process; void with an older epoch, or once leaving."""
        if order.epoch < self.epoch or self._is_shutting_down:
            return
        if order.epoch > self.epoch:
            self.epoch = order.epoch
            self._order = None
            self._obey(now_s, order)
        if order.wish == Wish.ARM and order.number > 0:
            self._order = order

    def decide(self, now_s: float) -> DeviceCommand | None:
        """Return what to write now; None if nothing may be sent. What is then written is reported to ``written``."""
        self._decided = None
        self._watch_telemetry(now_s)
        if not self.is_ready_to_send:
            if self._is_shutting_down:
                self.is_finished = True
            return None
        return self._command(now_s)

    def written(self, now_s: float, command: DeviceCommand) -> None:
        """Count a command that was written; a decision that was replaced before the write does not count."""
        self.frames += 1
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
            self._latch(f"a command beyond the calibration's limits reached the sender: {order.command}.")
        elif age_s > self.config.latch_s:
            self._bite()
            self._latch(
                f"no command came for {self.config.latch_s:g} s while armed; see what held the control loop up, "
                "then reset the fault and arm again."
            )
        elif not -self.config.watchdog_s <= age_s <= self.config.watchdog_s:
            self._bite()
        elif self.telemetry_age_s(now_s) <= self.config.telemetry_stale_s:
            self._is_watchdog_biting = False
            self._decided = order
            return order.command
        return self.neutral

    def _obey(self, now_s: float, order: Order) -> None:
        self.refusal = ""
        if order.wish == Wish.ARM:
            self.refusal = self._arming_refusal(now_s)
            if not self.refusal:
                self.state = SenderState.ARMED
                self._is_watchdog_biting = False
        elif order.wish == Wish.STOP:
            if self.state in (SenderState.ARMED, SenderState.CONNECTED, SenderState.STOPPING):
                self._begin_neutral(SenderState.STOPPING)
            else:
                self._begin_neutral(self.state)
        elif order.wish == Wish.STOP_AND_LATCH:
            self._begin_neutral(self.state)
            self._latch("The car was stopped for safety; look at it, then reset the fault and arm again.")
        elif order.wish == Wish.RESET_FAULT:
            self._reset_fault(now_s)
        elif order.wish == Wish.SHUT_DOWN:
            self._shut_down()

    def _arming_refusal(self, now_s: float) -> str:
        if self.state == SenderState.FAULT:
            return self.fault
        if self.state != SenderState.CONNECTED:
            return f"the sender is {self.state.name.lower()}; wait for it to be connected."
        if self.telemetry_age_s(now_s) > self.config.telemetry_stale_s:
            return f"the {self.config.device_kind.name}'s telemetry is stale; check the link."
        return ""

    def _reset_fault(self, now_s: float) -> None:
        if self.state != SenderState.FAULT:
            return
        if not self.is_ready_to_send:
            self.refusal = self.fault
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
            self._begin_neutral(SenderState.STOPPING if self.state != SenderState.FAULT else SenderState.FAULT)

    def _begin_neutral(self, state: SenderState) -> None:
        self.state = state
        self._order = None
        self._forget_neutral()

    def _forget_neutral(self) -> None:
        self._t_first_neutral_s, self._neutral_run, self._is_neutral_settled = None, 0, False

    def _count_neutral(self, now_s: float, command: DeviceCommand) -> None:
        if command != self.neutral:
            self._forget_neutral()
            return
        self.neutral_frames += 1
        self._neutral_run += 1
        if self._t_first_neutral_s is None:
            self._t_first_neutral_s = now_s
        span_s = now_s - self._t_first_neutral_s
        self._is_neutral_settled = self._neutral_run >= NEUTRAL_FRAMES and span_s >= NEUTRAL_SPAN_S
        if self._is_neutral_settled and self._is_shutting_down:
            self.is_finished = True
        elif self._is_neutral_settled and self.state == SenderState.STOPPING:
            self.state = SenderState.CONNECTED

    def _watch_telemetry(self, now_s: float) -> None:
        if self.state in (SenderState.DISCONNECTED, SenderState.FAULT) or self._is_shutting_down:
            return
        if self.telemetry_age_s(now_s) > self.config.telemetry_lost_s:
            name = self.config.device_kind.name
            self._latch(f"the {name} stopped answering; check its power and cable, then reset the fault.")

    def _firmware_cause(self) -> str:
        return "" if self.values is None else self.values.fault()

    def _bite(self) -> None:
        if not self._is_watchdog_biting:
            self._is_watchdog_biting = True
            self.watchdog_trips += 1

    def _latch(self, text: str) -> None:
        if self.state != SenderState.FAULT:
            self.fault = text
        self.state = SenderState.FAULT
        self._order = None
