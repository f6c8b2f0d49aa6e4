"""Emulation of a VESC's firmware at the level of payloads. Pure except for its callbacks and log.

Behaviour (vedderb/bldc comm/commands.c, timeout.c): SET_* and ALIVE have no reply and reset the motor's time-out;
servo commands and requests for values do not reset it; the servo has no time-out. A time-out releases the motor; the
next SET_* acts at once. During a fault, and while the kill switch is pressed, motor commands release the motor.
"""

from __future__ import annotations

import dataclasses
import struct
from collections.abc import Callable

from carlab.core.errors import ProtocolError
from drivers.emulators.command_log import CommandLog
from drivers.vesc.payloads import (
    CURRENT_SCALE,
    DUTY_SCALE,
    FULL_MASK,
    SERVO_SCALE,
    Command,
    FirmwareVersion,
    MotorValues,
    encode_firmware_version,
    encode_values,
)

MotorCallback = Callable[[float, str, float], None]
ServoCallback = Callable[[float, float], None]
EMULATED_VERSION = FirmwareVersion(6, 5, "EMULATED", bytes.fromhex("e0e0e0e0e0e0e0e0e0e0e001"))
VALUES_AT_REST = MotorValues(temp_fet_c=25.0, temp_motor_c=25.0, erpm=0.0, input_v=11.1, fault_code=0)

_SETTERS = {
    Command.SET_CURRENT: ("current", CURRENT_SCALE),
    Command.SET_CURRENT_BRAKE: ("brake", CURRENT_SCALE),
    Command.SET_DUTY: ("duty", DUTY_SCALE),
    Command.SET_RPM: ("rpm", 1.0),
}


def _telemetry_bytes(values: MotorValues, mask: int) -> bytes:
    """Telemetry bytes; values out of range (from a diverged plant) are encoded as zero."""
    try:
        return encode_values(values, mask)
    except ProtocolError:
        return encode_values(MotorValues(fault_code=values.fault_code, status_bits=values.status_bits), mask)


class VescFirmware:
    """State of an emulated VESC: motor, servo and motor time-out. Time is an argument of every call.

    Args:
        log: Log of commands and events.
        on_motor: Called with time [s], kind (``current`` [A], ``brake`` [A], ``duty``, ``rpm`` or ``release``) and
            value for every motor command, and when the time-out releases the motor.
        on_servo: Called with time [s] and position in [0, 1].
        readings: Measurements of the motor controller at a time [s]; by default those of a car at rest.
        motor_timeout_s: Time without a motor command after which the motor is released [s].
        controller_id: Controller id on CAN.
    """

    def __init__(
        self,
        log: CommandLog,
        *,
        on_motor: MotorCallback | None = None,
        on_servo: ServoCallback | None = None,
        readings: Callable[[float], MotorValues] | None = None,
        motor_timeout_s: float = 1.0,
        controller_id: int = 23,
    ) -> None:
        self.log = log
        self.on_motor = on_motor
        self.on_servo = on_servo
        self.readings = readings
        self.motor_timeout_s = motor_timeout_s
        self.version = EMULATED_VERSION
        self.controller_id = controller_id
        self.kill_switch = False
        self.fault_code = 0
        self._t_fed_s: float | None = None
        self._is_timed_out = True

    def handle(self, payload: bytes, t_s: float) -> bytes | None:
        """Execute a payload that arrived at ``t_s`` and return its reply or None. Invalid payloads are ignored."""
        if not payload:
            return None
        command, data = payload[0], payload[1:]
        if command in _SETTERS and len(data) >= 4:
            name, scale = _SETTERS[Command(command)]
            self._set_motor(name, struct.unpack_from(">i", data)[0] / scale, t_s)
        elif command == Command.SET_SERVO_POS and len(data) >= 2:
            self._set_servo(struct.unpack_from(">h", data)[0] / SERVO_SCALE, t_s)
        elif command == Command.ALIVE:
            self.log.add(t_s, "alive")
            self._feed(t_s)
        elif command == Command.FW_VERSION:
            self.log.add(t_s, "firmware")
            return encode_firmware_version(self.version)
        elif command == Command.GET_VALUES:
            self.log.add(t_s, "values")
            return bytes((command,)) + _telemetry_bytes(self.values(t_s), FULL_MASK)
        elif command == Command.GET_VALUES_SELECTIVE and len(data) >= 4:
            self.log.add(t_s, "values")
            (mask,) = struct.unpack_from(">I", data)
            return payload[:5] + _telemetry_bytes(self.values(t_s), mask)
        return None

    def values(self, t_s: float) -> MotorValues:
        """Telemetry at ``t_s``."""
        read = VALUES_AT_REST if self.readings is None else self.readings(t_s)
        status = int(self._is_timed_out) | int(self.kill_switch) << 1
        return dataclasses.replace(
            read,
            fault_code=self.fault_code or read.fault_code or 0,
            controller_id=self.controller_id,
            status_bits=status,
        )

    def poll(self, t_s: float) -> None:
        """Advance the time; the motor is released after ``motor_timeout_s`` without a motor command."""
        if self._is_timed_out or self._t_fed_s is None or t_s - self._t_fed_s <= self.motor_timeout_s:
            return
        self._is_timed_out = True
        self.log.add(t_s, "motor_timeout", t_s - self._t_fed_s)
        if self.on_motor is not None:
            self.on_motor(t_s, "release", 0.0)

    def _feed(self, t_s: float) -> None:
        self._t_fed_s = t_s
        self._is_timed_out = False

    def _set_motor(self, name: str, value: float, t_s: float) -> None:
        self.log.add(t_s, name, value)
        self._feed(t_s)
        if self.fault_code or self.kill_switch:
            name, value = "release", 0.0
        if self.on_motor is not None:
            self.on_motor(t_s, name, value)

    def _set_servo(self, position: float, t_s: float) -> None:
        position = min(1.0, max(0.0, position))
        self.log.add(t_s, "servo", position)
        if self.on_servo is not None:
            self.on_servo(t_s, position)
