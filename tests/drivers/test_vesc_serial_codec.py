"""Serial framing and payloads against bytes made by other implementations (shared actuator-vectors.json)."""

from __future__ import annotations

import math
import re
import struct
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from carlab.core.errors import ProtocolError
from drivers.vesc import payloads as payloads
from drivers.vesc.serial_codec import VescFrameDecoder, crc16, encode_frame

FIELD_NAMES = {
    "temp_fet": "temp_fet_c", "temp_motor": "temp_motor_c", "i_motor": "motor_current_a", "i_in": "input_current_a",
    "i_d": "id_a", "i_q": "iq_a", "duty": "duty", "erpm": "erpm", "v_in": "input_v", "ah": "used_ah",
    "ah_chg": "charged_ah", "wh": "used_wh", "wh_chg": "charged_wh", "tach": "tachometer_steps",
    "tach_abs": "tachometer_abs_steps", "fault": "fault_code", "pid_pos": "pid_position_deg",
    "ctrl_id": "controller_id", "mos1": "temp_mos1_c", "mos2": "temp_mos2_c", "mos3": "temp_mos3_c", "vd": "vd_v",
    "vq": "vq_v", "status": "status_bits",
}  # fmt: skip


def of_kind(vectors: list[dict[str, Any]], *kinds: str) -> list[dict[str, Any]]:
    selected = [v for v in vectors if v["protocol"] == "vesc-serial" and v["kind"] in kinds]
    assert selected
    return selected


def one_payload(data: bytes) -> bytes:
    (payload,) = VescFrameDecoder().feed(data, 0.0)
    return payload


def test_crc_is_xmodem() -> None:
    assert crc16(b"123456789") == 0x31C3


def test_encoded_frames_equal_the_vectors(vesc_vectors: list[dict[str, Any]]) -> None:
    encoders = {
        "SET_DUTY": payloads.set_duty,
        "SET_CURRENT": payloads.set_current,
        "SET_CURRENT_BRAKE": payloads.set_current_brake,
        "SET_SERVO_POS": payloads.set_servo_position,
    }
    tested = 0
    for vector in of_kind(vesc_vectors, "encode"):
        meaning = vector["meaning"]
        if "GET_VALUES_SELECTIVE" in meaning:
            payload = payloads.get_values_selective(0x0020A180)
        elif "GET_VALUES" in meaning:
            payload = payloads.get_values()
        elif "FW_VERSION" in meaning:
            payload = payloads.get_firmware_version()
        elif match := re.match(r"COMM_(SET_\w+) (?:duty=)?([-+0-9.]+)", meaning):
            payload = encoders[match[1]](float(match[2]))
        else:
            assert any(name in meaning for name in ("FORWARD_CAN", "GET_IMU_DATA", "MOTOR_ESTOP"))  # not used here
            payload = one_payload(bytes.fromhex(vector["hex"]))
        assert encode_frame(payload).hex() == vector["hex"], meaning
        tested += 1
    assert tested >= 15


def test_raw_and_long_frames_equal_the_vectors(vesc_vectors: list[dict[str, Any]]) -> None:
    for vector in of_kind(vesc_vectors, "raw", "long"):
        data = bytes.fromhex(vector["hex"])
        assert encode_frame(one_payload(data)) == data
    long = bytes((i * 7 + 3) & 255 for i in range(256))
    assert encode_frame(long).hex() == of_kind(vesc_vectors, "long")[0]["hex"]


def test_get_values_replies_of_all_firmware_versions_are_decoded(vesc_vectors: list[dict[str, Any]]) -> None:
    lengths = set()
    for vector in of_kind(vesc_vectors, "get_values"):
        payload = one_payload(bytes.fromhex(vector["hex"]))
        if "2.18" in vector["meaning"]:
            with pytest.raises(ProtocolError, match=r"3\.00 or older"):
                payloads.decode_reply(payload)
            continue
        decoded = payloads.decode_get_values(payload)
        expected = {FIELD_NAMES[name]: value for name, value in vector["values"].items()}
        for name, value in expected.items():
            assert getattr(decoded, name) == pytest.approx(value), name
        absent = set(FIELD_NAMES.values()) - set(expected)
        assert all(getattr(decoded, name) is None for name in absent)
        lengths.add(len(payload))
        longer = payloads.decode_get_values(payload + b"\x55" * 4) if len(payload) == 74 else decoded
        assert longer == decoded, "fields of a newer firmware are ignored"
    assert lengths == {54, 58, 59, 65, 73, 74}


def test_selective_reply_is_decoded(vesc_vectors: list[dict[str, Any]]) -> None:
    (vector,) = of_kind(vesc_vectors, "get_values_selective")
    values = payloads.decode_reply(one_payload(bytes.fromhex(vector["hex"])))
    assert values == payloads.MotorValues(
        erpm=-12345.0, input_v=14.8, tachometer_steps=-77.0, fault_code=7, status_bits=1
    )
    assert values.motor_timeout_active
    assert not values.kill_switch_active


def test_firmware_version_replies_are_decoded(vesc_vectors: list[dict[str, Any]]) -> None:
    full, short = of_kind(vesc_vectors, "fw_version")
    version = payloads.decode_reply(one_payload(bytes.fromhex(full["hex"])))
    assert isinstance(version, payloads.FirmwareVersion)
    assert (version.text, version.hardware, version.uuid) == ("6.05", "60_MK6", bytes(range(1, 13)))
    assert payloads.decode_reply(one_payload(bytes.fromhex(short["hex"]))) == payloads.FirmwareVersion(6, 3)


