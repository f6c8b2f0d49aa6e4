"""Protocol-independent interface of a motor controller for the sender: commands out, telemetry in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, Self

from drivers.calibration import DeviceCommand


@dataclass(frozen=True, slots=True)
class FirmwareIdentity:
    """Version and board that the firmware reports; ``uuid`` is empty if it does not identify the board."""

    major: int
    minor: int
    hardware: str = ""
    uuid: bytes = b""

    def refusal(self) -> str | None:
        """Reason why this firmware cannot be used, with the remedy; None if it can."""
        return None


class Telemetry(Protocol):
    """Measurements of the motor controller. A field that has not been received is None."""

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
        """Fault code of the firmware; 0 for no fault. Telemetry without it does not count as fresh."""

    @property
    def motor_timeout_active(self) -> bool | None:
        """Whether the firmware has released the motor because it received no command in time; None if unknown."""

    def fault(self) -> str:
        """Reason why the firmware forbids driving, with the remedy; empty if there is none."""

    def updated(self, newer: Self) -> Self:
        """Copy with every field replaced that ``newer`` holds."""


Reply = FirmwareIdentity | Telemetry


@dataclass(slots=True)
class DeviceCounters:
    """Reception errors; every byte of a reply of unknown layout counts as garbage."""

    crc_errors: int = 0
    garbage_bytes: int = 0
    link_opens: int = 0


class Device(Protocol):
    """A motor controller behind a link.

    Constructing does nothing. After ``open`` each failure of the link is an ActuatorFaultError.
    """

    @property
    def counters(self) -> DeviceCounters:
        """Reception errors since construction."""

    def open(self) -> None:
        """Open the link; raises NotReadyError."""

    def send(self, command: DeviceCommand) -> None:
        """Write motor and servo commands."""

    def request_firmware(self) -> None:
        """Request version and board of the firmware."""

    def request_telemetry(self) -> None:
        """Request the telemetry that control needs; the sender calls it once the firmware is known."""

    def receive(self, now_s: float) -> Sequence[Reply]:
        """Replies that have arrived, oldest first; never blocks."""

    def fileno(self) -> int | None:
        """A descriptor to wait on, or None."""

    def close(self) -> None:
        """Close the link. Idempotent."""
