"""VESC command payloads: the contents of serial frames and CAN transport packets. Pure functions.

Facts: the open VESC firmware (vedderb/bldc: comm/commands.c, util/buffer.c, datatypes.h). Byte 0 of a payload is the
command id; integers are big-endian two's complement. The firmware truncates scaled numbers, this module rounds. The ids
hold from firmware 3.07 on; in older firmware id 12 is another command, so older firmware is refused.
"""

from __future__ import annotations

import dataclasses
import enum
import math
import struct
from dataclasses import dataclass

from carlab.core.errors import ProtocolError
from drivers.device import FirmwareIdentity


class Command(enum.IntEnum):
    """Command ids of firmware 3.07 and later (those used here)."""

    FW_VERSION = 0
    GET_VALUES = 4
    SET_DUTY = 5
    SET_CURRENT = 6
    SET_CURRENT_BRAKE = 7
    SET_RPM = 8
    SET_SERVO_POS = 12
    ALIVE = 30
    GET_VALUES_SELECTIVE = 50


CURRENT_SCALE = 1e3
DUTY_SCALE = 1e5
SERVO_SCALE = 1e3
MINIMUM_FIRMWARE = (3, 7)
SELECTIVE_FIRMWARE = (3, 48)
CONTROL_MASK = 0x0020A180
"""Fields that control needs: eRPM, input voltage, tachometer, fault code, status (17-byte reply)."""

FAULT_NAMES = {
    0: "none", 1: "over-voltage", 2: "under-voltage", 3: "gate driver", 4: "absolute over-current",
    5: "over-temperature of the power stage", 6: "over-temperature of the motor", 7: "gate driver over-voltage",
    8: "gate driver under-voltage", 9: "under-voltage of the processor", 10: "restart by its own watchdog",
    11: "encoder SPI", 12: "encoder amplitude too low", 13: "encoder amplitude too high", 14: "flash corruption",
    15: "current sensor 1 offset", 16: "current sensor 2 offset", 17: "current sensor 3 offset",
    18: "unbalanced currents", 19: "brake chopper",
}  # fmt: skip


def fault_name(code: int) -> str:
    """Name of a fault code of the firmware."""
    return FAULT_NAMES.get(code, f"fault code {code}")


def scaled_integer(value: float, scale: float, bits: int, name: str) -> int:
    """Round ``value * scale`` to a signed integer of ``bits`` bits.

    Raises ProtocolError for NaN, infinities and numbers out of range.
    """
    scaled = value * scale
    if not math.isfinite(scaled):
        raise ProtocolError(f"{name} is {value}; it must be a finite number.")
    limit = 2 ** (bits - 1)
    if not -limit - 0.5 < scaled < limit - 0.5:
        raise ProtocolError(f"{name} {value:g} does not fit into {bits} bits.")
    return round(scaled)


def _set_int32(command: Command, value: float, scale: float, name: str) -> bytes:
    return struct.pack(">Bi", command, scaled_integer(value, scale, 32, name))


def set_duty(duty: float) -> bytes:
    """SET_DUTY; ``duty`` in [-1, 1], 1e-5 resolution. Raises ProtocolError for another number."""
    if not -1.0 <= duty <= 1.0:
        raise ProtocolError(f"duty {duty} is outside [-1, 1].")
    return _set_int32(Command.SET_DUTY, duty, DUTY_SCALE, "duty")


def set_current(current_a: float) -> bytes:
    """SET_CURRENT [A], 1 mA resolution. Raises ProtocolError for a number that does not fit or is not finite."""
    return _set_int32(Command.SET_CURRENT, current_a, CURRENT_SCALE, "current")


def set_current_brake(current_a: float) -> bytes:
    """SET_CURRENT_BRAKE [A], 1 mA resolution. Raises ProtocolError as ``set_current``."""
    return _set_int32(Command.SET_CURRENT_BRAKE, current_a, CURRENT_SCALE, "brake current")


def set_servo_position(position: float) -> bytes:
    """SET_SERVO_POS in [0, 1], 0.001 resolution. Raises ProtocolError for another number.

    The servo has no time-out and does not reset the motor's.
    """
    if not 0.0 <= position <= 1.0:
        raise ProtocolError(f"servo position {position} is outside [0, 1].")
    return struct.pack(">Bh", Command.SET_SERVO_POS, scaled_integer(position, SERVO_SCALE, 16, "servo position"))


def get_values() -> bytes:
    """GET_VALUES request."""
    return bytes((Command.GET_VALUES,))


