"""Configuration of a car's hardware: the table ``[hardware]`` of the car file."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

from carlab.core.errors import ConfigError
from carlab.core.safety_bounds import SAFETY_BOUNDS, check_bound
from drivers.calibration import ActuatorCalibration
from drivers.device_kinds import DEVICE_KINDS, DeviceKind
from drivers.links.lines import BITS_PER_BYTE, can_frame_bits, slcan_line_bytes, slcan_port

MULTICAST_GROUP = "239.74.163.2"


@dataclass(frozen=True, slots=True)
class ActuatorConfig:
    """Configuration of the actuator: the table ``[hardware.actuator]``.

    ``kind`` is vesc_serial or vesc_can (``DEVICE_KINDS``). A serial kind uses ``port`` and ``baud`` (ignored on USB). A
    bus uses ``interface`` (any of python-can: socketcan, slcan, pcan, ..., ``udp_multicast`` between processes,
    ``virtual`` within one), ``channel`` (of an slcan adapter its serial port, PORT or PORT@BAUD), ``bitrate``, the
    ``controller_id`` and a ``host_id`` that is unique on the bus. The sender sends at ``rate_hz``. It replaces a
    command older than ``watchdog_s`` by neutral, so ``control_period`` of the car file must be shorter; a command older
    than ``latch_s`` latches a fault. It polls telemetry at ``telemetry_rate_hz``; telemetry older than
    ``telemetry_stale_s`` gives neutral, older than ``telemetry_lost_s`` latches a fault. ``realtime_priority`` requests
    SCHED_FIFO; the sender runs without it if the system refuses.
    """

    kind: str = "vesc_serial"
    port: str = "/dev/ttyACM0"
    baud: int = 115200
    interface: str = "socketcan"
    channel: str = "can0"
    bitrate: int = 500_000
    controller_id: int = 23
    host_id: int = 42
    rate_hz: float = 100.0
    watchdog_s: float = 0.15
    latch_s: float = 0.5
    telemetry_rate_hz: float = 50.0
    telemetry_stale_s: float = 0.25
    telemetry_lost_s: float = 1.0
    open_timeout_s: float = 3.0
    realtime_priority: bool = True

    def __post_init__(self) -> None:
        """Raise ConfigError for an unknown kind or inconsistent numbers."""
        if self.kind not in DEVICE_KINDS:
            raise ConfigError(f"kind of the actuator is {self.kind!r}; it must be one of {', '.join(DEVICE_KINDS)}.")
        for name in ("interface", "channel") if self.device_kind.is_bus else ("port",):
            if not getattr(self, name).strip():
                raise ConfigError(f"'{name}' in [hardware.actuator] is empty; name the link to the actuator.")
        if not 10.0 <= self.rate_hz <= 500.0:
            raise ConfigError(f"rate_hz is {self.rate_hz:g}; it must lie in [10, 500].")
        if not 1.0 <= self.telemetry_rate_hz <= 200.0:
            raise ConfigError(f"telemetry_rate_hz is {self.telemetry_rate_hz:g}; it must lie in [1, 200].")
        if not 1.0 / self.rate_hz < self.watchdog_s < self.latch_s:
            raise ConfigError(
                f"watchdog_s {self.watchdog_s:g} must be longer than one period of rate_hz and shorter than latch_s "
                f"{self.latch_s:g} (in seconds: is one in another unit?)."
            )
        if not 1.0 / self.telemetry_rate_hz < self.telemetry_stale_s < self.telemetry_lost_s:
            raise ConfigError(
                f"telemetry_stale_s {self.telemetry_stale_s:g} must be longer than a telemetry period and shorter than "
                f"telemetry_lost_s {self.telemetry_lost_s:g} (in seconds: is one in another unit?)."
            )
        if not 0 <= self.controller_id <= 254 or not 0 <= self.host_id <= 254 or self.controller_id == self.host_id:
            raise ConfigError("controller_id and host_id must be two different numbers in 0 ... 254.")
        if not 0.0 < self.open_timeout_s < math.inf or self.baud <= 0 or self.bitrate <= 0:
            raise ConfigError("open_timeout_s, baud and bitrate must be positive and finite.")
        for name in ("latch_s", "telemetry_lost_s"):
            if not math.isfinite(getattr(self, name)):
                raise ConfigError(f"{name} in [hardware.actuator] is {getattr(self, name)}; give a finite number.")
        self._check_lines()

    def _check_lines(self) -> None:
        """Raise ConfigError if a line is too slow for the rates: old commands would wait in its buffers."""
        name = self.device_kind.name
        if not self.device_kind.is_bus:
            self._check_line(
                f"baud in [hardware.actuator] is {self.baud}",
                self.baud,
                max(self._per_s(lambda size: size)) * BITS_PER_BYTE,
                f"Set a higher baud, also in the {name}, or lower the rates; on USB remove baud, which has no effect "
                "there.",
            )
            return
        self._check_line(
            f"bitrate in [hardware.actuator] is {self.bitrate}",
            self.bitrate,
            sum(self._per_s(can_frame_bits)),
            f"Set a higher bitrate, also in the {name}, or lower the rates.",
        )
        if self.interface == "slcan":
            baud = slcan_port(self.channel)[1]
            self._check_line(
                f"The baud of the slcan adapter in [hardware.actuator] is {baud}",
                baud,
                max(self._per_s(slcan_line_bytes)) * BITS_PER_BYTE,
                "Set a higher one, also in the adapter, by channel = PORT@BAUD, or lower the rates; on USB it has no "
                "effect, so set any higher one.",
            )

    def _per_s(self, size: Callable[[int], int]) -> tuple[float, float]:
        """Sums of the sizes of the messages that are sent and that are received in a second."""
        kind = self.device_kind
        command, request, reply = (
            sum(map(size, messages)) for messages in (kind.command_bytes, kind.request_bytes, kind.reply_bytes)
        )
        return self.rate_hz * command + self.telemetry_rate_hz * request, self.telemetry_rate_hz * reply

    def _check_line(self, what: str, bits_per_s: int, needed_bits_per_s: float, remedy: str) -> None:
        if bits_per_s < needed_bits_per_s:
            raise ConfigError(
                f"{what}; rate_hz {self.rate_hz:g} and telemetry_rate_hz {self.telemetry_rate_hz:g} need at least "
                f"{math.ceil(needed_bits_per_s)}. {remedy}"
            )

    def check_deadlines(self) -> None:
        """Raise ConfigError for a deadline that is too long for the car of a car file.

        Construction allows longer ones, for a program that drives emulated hardware on a busy computer.
        """
        for name in ("watchdog_s", "latch_s", "telemetry_stale_s", "telemetry_lost_s"):
            check_bound(name, "[hardware.actuator]", getattr(self, name), SAFETY_BOUNDS.deadline)

    @property
    def device_kind(self) -> DeviceKind:
        """The protocol and link that ``kind`` names."""
        return DEVICE_KINDS[self.kind]

    @property
    def address(self) -> str:
        """Address of the actuator for messages."""
        if not self.device_kind.is_bus:
            return self.port
        return f"controller {self.controller_id} on {self.interface} {self.channel}"


@dataclass(frozen=True, slots=True)
class HardwareConfig:
    """The drivers' part of ``[hardware]``, with the conditions for arming.

    Arming needs a speed of at most ``arm_max_speed_mps``, a motor speed of at most ``arm_max_erpm`` and a pose that is
    at most ``arm_max_pose_age_s`` old. Raises ConfigError for a condition that is not finite, negative or too large.
    """

    actuator: ActuatorConfig = field(default_factory=ActuatorConfig)
    calibration: ActuatorCalibration = field(default_factory=ActuatorCalibration)
    arm_max_speed_mps: float = 0.1
    arm_max_pose_age_s: float = 0.1
    arm_max_erpm: float = 200.0

    def __post_init__(self) -> None:
        for name, bound in (
            ("arm_max_speed_mps", SAFETY_BOUNDS.rest_speed),
            ("arm_max_pose_age_s", SAFETY_BOUNDS.deadline),
            ("arm_max_erpm", SAFETY_BOUNDS.rest_motor_speed),
        ):
            check_bound(name, "[hardware]", getattr(self, name), bound)
