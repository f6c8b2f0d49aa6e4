"""The main process's interface to the sender: it opens and arms the sender, posts commands and reads the status."""

from __future__ import annotations

import atexit
import logging
import math
import os
import threading
import time
from collections.abc import Callable

from carlab.core.errors import ActionOutOfRangeError, ActuatorFaultError, NotArmedError, NotOpenError, NotReadyError
from carlab.core.quantities import NEUTRAL, Action, Health
from carlab.core.resource import Resource
from drivers.calibration import ActuatorCalibration, DeviceCommand
from drivers.config import ActuatorConfig
from drivers.sender.logic import SAFETY_STOP, Order, Request, SenderState
from drivers.sender.process import Sender, start_sender
from drivers.sender.status import SenderStatus
from drivers.sender.timeout_measurement import ADVISED_TIMEOUT_S, MAX_TIMEOUT_S

_log = logging.getLogger(__name__)

START_TIMEOUT_S = 15.0
ANSWER_TIMEOUT_S = 2.0
SILENT_SENDER_S = 0.5
POLL_S = 0.001
RESUME_POLLS = 100
"""Polls after a silence, before the sender counts as hanging: after a pause of the computer it resumes too."""


class Actuator(Resource):
    """Steering servo and drive motor of a car, commanded through a sender process.

    A separate process sends the commands (``drivers.sender.process``); this object posts the newest command to it. The
    object belongs to the process that opened it: after a fork the child can neither command nor close it.
    """

    def __init__(
        self,
        config: ActuatorConfig,
        calibration: ActuatorCalibration,
        start: Callable[[ActuatorConfig, ActuatorCalibration], Sender] = start_sender,
    ) -> None:
        self.config = config
        self.calibration = calibration
        self._start = start
        self._sender: Sender | None = None
        self._owner_pid = 0
        self._lock = threading.RLock()
        self._epoch = 0
        self._number = 0
        self._armed_epoch = 0
        self._latched = ""  # fault known in the main process; it stays if the sender cannot be reached
        self._unmeasured_cause = ""  # why the last measurement of the time-out has no result

    @property
    def is_open(self) -> bool:
        """Whether a sender belongs to this object in this process."""
        return self._sender is not None and self._owner_pid == os.getpid()

    def open(self) -> None:
        """Start the sender and wait until the motor controller answers; idempotent.

        Raises NotReadyError if the port is wrong, no device answers or the firmware is too old.
        """
        if self.is_open:
            return
        if self._sender is not None:
            raise NotReadyError("This actuator was opened by another process", ("create a new Actuator after a fork.",))
        self._epoch = self._number = self._armed_epoch = 0
        self._latched = self._unmeasured_cause = ""
        self._owner_pid = os.getpid()
        self._sender = self._start(self.config, self.calibration)
        atexit.register(self.close)
        try:
            self._await_connection()
        except BaseException:
            self.close()
            raise

    def arm(self) -> None:
        """Enable commands. Raises NotReadyError, NotOpenError, or ActuatorFaultError while a fault is latched."""
        self.require_no_fault()
        self._await(lambda s: s.state != SenderState.STOPPING, ANSWER_TIMEOUT_S)
        with self._lock:
            # Another thread may have posted a stop since; its order must stay in the sender's slot.
            if self._latched:
                raise ActuatorFaultError(self._latched)
            epoch = self._post_request(Request.ARM)
        status = self._await_epoch(epoch)
        if status.state == SenderState.FAULT:
            raise ActuatorFaultError(status.fault)
        if status.state != SenderState.ARMED or status.epoch != epoch:
            raise NotReadyError("The actuator cannot be armed", (status.refusal or "it was stopped; arm it again.",))
        with self._lock:
            if self._epoch == epoch:
                self._armed_epoch = epoch

    def await_telemetry(self, timeout_s: float) -> None:
        """Wait until the telemetry is fresh, ``timeout_s`` at most; a busy host delays it by tenths of a second.

        Raises NotOpenError.
        """
        self._await(lambda s: time.monotonic() - s.t_telemetry_s <= self.config.telemetry_stale_s, timeout_s)

    def measure_motor_timeout(self) -> None:
        """Send no command until the firmware releases the motor; ``health`` and ``problems`` have the result.

        The motor is in neutral meanwhile. Nothing is measured, and ``health`` has a warning, unless the actuator is
        connected, disarmed and settled in neutral until the end, and the firmware reports the release. Raises
        NotOpenError, ActuatorFaultError.
        """
        self.require_no_fault()
        self._await(lambda s: s.is_neutral_settled, ANSWER_TIMEOUT_S)
        epoch = self._post_request(Request.MEASURE_TIMEOUT)
        status = self._await_epoch(epoch)
        self._unmeasured_cause = status.refusal
        if status.refusal:
            return

        def is_over(status: SenderStatus) -> bool:
            is_cancelled = status.epoch > epoch or status.state != SenderState.CONNECTED
            return is_cancelled or not math.isnan(status.motor_timeout_s)

        status = self._await(is_over, MAX_TIMEOUT_S + ANSWER_TIMEOUT_S)
        if math.isnan(status.motor_timeout_s):
            self._unmeasured_cause = status.fault or "the measurement was interrupted; measure again."
            return
        self._await(lambda s: s.state != SenderState.CONNECTED or not s.is_motor_released, ANSWER_TIMEOUT_S)

    def command(self, action: Action) -> Action:
        """Post the newest command and return the command on the wire, clamped and rounded by the calibration.

        While the telemetry is stale the sender sends neutral, and neutral is returned. A disarmed actuator accepts
        neutral without effect. Raises NotOpenError, ActuatorFaultError, ActionOutOfRangeError (not a number) and
        NotArmedError.
        """
        sender = self._opened()
        if not action.is_finite:
            raise ActionOutOfRangeError(f"{action} is not a number; the policy that made it has diverged.")
        status = self._require_faultless_status(sender)
        device = self.calibration.to_device(action)
        with self._lock:
            is_armed = self._armed_epoch == self._epoch > 0 and status.state == SenderState.ARMED
            if is_armed:
                self._number += 1
                sender.post(Order(self._epoch, Request.ARM, self._number, time.monotonic(), device))
        if not is_armed:
            if action.is_neutral:
                return NEUTRAL
            raise NotArmedError("The actuator is not armed; arm it before the first moving command.")
        if not time.monotonic() - status.t_telemetry_s <= self.config.telemetry_stale_s:
            return NEUTRAL
        return self.calibration.from_device(device)

    def stop(self, *, planned: bool) -> None:
        """Send neutral and disarm; ``planned=False`` latches a fault. Returns after three neutral frames.

        Does nothing if the actuator is closed or the sender has ended. Waits two seconds at most, and 0.1 s for
        a sender that hangs: the order stays in its slot, and the sender executes it when it resumes. Logs a warning if
        a planned stop of an armed actuator fails; after another stop the fault is known.
        """
        if not self.is_open or not self._is_sender_alive():
            return
        sender = self._opened()
        with self._lock:
            if not planned:
                self._latched = self._latched or SAFETY_STOP
            is_armed = self._armed_epoch == self._epoch > 0
            epoch = self._post_request(Request.STOP if planned else Request.STOP_AND_LATCH)

        def is_over(status: SenderStatus) -> bool:
            is_neutral = status.epoch >= epoch and (status.is_neutral_settled or not status.is_sending)
            return status.is_ended or is_neutral or _hangs(sender)

        status = self._await(is_over, ANSWER_TIMEOUT_S)
        if planned and is_armed and not status.is_neutral_settled:
            name, cause = self.config.device_kind.name, status.fault or "the sender process does not answer."
            _log.warning(
                "Neutral may not have arrived at the stop; then the %s's own time-out stops the motor: %s", name, cause
            )

    def reset_fault(self) -> None:
        """Clear a latched fault; the actuator stays disarmed.

        Raises ActuatorFaultError if the cause persists, and NotOpenError.
        """
        status = self._require_live_status(self._opened())
        if not self._latched and status.state != SenderState.FAULT:
            return
        if status.state != SenderState.FAULT:
            self._await_epoch(self._post_request(Request.STOP_AND_LATCH))
        status = self._await_epoch(self._post_request(Request.RESET_FAULT))
        if status.state == SenderState.FAULT:
            raise ActuatorFaultError(status.refusal or status.fault)
        self._latched = ""

    def status(self) -> SenderStatus:
        """The newest status that the sender has published. Raises NotOpenError."""
        return self._opened().status()

    def require_no_fault(self) -> None:
        """Raise ActuatorFaultError if a fault is latched or the sender has ended or hangs, NotOpenError when closed."""
        self._require_faultless_status(self._opened())

    def problems(self) -> tuple[str, ...]:
        """Conditions that prevent arming, each with its remedy; empty if there are none."""
        if not self.is_open or self._sender is None:
            return ("the actuator is not open; call open() first.",)
        if not self._is_sender_alive():
            return ("the sender process has ended; close the car and open it again.",)
        status = self._sender.status()
        found = []
        if status.state == SenderState.FAULT or self._latched:
            found.append(status.fault or self._latched)
        age_s = time.monotonic() - status.t_telemetry_s
        if not age_s <= self.config.telemetry_stale_s and not found:
            found.append(f"the {self.config.device_kind.name}'s telemetry is {age_s:.1f} s old; check the link.")
        if status.motor_timeout_s == math.inf:
            kind = self.config.device_kind
            found.append(
                f"the {kind.name} does not stop the motor within {MAX_TIMEOUT_S:g} s after the last command; "
                f"{kind.timeout_hint}"
            )
        return tuple(found)

    def health(self) -> Health:
        """Condition of link, firmware and timing."""
        problems = self.problems()
        if not self.is_open or self._sender is None:
            return Health(False, problems)
        status = self._sender.status()
        warnings = []
        if ADVISED_TIMEOUT_S < status.motor_timeout_s < math.inf:
            kind = self.config.device_kind
            warnings.append(
                f"the {kind.name} stops the motor only {status.motor_timeout_s:.1f} s after the last command, if the "
                f"computer or the cable fails; {kind.timeout_hint}"
            )
        if self._unmeasured_cause:
            kind = self.config.device_kind
            warnings.append(f"the time-out of the {kind.name} was not measured: {self._unmeasured_cause}")
        device = self.config.device_kind.name.lower()
        readings = {
            "battery_v": status.input_v,
            "motor_erpm": status.erpm,
            "tachometer_steps": status.tachometer_steps,
            f"{device}_fault_code": float(status.fault_code),
            f"{device}_motor_timeout_flag": float(status.is_motor_released),
            f"{device}_time_to_motor_release_s": status.motor_timeout_s,
            "firmware_version": status.firmware_major + status.firmware_minor / 100.0,
            "telemetry_age_s": time.monotonic() - status.t_telemetry_s,
            "command_to_wire_s": status.t_written_s - status.t_issued_s,
            "sender_late_p50_ms": status.late_p50_ms,
            "sender_late_p99_ms": status.late_p99_ms,
            "sender_late_max_ms": status.late_max_ms,
            "sender_skipped_count": float(status.skipped_ticks),
            "sender_realtime_flag": float(status.is_realtime),
            "frames_count": float(status.frames),
            "neutral_frames_count": float(status.neutral_frames),
            "watchdog_trips_count": float(status.watchdog_trips),
            "crc_errors_count": float(status.crc_errors),
            "garbage_bytes_count": float(status.garbage_bytes),
            "link_opens_count": float(status.link_opens),
        }
        finite = {name: value for name, value in readings.items() if math.isfinite(value)}
        return Health(not problems, problems, finite, tuple(warnings))

    def close(self) -> None:
        """Send neutral at least three times, then disconnect; bounded in time, idempotent, safe after any failure."""
        sender = self._sender
        if sender is None:
            return
        if self._owner_pid != os.getpid():
            self._sender = None
            return
        try:
            if sender.is_alive():
                self._post_request(Request.SHUT_DOWN)
                sender.join(ANSWER_TIMEOUT_S)
        finally:
            self._sender = None
            atexit.unregister(self.close)
            sender.close()

    def _opened(self) -> Sender:
        if self._sender is None:
            raise NotOpenError("The actuator is not open; call open() first, or use it in a with block.")
        if self._owner_pid != os.getpid():
            raise NotOpenError("The actuator was opened by another process; create a new Actuator after a fork.")
        return self._sender

    def _is_sender_alive(self) -> bool:
        return self._sender is not None and self._sender.is_alive()

    def _require_live_status(self, sender: Sender) -> SenderStatus:
        """Status of a running sender; a sender that hangs is a fault, even if it resumes."""
        hangs = _hangs(sender)
        status, name = sender.status(), self.config.device_kind.name
        if not sender.is_alive():
            raise ActuatorFaultError(
                status.fault
                or f"The sender process has {sender.ending()}; the {name}'s own time-out stops the motor. "
                "Open the car again."
            )
        if hangs:
            raise self._latch(
                f"The sender process hangs; the {name}'s own time-out stops the motor. Open the car again."
            )
        return status

    def _require_faultless_status(self, sender: Sender) -> SenderStatus:
        status = self._require_live_status(sender)
        if status.state == SenderState.FAULT:
            raise ActuatorFaultError(status.fault)
        if self._latched:
            raise ActuatorFaultError(self._latched)
        return status

    def _latch(self, text: str) -> ActuatorFaultError:
        """Latch a fault here and post it to the sender; returns the error to raise."""
        self._latched = self._latched or text
        self._post_request(Request.STOP_AND_LATCH)
        return ActuatorFaultError(text)

    def _post_request(self, request: Request) -> int:
        sender = self._opened()
        with self._lock:
            self._epoch += 1
            self._number = 0
            neutral: DeviceCommand = self.calibration.neutral
            sender.post(Order(self._epoch, request, 0, time.monotonic(), neutral))
            return self._epoch

    def _await(self, is_met: Callable[[SenderStatus], bool], timeout_s: float) -> SenderStatus:
        """First status that meets the condition; the newest status after ``timeout_s`` or the end of the sender."""
        sender = self._opened()
        until_s = time.monotonic() + timeout_s
        while not is_met(status := sender.status()):
            if time.monotonic() > until_s or not sender.is_alive():
                return sender.status()
            time.sleep(POLL_S)
        return status

    def _await_epoch(self, epoch: int) -> SenderStatus:
        status = self._await(lambda s: s.epoch >= epoch or s.is_ended, ANSWER_TIMEOUT_S)
        if status.epoch < epoch:
            raise self._latch(status.fault or "The sender process does not answer; close the car and open it again.")
        return status

    def _await_connection(self) -> None:
        status = self._await(lambda s: s.is_link_open or s.is_ended, START_TIMEOUT_S)
        if status.is_link_open and not status.is_ended:
            settled = (SenderState.CONNECTED, SenderState.FAULT)
            status = self._await(lambda s: s.is_ended or s.state in settled, self.config.open_timeout_s)
            if status.state == SenderState.CONNECTED:
                return
        what = f"The {self.config.device_kind.name} at {self.config.address} is not ready"
        raise NotReadyError(what, (status.fault or self._failure(status),))

    def _failure(self, status: SenderStatus) -> str:
        """Why the sender is not connected although it reports no fault: its end, or the step that took too long."""
        sender = self._opened()
        if status.is_ended:
            sender.join(ANSWER_TIMEOUT_S)  # it publishes its last status shortly before it ends
        has_started = status.t_published_s > 0.0
        if ending := sender.ending():
            step = f"waited for the {self.config.device_kind.name}" if status.is_link_open else "opened the link"
            return f"the sender process {ending} while it {step if has_started else 'started'}."
        if not has_started:
            used_s = sender.processor_time_s()
            effort = "" if math.isnan(used_s) else f"; it has used {used_s:.2g} s of processor time"
            return f"the sender process has not started within {START_TIMEOUT_S:g} s{effort}. End other programs."
        if not status.is_link_open:
            return f"it cannot be opened within {START_TIMEOUT_S:g} s; check its adapter, cable and network."
        return self._silence(status)

    def _silence(self, status: SenderStatus) -> str:
        kind = self.config.device_kind
        if status.firmware_major:
            return "it reports its version but sends no telemetry; restart it and check its app settings."
        garbage = status.garbage_bytes + status.crc_errors
        if garbage and kind.garbage_hint:
            return f"the device that answers is not a {kind.name} ({garbage} bytes of garbage); {kind.garbage_hint}"
        return kind.silent_hint


def _hangs(sender: Sender) -> bool:
    """Whether the sender has published no status for ``SILENT_SENDER_S``, and publishes none in ``RESUME_POLLS``."""
    for _ in range(RESUME_POLLS):
        status = sender.status()
        if time.monotonic() - status.t_published_s <= SILENT_SENDER_S or not sender.is_alive():
            return False
        time.sleep(POLL_S)
    return True