def get_values_selective(mask: int = CONTROL_MASK) -> bytes:
    """GET_VALUES_SELECTIVE request (firmware 3.48 and later). Reading resets the averages (bits 2-5, 19, 20)."""
    return struct.pack(">BI", Command.GET_VALUES_SELECTIVE, mask)


def get_firmware_version() -> bytes:
    """FW_VERSION request; its id is 0 in every firmware."""
    return bytes((Command.FW_VERSION,))


@dataclass(frozen=True, slots=True)
class MotorValues:
    """Telemetry. A field that the firmware did not send is None. The fields are in wire order."""

    temp_fet_c: float | None = None
    temp_motor_c: float | None = None
    motor_current_a: float | None = None
    input_current_a: float | None = None
    id_a: float | None = None
    iq_a: float | None = None
    duty: float | None = None
    erpm: float | None = None
    input_v: float | None = None
    used_ah: float | None = None
    charged_ah: float | None = None
    used_wh: float | None = None
    charged_wh: float | None = None
    tachometer_steps: float | None = None
    tachometer_abs_steps: float | None = None
    fault_code: int | None = None
    pid_position_deg: float | None = None
    controller_id: int | None = None
    temp_mos1_c: float | None = None
    temp_mos2_c: float | None = None
    temp_mos3_c: float | None = None
    vd_v: float | None = None
    vq_v: float | None = None
    status_bits: int | None = None

    @property
    def motor_timeout_active(self) -> bool | None:
        """Whether the firmware's time-out has released the motor; None if it does not report it (before 6.00)."""
        return None if self.status_bits is None else bool(self.status_bits & 1)

    @property
    def kill_switch_active(self) -> bool:
        """Whether the firmware reports that its kill switch is pressed (firmware 6.00 and later)."""
        return bool((self.status_bits or 0) & 2)

    def fault(self) -> str:
        """Reason why the firmware forbids driving, with the remedy; empty if there is none."""
        if self.fault_code:
            return f"the VESC reports {fault_name(self.fault_code)}; remedy it, then reset the fault."
        if self.kill_switch_active:
            return "the VESC's kill switch is pressed; release it, then reset the fault."
        return ""

    def updated(self, newer: MotorValues) -> MotorValues:
        """Copy with every field replaced that ``newer`` holds."""
        fields = {f.name: getattr(newer, f.name) for f in dataclasses.fields(newer)}
        return dataclasses.replace(self, **{name: value for name, value in fields.items() if value is not None})


# One row per mask bit: struct format, scale, fields.
VALUE_ROWS: tuple[tuple[str, float, tuple[str, ...]], ...] = (
    ("h", 10, ("temp_fet_c",)), ("h", 10, ("temp_motor_c",)), ("i", 100, ("motor_current_a",)),
    ("i", 100, ("input_current_a",)), ("i", 100, ("id_a",)), ("i", 100, ("iq_a",)), ("h", 1000, ("duty",)),
    ("i", 1, ("erpm",)), ("h", 10, ("input_v",)), ("i", 1e4, ("used_ah",)), ("i", 1e4, ("charged_ah",)),
    ("i", 1e4, ("used_wh",)), ("i", 1e4, ("charged_wh",)), ("i", 1, ("tachometer_steps",)),
    ("i", 1, ("tachometer_abs_steps",)), ("B", 0, ("fault_code",)), ("i", 1e6, ("pid_position_deg",)),
    ("B", 0, ("controller_id",)), ("h", 10, ("temp_mos1_c", "temp_mos2_c", "temp_mos3_c")),
    ("i", 1000, ("vd_v",)), ("i", 1000, ("vq_v",)), ("B", 0, ("status_bits",)),
)  # fmt: skip
FULL_MASK = (1 << len(VALUE_ROWS)) - 1
OLD_LAYOUT_LENGTH = 56


def encode_values(values: MotorValues, mask: int) -> bytes:
    """Encode the telemetry fields of the ``mask`` bits as the firmware does; None becomes zero.

    Raises ProtocolError for a number that does not fit or is not finite.
    """
    out = bytearray()
    for bit, (form, scale, names) in enumerate(VALUE_ROWS):
        if mask >> bit & 1:
            for name in names:
                value = getattr(values, name) or 0
                bits = 8 * struct.calcsize(form)
                raw = int(value) & 0xFF if form == "B" else scaled_integer(value, scale, bits, name)
                out += struct.pack(">" + form, raw)
    return bytes(out)


