"""A VESC on a serial line or USB."""

from __future__ import annotations

from drivers.calibration import DeviceCommand, MotorKind
from drivers.config import ActuatorConfig
from drivers.device import DeviceCounters, Reply
from drivers.links.link import ByteLink
from drivers.links.serial_link import SerialLink
from drivers.vesc import payloads as vesc_payloads
from drivers.vesc.reply_reader import ReplyReader
from drivers.vesc.serial_codec import VescFrameDecoder, encode_frame


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
        self._replies = ReplyReader()

    @property
    def counters(self) -> DeviceCounters:
        """Counts since construction."""
        decoder = self._decoder
        return DeviceCounters(
            decoder.crc_errors,
            decoder.garbage_bytes + self._replies.garbage_bytes,
            self.link.opens,
        )

    def open(self) -> None:
        """Open the port and drop an unfinished frame of an earlier connection."""
        self._decoder.clear()
        self.link.open()

    def send(self, command: DeviceCommand) -> None:
        """Write motor and servo frame in one write."""
        servo = vesc_payloads.set_servo_position(command.servo_position)
        self.link.write(encode_frame(_motor_payload(command)) + encode_frame(servo))

    def request_firmware(self) -> None:
        """FW_VERSION."""
        self.link.write(encode_frame(vesc_payloads.get_firmware_version()))

    def request_telemetry(self) -> None:
        """GET_VALUES_SELECTIVE (22 bytes back) or GET_VALUES."""
        self.link.write(encode_frame(vesc_payloads.telemetry_request(self._replies.version)))

    def receive(self, now_s: float) -> list[Reply]:
        """Decode what has arrived."""
        payloads = self._decoder.feed(self.link.read(), now_s)
        return self._replies.read(payloads, vesc_payloads.decode_reply, lambda payload: payload)

    def fileno(self) -> int | None:
        """The port's descriptor."""
        return self.link.fileno()

    def close(self) -> None:
        """Close the port."""
        self.link.close()


def make_device(config: ActuatorConfig) -> VescSerialDevice:
    """Create the VESC of a configuration without opening its port."""
    return VescSerialDevice(SerialLink(config.port, config.baud))