@pytest.mark.parametrize(("major", "minor", "is_refused"), [(3, 6, True), (2, 18, True), (3, 7, False), (6, 0, False)])
def test_old_firmware_is_refused_with_the_remedy(major: int, minor: int, is_refused: bool) -> None:
    refusal = payloads.FirmwareVersion(major, minor).refusal()
    assert (refusal is not None) == is_refused
    assert refusal is None or "update it with VESC Tool" in refusal


def test_decoder_resynchronises_like_the_firmware(vesc_vectors: list[dict[str, Any]]) -> None:
    for vector in of_kind(vesc_vectors, "resync"):
        for chunk in (1, 1000):
            decoder = VescFrameDecoder(frame_timeout_s=None)
            data = bytes.fromhex(vector["hex"])
            decoded_payloads = [p for i in range(0, len(data), chunk) for p in decoder.feed(data[i : i + chunk], 0.0)]
            assert [p.hex() for p in decoded_payloads] == vector["payloads_fw"], vector["meaning"]


@pytest.mark.parametrize("hidden", ["02ff020100000003", "030100020104408403"])
def test_timeout_decodes_frames_behind_a_false_header(hidden: str) -> None:
    decoder = VescFrameDecoder(frame_timeout_s=0.03)
    assert decoder.feed(bytes.fromhex(hidden), 1.0) == []
    assert decoder.feed(b"", 1.02) == []
    (payload,) = decoder.feed(b"", 1.04)
    assert payload in (b"\x00", b"\x04")
    assert decoder.garbage_bytes == len(hidden) // 2 - len(encode_frame(payload))


@pytest.mark.parametrize("noise", ["02ff", "030100", "030200"])
def test_false_header_hides_telemetry_only_until_the_timeout(noise: str) -> None:
    """Replies at 50 Hz continue to arrive, 236 to 495 bytes until the false length is reached."""
    decoder = VescFrameDecoder(frame_timeout_s=0.1)
    reply = bytes(17)
    received = decoder.feed(bytes.fromhex(noise), 0.0)
    for k in range(1, 7):
        received += decoder.feed(encode_frame(reply), 0.02 * k)
    assert received == [reply] * 6
    assert decoder.garbage_bytes == len(noise) // 2


def test_frame_after_an_incomplete_frame_is_decoded() -> None:
    frame = encode_frame(payloads.get_values())
    decoder = VescFrameDecoder(frame_timeout_s=0.03)
    assert decoder.feed(frame[:3], 0.0) == []
    assert decoder.feed(frame, 0.1) == [payloads.get_values()]
    assert decoder.garbage_bytes == 3


def test_frame_after_ten_kilobytes_of_garbage_is_decoded() -> None:
    garbage = bytes((i * 73 + i // 7) & 255 for i in range(10_000))
    decoder = VescFrameDecoder()
    frame = encode_frame(payloads.get_firmware_version())
    decoded_payloads = decoder.feed(garbage, 0.0) + decoder.feed(b"", 1.0) + decoder.feed(frame, 1.0)
    assert decoded_payloads[-1] == payloads.get_firmware_version()
    assert decoder.garbage_bytes == len(garbage) - sum(len(encode_frame(p)) for p in decoded_payloads[:-1])


@given(st.lists(st.binary(min_size=1, max_size=300), max_size=4), st.data())
@settings(max_examples=60, deadline=None)
def test_frames_are_decoded_with_any_split_of_the_stream(messages: list[bytes], data: st.DataObject) -> None:
    stream = b"".join(encode_frame(m) for m in messages)
    decoder = VescFrameDecoder()
    decoded_payloads: list[bytes] = []
    while stream:
        size = data.draw(st.integers(1, len(stream)))
        decoded_payloads += decoder.feed(stream[:size], 0.0)
        stream = stream[size:]
    assert decoded_payloads == messages


@given(st.binary(max_size=80), st.binary(min_size=1, max_size=40))
@settings(max_examples=100, deadline=None)
def test_frame_after_garbage_is_decoded_at_the_latest_after_the_timeout(garbage: bytes, message: bytes) -> None:
    decoder = VescFrameDecoder()
    decoded_payloads = decoder.feed(garbage + encode_frame(message), 0.0) + decoder.feed(b"", 1.0)
    assert message in decoded_payloads


@given(st.floats(allow_nan=True, allow_infinity=True))
@settings(max_examples=200, deadline=None)
def test_numbers_are_sent_exactly_or_refused(value: float) -> None:
    for encode, scale, low, high in (
        (payloads.set_current, 1e3, -2147483.648, 2147483.647),
        (payloads.set_duty, 1e5, -1.0, 1.0),
    ):
        if math.isfinite(value) and low <= value <= high:
            assert abs(struct.unpack(">i", encode(value)[1:])[0] / scale - value) <= 0.5000001 / scale
        elif not math.isfinite(value) or not low - 1.0 / scale < value < high + 1.0 / scale:
            with pytest.raises(ProtocolError):
                encode(value)


def test_wrong_layouts_are_refused() -> None:
    with pytest.raises(ProtocolError, match="too short"):
        payloads.decode_reply(b"\x04" + bytes(20))
    with pytest.raises(ProtocolError, match="ends inside"):
        payloads.decode_reply(b"\x04" + bytes(54))
    with pytest.raises(ProtocolError, match="ends inside"):
        payloads.decode_reply(bytes.fromhex("320020a180ffff"))
    with pytest.raises(ProtocolError):
        payloads.decode_reply(b"\x00\x06")
    assert payloads.decode_reply(b"\x15hello") is None


def test_encoded_telemetry_equals_the_vectors(vesc_vectors: list[dict[str, Any]]) -> None:
    newest = next(v for v in of_kind(vesc_vectors, "get_values") if "6.00" in v["meaning"])
    payload = one_payload(bytes.fromhex(newest["hex"]))
    assert payloads.encode_values(payloads.decode_get_values(payload), payloads.FULL_MASK) == payload[1:]
