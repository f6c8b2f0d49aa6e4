"""Status of the sender, published for the main process."""

from __future__ import annotations

import dataclasses
import struct
from dataclasses import dataclass
from typing import Any

from drivers.sender.logic import SenderState

TEXT_BYTES = 640
NAME_BYTES = 64


@dataclass(frozen=True, slots=True)
class SenderStatus:
    """A snapshot of the sender. Times are on the host's monotonic clock; NaN means unknown.

    ``epoch`` is that of the last request handled; ``refusal`` is the reason if it was refused. ``sent_number``,
    ``t_issued_s`` and ``t_written_s`` (start of the write) belong to the newest command written. ``is_sending`` is
    False while the link is closed or the firmware unknown. ``is_motor_released``: the firmware's time-out has released
    the motor. ``motor_timeout_s``: the measured time-out, infinite if there is none. ``late_*`` is the lateness of the
    sender's deadlines.
    """

    t_published_s: float = 0.0
    state: SenderState = SenderState.DISCONNECTED
    epoch: int = 0
    is_neutral_settled: bool = False
    is_link_open: bool = False
    is_sending: bool = False
    is_realtime: bool = False
    is_ended: bool = False
    firmware_major: int = 0
    firmware_minor: int = 0
    t_telemetry_s: float = float("nan")
    erpm: float = float("nan")
    input_v: float = float("nan")
    tachometer_steps: float = float("nan")
    fault_code: int = 0
    is_motor_released: bool = False
    motor_timeout_s: float = float("nan")
    sent_number: int = 0
    t_issued_s: float = float("nan")
    t_written_s: float = float("nan")
    late_p50_ms: float = 0.0
    late_p99_ms: float = 0.0
    late_max_ms: float = 0.0
    skipped_ticks: int = 0
    frames: int = 0
    neutral_frames: int = 0
    watchdog_trips: int = 0
    crc_errors: int = 0
    garbage_bytes: int = 0
    link_opens: int = 0
    hardware: str = ""
    fault: str = ""
    refusal: str = ""

    def pack(self) -> bytes:
        """Bytes for a slot; long texts are truncated."""
        values = []
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            values.append(value.encode("utf-8", "replace") if isinstance(value, str) else value)
        return _LAYOUT.pack(*values)

    @classmethod
    def unpack(cls, data: bytes) -> SenderStatus:
        """Inverse of ``pack``."""
        values: dict[str, Any] = {
            field.name: value.rstrip(b"\0").decode("utf-8", "ignore") if isinstance(value, bytes) else value
            for field, value in zip(dataclasses.fields(cls), _LAYOUT.unpack(data), strict=True)
        }
        values["state"] = SenderState(values["state"])
        return cls(**values)


_FORMS = {"float": "d", "int": "q", "bool": "?", "SenderState": "B"}
_TEXTS = {"hardware": NAME_BYTES, "fault": TEXT_BYTES, "refusal": TEXT_BYTES}
_LAYOUT = struct.Struct(
    "<"
    + "".join(
        f"{_TEXTS[field.name]}s" if field.name in _TEXTS else _FORMS[str(field.type)]
        for field in dataclasses.fields(SenderStatus)
    )
)
STATUS_SIZE = _LAYOUT.size
