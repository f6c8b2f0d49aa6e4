"""A VESC on a CAN bus."""

from __future__ import annotations

from carlab.core.errors import ActuatorFaultError
from drivers.calibration import DeviceCommand, MotorKind
from drivers.config import ActuatorConfig
from drivers.device import DeviceCounters, Reply
from drivers.links.can_link import CanLink
from drivers.links.link import CanFrame, FrameLink
from drivers.links.slcan_link import SlcanLink
from drivers.vesc import can_codec as vesc_can_codec
from drivers.vesc import payloads as vesc_payloads
from drivers.vesc.can_codec import CanReassembler, ReplyMode
from drivers.vesc.payloads import FirmwareVersion, MotorValues
from drivers.vesc.reply_reader import ReplyReader


class VescCanDevice:
    """A VESC on a CAN bus: simple commands, short buffers, status broadcasts and polled telemetry.

    A motor command of another sender on the bus raises ActuatorFaultError. ``has_echo``: the link also receives the
    frames that it sends, so other senders cannot be detected.
    """

    def __init__(self, link: FrameLink, controller_id: int, host_id: int, *, has_echo: bool = False) -> None:
        self.link = link
        self.controller_id = controller_id
        self.host_id = host_id
        self.has_echo = has_echo
        self._reassembler = CanReassembler(host_id)
        self._replies = ReplyReader()

    @property
    def counters(self) -> DeviceCounters:
        """Counts since construction."""
        return DeviceCounters(self._reassembler.errors, self._replies.garbage_bytes, self.link.opens)

    def open(self) -> None:
        """Open the bus."""
        self._reassembler = CanReassembler(self.host_id, self._reassembler.errors)
        self.link.open()

    def send(self, command: DeviceCommand) -> None:
        """A motor frame and a servo frame."""
        encode = {
            MotorKind.CURRENT: vesc_can_codec.set_current,
            MotorKind.BRAKE: vesc_can_codec.set_current_brake,
            MotorKind.DUTY: vesc_can_codec.set_duty,
        }[command.motor_kind]
        self.link.write(encode(self.controller_id, command.motor_value))
        self.link.write(vesc_can_codec.set_servo_position(self.controller_id, self.host_id, command.servo_position))

    def request_firmware(self) -> None:
        """FW_VERSION in a short buffer."""
        self._ask(vesc_payloads.get_firmware_version())

    def request_telemetry(self) -> None:
        """GET_VALUES_SELECTIVE (5 bytes) or GET_VALUES in a short buffer: broadcasts carry no fault code."""
        self._ask(vesc_payloads.telemetry_request(self._replies.version))

    def receive(self, now_s: float) -> list[Reply]:
        """Decode status broadcasts and transported replies; ``now_s`` is unused since CAN frames are complete."""
        return self._replies.read(self.link.read(), self._decode, lambda frame: frame.data)

    def fileno(self) -> int | None:
        """The bus's descriptor."""
        return self.link.fileno()

    def close(self) -> None:
        """Close the bus."""
        self.link.close()

    def _ask(self, payload: bytes) -> None:
        for frame in vesc_can_codec.encode_payload(
            self.controller_id, self.host_id, payload, ReplyMode.REPLY_TO_SENDER
        ):
            self.link.write(frame)

    def _decode(self, frame: CanFrame) -> FirmwareVersion | MotorValues | None:
        if not self.has_echo and self._commands_the_motor(frame):
            raise ActuatorFaultError(
                f"another sender on the CAN bus commands controller {self.controller_id}; end that program, or switch "
                "off 'Multiple VESCs over CAN' in the other motor controller, then reset the fault."
            )
        is_ours = vesc_can_codec.controller_of(frame) == self.controller_id
        if is_ours and (values := vesc_can_codec.decode_status(frame)) is not None:
            return values
        packet = self._reassembler.feed(frame)
        if packet is None or packet.send != ReplyMode.IS_REPLY or packet.sender_id != self.controller_id:
            return None
        return vesc_payloads.decode_reply(packet.payload)

    def _commands_the_motor(self, frame: CanFrame) -> bool:
        is_addressed = vesc_can_codec.controller_of(frame) in (self.controller_id, vesc_can_codec.BROADCAST_ID)
        return is_addressed and vesc_can_codec.packet_of(frame) in vesc_can_codec.MOTOR_PACKETS


def make_device(config: ActuatorConfig) -> VescCanDevice:
    """Create the VESC of a configuration without opening its bus."""
    link: FrameLink
    if config.interface == "slcan":
        link = SlcanLink(config.channel, config.bitrate)
    else:
        link = CanLink(config.interface, config.channel, config.bitrate, config.controller_id, config.host_id)
    has_echo = config.interface == "udp_multicast"
    return VescCanDevice(link, config.controller_id, config.host_id, has_echo=has_echo)
