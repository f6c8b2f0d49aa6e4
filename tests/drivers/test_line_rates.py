"""Serial lines and CAN buses that are too slow for the configured rates are refused."""

from __future__ import annotations

from typing import Any

import pytest
from recording_link import RecordingLink

from carlab.core.errors import ConfigError
from drivers.calibration import ActuatorCalibration
from drivers.config import ActuatorConfig
from drivers.device_kinds import DEVICE_KINDS
from drivers.emulators.vesc_firmware import EMULATED_VERSION, VALUES_AT_REST
from drivers.links.lines import can_frame_bits, slcan_line_bytes
from drivers.links.link import CanFrame
from drivers.links.slcan_link import SlcanLink
from drivers.vesc.can_codec import ReplyMode, encode_payload
from drivers.vesc.can_device import VescCanDevice
from drivers.vesc.payloads import CONTROL_MASK, encode_values, get_values_selective
from drivers.vesc.serial_codec import encode_frame
from drivers.vesc.serial_device import VescSerialDevice

REPLY = get_values_selective() + encode_values(VALUES_AT_REST, CONTROL_MASK)


def test_sizes_of_serial_messages_are_those_on_the_line() -> None:
    link, kind = RecordingLink(), DEVICE_KINDS["vesc_serial"]
    device = VescSerialDevice(link)
    device._replies.version = EMULATED_VERSION
    device.send(ActuatorCalibration().neutral)
    device.request_telemetry()
    assert list(map(len, link.written)) == [sum(kind.command_bytes), sum(kind.request_bytes)]
    assert len(encode_frame(REPLY)) == sum(kind.reply_bytes)


def test_sizes_of_can_frames_are_those_on_the_bus() -> None:
    link, kind = RecordingLink(), DEVICE_KINDS["vesc_can"]
    device = VescCanDevice(link, 23, 42)
    device._replies.version = EMULATED_VERSION
    device.send(ActuatorCalibration().neutral)
    device.request_telemetry()
    assert [len(frame.data) for frame in link.written] == [*kind.command_bytes, *kind.request_bytes]
    assert [len(f.data) for f in encode_payload(42, 23, REPLY, ReplyMode.IS_REPLY)] == list(kind.reply_bytes)


def test_size_of_an_slcan_line_is_that_on_the_line() -> None:
    link, serial = SlcanLink("/dev/none"), RecordingLink()
    link._serial = serial  # type: ignore[assignment]
    link.write(CanFrame(0x117, bytes(5)))
    assert len(serial.written[0]) == slcan_line_bytes(5)


def test_size_of_a_can_frame_is_that_of_the_standard() -> None:
    """Without stuff bits a frame has 67 bits and its data; every fifth of the first 54 and the data may be stuffed."""
    for size in range(9):
        assert can_frame_bits(size) == 67 + 8 * size + (54 + 8 * size - 1) // 4


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"bitrate": 50_000}, "bitrate .* is 50000; rate_hz 100 and telemetry_rate_hz 50 need at least 61500. Set a"),
        ({"bitrate": 125_000, "rate_hz": 500.0}, "need at least 161500"),
        ({"channel": "/dev/ttyUSB0@38400"}, "slcan adapter .* is 38400; .* at least 52500. Set a .* PORT@BAUD, or low"),
        ({"channel": "/dev/ttyUSB0", "rate_hz": 400.0}, "slcan adapter .* is 115200; .* at least 172500"),
        ({"channel": "/dev/ttyUSB0@fast"}, "channel .* is '/dev/ttyUSB0@fast'; an slcan adapter has its port, PORT or"),
        ({"channel": "/dev/ttyUSB0@"}, "an slcan adapter has its port"),
        ({"channel": "/dev/ttyUSB0@0"}, "an slcan adapter has its port"),
        ({"channel": "@115200"}, "an slcan adapter has its port"),
    ],
)
def test_line_that_is_too_slow_is_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        ActuatorConfig(kind="vesc_can", interface="slcan", **settings)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("settings", [{"bitrate": 100_000}, {"channel": "/dev/ttyUSB0@1000000", "rate_hz": 400.0}])
def test_line_that_is_fast_enough_is_accepted(settings: dict[str, Any]) -> None:
    ActuatorConfig(kind="vesc_can", interface="slcan", **settings)
