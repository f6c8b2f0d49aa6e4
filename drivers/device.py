"""What the sender needs of a motor controller, whatever protocol it speaks: commands out, telemetry in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, Self

from drivers.calibration import DeviceCommand


@dataclass(frozen=True, slots=True)
class FirmwareIdentity:
    """What the firmware says that it is; ``uuid`` is empty where it does not identify the board."""

    major: int
    minor: int
    hardware: str = ""
    uuid: bytes = b""

    def refusal(self) -> str | None:
        """Why this firmware cannot be driven, or None."""
        return None


class Telemetry(Protocol):
    """What the motor controller measures. A field that has not been received is None."""

    @property
    def erpm(self) -> float | None:
        """Electrical motor speed [rev/min], negative backwards."""

    @property
    def input_v(self) -> float | None:
        """Battery voltage [V]."""

    @property
    def tachometer_steps(self) -> float | None:
        """Motor position [steps]."""

    @property
    def fault_code(self) -> int | None:
        """Fault code of the firmware; 0 where there is none."""

    @property
    def motor_timeout_active(self) -> bool:
        """Whether the firmware has released the motor because no command came."""

    def fault(self) -> str:
        """Why the firmware forbids driving, with the remedy; empty where it does not."""

    def updated(self, newer: Self) -> Self:
        """These values with every field that ``newer`` carries replaced."""


Reply = FirmwareIdentity | Telemetry


@dataclass(slots=True)
class DeviceCounters:
    """Errors of reception; a reply of an unknown layout counts as garbage, byte by byte."""

    crc_errors: int = 0
    garbage_bytes: int = 0
    partial_timeouts: int = 0
    link_opens: int = 0


class Device(Protocol):
    """A motor controller behind a link.

    Constructing does nothing. After ``open`` each failure of the link is an ActuatorFaultError.
    """

    @property
    def counters(self) -> DeviceCounters:
        """Errors of reception since construction."""

    def open(self) -> None:
        """Open the link; raises NotReadyError."""

    def send(self, command: DeviceCommand) -> None:
        """Write motor and servo commands."""

    def request_firmware(self) -> None:
        """Ask the firmware what it is."""

    def request_telemetry(self) -> None:
        """Ask for the telemetry that control needs; called once the firmware is known."""

    def receive(self, now_s: float) -> Sequence[Reply]:
        """Replies that have arrived, oldest first; never blocks."""

    def fileno(self) -> int | None:
        """A descriptor to wait on, or None."""

    def close(self) -> None:
        """Close the link. Idempotent."""
