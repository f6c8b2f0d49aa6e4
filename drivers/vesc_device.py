"""A VESC behind a link: commands out, telemetry in. The sender knows nothing of serial or CAN."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from carlab.core.errors import ProtocolError
from drivers import vesc_payloads
from drivers.calibration import DeviceCommand, MotorKind
from drivers.config import ActuatorConfig
from drivers.link import ByteLink
from drivers.serial_link import SerialLink
from drivers.vesc_payloads import FirmwareVersion, MotorValues
from drivers.vesc_serial_codec import VescFrameDecoder, encode_frame

Reply = FirmwareVersion | MotorValues


@dataclass(slots=True)
class DeviceCounters:
    """What went wrong on the way in; a reply of an unknown layout counts as garbage, byte by byte."""

    crc_errors: int = 0
    garbage_bytes: int = 0
    partial_timeouts: int = 0
    link_opens: int = 0


class VescDevice(Protocol):
    """Constructing does nothing. After ``open`` each failure of the link is an ActuatorFaultError."""

    @property
    def counters(self) -> DeviceCounters:
        """What went wrong so far."""

    def open(self) -> None:
        """Open the link; raises NotReadyError."""

    def send(self, command: DeviceCommand) -> None:
        """Write motor and servo commands."""

    def request_firmware(self) -> None:
        """Ask for the firmware version."""

    def request_telemetry(self, *, selective: bool) -> None:
        """Ask for the fields that control needs (``selective``: firmware 3.48 and later), or for all."""

    def receive(self, now_s: float) -> list[Reply]:
        """Replies that have arrived, oldest first; never blocks."""

    def fileno(self) -> int | None:
        """A descriptor to wait on, or None."""

    def close(self) -> None:
        """Close the link. Idempotent."""


def _motor_payload(command: DeviceCommand) -> bytes:
    encode = {
        MotorKind.CURRENT: vesc_payloads.set_current,
        MotorKind.BRAKE: vesc_payloads.set_current_brake,
        MotorKind.DUTY: vesc_payloads.set_duty,
    }[command.motor_kind]
    return encode(command.motor_value)


class VescSerialDevice:
    """A VESC on a serial line or USB."""

    def __init__(self, link: ByteLink) -> None:
        self.link = link
        self._decoder = VescFrameDecoder()
        self._counters = DeviceCounters()

    @property
    def counters(self) -> DeviceCounters:
        """Counts since construction."""
        decoder = self._decoder
        return DeviceCounters(
            decoder.crc_errors,
            decoder.garbage_bytes + self._counters.garbage_bytes,
            decoder.timeouts,
            self.link.statistics.opens,
        )

    def open(self) -> None:
        """Open the port and forget what an earlier connection left half said."""
        self._decoder.clear()
        self.link.open()

    def send(self, command: DeviceCommand) -> None:
        """Motor and servo frame in one write."""
        servo = vesc_payloads.set_servo_position(command.servo_position)
        self.link.write(encode_frame(_motor_payload(command)) + encode_frame(servo))

    def request_firmware(self) -> None:
        """FW_VERSION."""
        self.link.write(encode_frame(vesc_payloads.get_firmware_version()))

    def request_telemetry(self, *, selective: bool) -> None:
        """GET_VALUES_SELECTIVE (22 bytes back) or GET_VALUES."""
        payload = vesc_payloads.get_values_selective() if selective else vesc_payloads.get_values()
        self.link.write(encode_frame(payload))

    def receive(self, now_s: float) -> list[Reply]:
        """Decode what has arrived."""
        replies: list[Reply] = []
        for payload in self._decoder.feed(self.link.read(), now_s):
            try:
                reply = vesc_payloads.decode_reply(payload)
            except ProtocolError:
                self._counters.garbage_bytes += len(payload)
                continue
            if reply is not None:
                replies.append(reply)
        return replies

    def fileno(self) -> int | None:
        """The port's descriptor."""
        return self.link.fileno()

    def close(self) -> None:
        """Close the port."""
        self.link.close()


def make_device(config: ActuatorConfig) -> VescDevice:
    """The device that a configuration names; nothing is opened."""
    if config.kind == "vesc_serial":
        return VescSerialDevice(SerialLink(config.port, config.baud))
    from drivers.can_link import CanLink  # python-can and cantools load only where they are needed
    from drivers.vesc_can_device import VescCanDevice

    link = CanLink(config.interface, config.channel, config.bitrate)
    return VescCanDevice(link, config.controller_id, config.host_id)
