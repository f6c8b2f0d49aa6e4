"""CAN frames against independent vectors, the shared DBC and the worked example of the firmware's documentation."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import cantools
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from carlab.core.errors import ProtocolError
from drivers.links.link import CanFrame
from drivers.vesc import can_codec as codec
from drivers.vesc import payloads as payloads
from drivers.vesc.can_codec import CanReassembler, Packet, ReplyMode

SHARED_DBC = Path(__file__).resolve().parents[2].parent / "shared" / "reference" / "vesc.dbc"


def test_encoded_commands_equal_the_vectors(vesc_vectors: list[dict[str, Any]]) -> None:
    tested = 0
    for vector in (v for v in vesc_vectors if v["protocol"] == "vesc-can" and v["kind"] == "tx"):
        meaning, expected = vector["meaning"], bytes.fromhex(vector["hex"])
        if match := re.search(r": brake (-?\d+)", meaning):
            frame = codec.set_current_brake(23, float(match[1]))
        elif "SET_CURRENT 51 A" in meaning:
            frame = codec.set_current(23, 51.0)
        elif "get_values" in meaning or "fw" in meaning:
            payload = payloads.get_values() if "get_values" in meaning else payloads.get_firmware_version()
            (frame,) = codec.encode_payload(23, 42, payload, ReplyMode.REPLY_TO_SENDER)
            expected = expected[:3]  # that implementation appends a CRC that the firmware does not use
        else:
            assert any(name in meaning for name in ("handbrake", "rpm", "ping"))  # not used here
            continue
        assert (frame.identifier, frame.data) == (vector["can_id"], expected), meaning
        tested += 1
    assert tested == 4


def test_servo_frame_equals_the_documented_example() -> None:
    frame = codec.set_servo_position(23, 0x2A, 0.5)
    assert frame == CanFrame(0x0817, bytes.fromhex("2A020C01F4"))


def test_status_frames_equal_the_vectors(vesc_vectors: list[dict[str, Any]]) -> None:
    expected = {
        0x917: {"erpm": -12345, "motor_current_a": -1.0, "duty": 0.321},
        0x1017: {"temp_fet_c": 32.5, "temp_motor_c": -1.5, "input_current_a": 1.3, "pid_position_deg": 100.0},
        0x1B17: {"tachometer_steps": -77, "input_v": 14.8},
    }
    for vector in (v for v in vesc_vectors if v["kind"] == "status"):
        frame = CanFrame(vector["can_id"], bytes.fromhex(vector["hex"]))
        values = codec.decode_status(frame)
        assert values is not None
        for name, value in expected.pop(vector["can_id"]).items():
            assert getattr(values, name) == pytest.approx(value), name
        assert codec.encode_status(Packet(codec.packet_of(frame)), 23, values) == frame
    assert not expected


@pytest.mark.skipif(not SHARED_DBC.exists(), reason="the shared DBC is missing")
@pytest.mark.parametrize("controller_id", [0, 23, 254])
def test_database_agrees_with_the_shared_dbc_for_any_controller(controller_id: int) -> None:
    shared_dbc = cantools.database.load_file(SHARED_DBC)
    database = codec.database()
    assert isinstance(shared_dbc, cantools.database.Database)
    for shared_message in shared_dbc.messages:
        own_message = database.get_message_by_frame_id(
            (shared_message.frame_id & ~0xFF) | controller_id, force_extended_id=True
        )
        assert own_message.name == shared_message.name
        layout = [(s.start, s.length, s.is_signed, s.byte_order, s.scale, s.offset) for s in shared_message.signals]
        assert [
            (s.start, s.length, s.is_signed, s.byte_order, s.scale, s.offset) for s in own_message.signals
        ] == layout


@pytest.mark.parametrize("encode", [codec.set_current, codec.set_duty, codec.set_current_brake])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e30])
def test_nan_and_infinity_are_refused(encode: Any, value: float) -> None:
    with pytest.raises(ProtocolError):
        encode(23, value)


def test_all_simple_commands_have_four_bytes() -> None:
    for frame in (
        codec.set_current(1, 1.0),
        codec.set_duty(1, 0.1),
        codec.set_current_brake(1, 2),
    ):
        assert len(frame.data) == 4


@given(st.binary(min_size=1, max_size=512))
@settings(max_examples=60, deadline=None)
def test_transport_round_trip_of_any_payload(payload: bytes) -> None:
    frames = codec.encode_payload(23, 42, payload, ReplyMode.IS_REPLY)
    assert all(len(f.data) <= 8 and codec.controller_of(f) == 23 for f in frames)
    assert len(frames) == 1 if len(payload) <= 6 else codec.packet_of(frames[-1]) == Packet.PROCESS_RX_BUFFER
    receiver = CanReassembler(23)
    packets = [p for f in frames if (p := receiver.feed(f)) is not None]
    assert [(p.sender_id, p.send, p.payload) for p in packets] == [(42, ReplyMode.IS_REPLY, payload)]


def test_reply_in_captured_form_is_reassembled() -> None:
    """A 17-byte selective reply in frames of seven bytes, then length and CRC (0xB9EB, from the serial vector)."""
    receiver = CanReassembler(42)
    frames = [CanFrame(0x052A, bytes.fromhex(p)) for p in ("00320020a180ffff", "07cfc70094ffffff", "0eb30701")]
    assert all(receiver.feed(f) is None for f in frames)
    packet = receiver.feed(CanFrame(0x072A, bytes.fromhex("17010011b9eb")))
    assert packet is not None
    assert payloads.decode_reply(packet.payload) == payloads.MotorValues(
        erpm=-12345.0, input_v=14.8, tachometer_steps=-77.0, fault_code=7, status_bits=1
    )


@pytest.mark.parametrize("lost", [0, 1, 2])
def test_lost_frame_drops_only_its_packet(lost: int) -> None:
    receiver = CanReassembler(42)
    frames = codec.encode_payload(42, 23, bytes(range(20)), ReplyMode.IS_REPLY)
    kept = [f for i, f in enumerate(frames) if i != lost]
    assert [receiver.feed(f) for f in kept] == [None] * len(kept)
    assert receiver.errors == 1
    assert [p.payload for f in frames if (p := receiver.feed(f))] == [bytes(range(20))]


def test_frames_with_a_wrong_crc_or_length_are_dropped() -> None:
    receiver = CanReassembler(42)
    frames = codec.encode_payload(42, 23, bytes(range(20)), ReplyMode.IS_REPLY)
    end = frames[-1]
    broken = CanFrame(end.identifier, end.data[:-1] + bytes((end.data[-1] ^ 1,)))
    assert [receiver.feed(f) for f in (*frames[:-1], broken)] == [None] * len(frames)
    assert receiver.feed(CanFrame(0x072A, b"\x17")) is None
    assert receiver.feed(CanFrame(0x082A, b"\x17\x01")) is None
    assert receiver.errors == 3
    with pytest.raises(ProtocolError, match="bytes, not"):
        codec.decode_status(CanFrame(0x0917, b"\x00\x01"))


def test_frames_for_other_receivers_are_ignored() -> None:
    receiver = CanReassembler(42)
    assert [receiver.feed(f) for f in codec.encode_payload(43, 23, b"abc", ReplyMode.IS_REPLY)] == [None]
    assert codec.decode_status(CanFrame(0x0117, bytes(4))) is None