def _decode_fields(data: bytes, mask: int, what: str) -> MotorValues:
    found: dict[str, float | int] = {}
    offset = 0
    for bit, (form, scale, names) in enumerate(VALUE_ROWS):
        if not mask >> bit & 1:
            continue
        if offset == len(data):
            return MotorValues(**found)  # type: ignore[arg-type]
        for name in names:
            end = offset + struct.calcsize(form)
            if end > len(data):
                raise ProtocolError(f"{what} of {len(data)} data bytes ends inside {name}; its layout is unknown.")
            (raw,) = struct.unpack_from(">" + form, data, offset)
            found[name] = raw / scale if scale else raw
            offset = end
    return MotorValues(**found)  # type: ignore[arg-type]


def decode_get_values(payload: bytes) -> MotorValues:
    """Decode a GET_VALUES reply by its length; further fields of newer firmware are ignored.

    Raises ProtocolError for the layout of firmware 3.00 and older and for a length that ends inside a field.
    """
    if len(payload) == OLD_LAYOUT_LENGTH:
        raise ProtocolError("GET_VALUES reply of firmware 3.00 or older; update the VESC's firmware with VESC Tool.")
    if len(payload) < 54:
        raise ProtocolError(f"GET_VALUES reply of {len(payload)} bytes is too short; the minimum is 54.")
    return _decode_fields(payload[1:], FULL_MASK, "GET_VALUES reply")


def decode_get_values_selective(payload: bytes) -> MotorValues:
    """Decode a GET_VALUES_SELECTIVE reply by its mask. Raises ProtocolError for a truncated reply."""
    if len(payload) < 5:
        raise ProtocolError(f"GET_VALUES_SELECTIVE reply of {len(payload)} bytes has no mask.")
    (mask,) = struct.unpack_from(">I", payload, 1)
    return _decode_fields(payload[5:], mask, "GET_VALUES_SELECTIVE reply")


@dataclass(frozen=True, slots=True)
class FirmwareVersion(FirmwareIdentity):
    """Reply to FW_VERSION; fields other than the version number are optional (later firmware only)."""

    @property
    def text(self) -> str:
        """The version as VESC Tool prints it, for example 6.05."""
        return f"{self.major}.{self.minor:02d}"

    def refusal(self) -> str | None:
        """Reason why this firmware cannot be used, with the remedy; None if it can."""
        if (self.major, self.minor) < MINIMUM_FIRMWARE:
            return (
                f"firmware {self.text} is older than 3.07 and numbers its commands differently; "
                "update it with VESC Tool."
            )
        return None


def telemetry_request(version: FirmwareVersion | None) -> bytes:
    """Request for the fields that control needs; for all fields if the firmware cannot select."""
    if version is not None and (version.major, version.minor) >= SELECTIVE_FIRMWARE:
        return get_values_selective()
    return get_values()


def decode_firmware_version(payload: bytes) -> FirmwareVersion:
    """Decode a FW_VERSION reply. Raises ProtocolError if the version number is missing."""
    if len(payload) < 3:
        raise ProtocolError(f"FW_VERSION reply of {len(payload)} bytes has no version number.")
    name, terminator, rest = payload[3:].partition(b"\0")
    hardware = name.decode("ascii", "replace") if terminator else ""
    return FirmwareVersion(payload[1], payload[2], hardware, bytes(rest[:12]) if len(rest) >= 12 else b"")


def encode_firmware_version(version: FirmwareVersion) -> bytes:
    """Encode a FW_VERSION reply with hardware name, UUID and trailing zeros, as firmware 6.05 does."""
    head = bytes((Command.FW_VERSION, version.major, version.minor)) + version.hardware.encode("ascii") + b"\0"
    return head + version.uuid.ljust(12, b"\0")[:12] + bytes(8) + b"\0" + bytes(4)


def decode_reply(payload: bytes) -> MotorValues | FirmwareVersion | None:
    """Decode a reply by its command id; None for an unused id (asynchronous prints, for example).

    Raises ProtocolError if the id is known and the layout is wrong.
    """
    if not payload:
        raise ProtocolError("A payload without a command id.")
    if payload[0] == Command.FW_VERSION:
        return decode_firmware_version(payload)
    if payload[0] == Command.GET_VALUES:
        return decode_get_values(payload)
    if payload[0] == Command.GET_VALUES_SELECTIVE:
        return decode_get_values_selective(payload)
    return None
