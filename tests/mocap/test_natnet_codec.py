"""The codec against an independent decoder, hand-made bytes and random bytes."""

from __future__ import annotations

import struct

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from natnet.data_descriptions import DataDescriptions
from natnet.data_frame import DataFrame
from natnet.packet_buffer import PacketBuffer
from natnet.version import Version
from natnet_datagrams import decode_datagram

from carlab.core.errors import ProtocolError
from mocap.natnet.descriptions import decode_model_def, encode_model_def
from mocap.natnet.frames import decode_frame, encode_frame, explain_frame_error
from mocap.natnet.messages import decode_connect, decode_server_info, encode_connect, encode_message, split_message
from mocap.natnet.models import (
    SERVED_BITSTREAMS,
    AnalogSource,
    Asset,
    AssetDescription,
    AssetMarkerDescription,
    BitstreamVersion,
    CameraDescription,
    Description,
    DeviceDescription,
    ForcePlateDescription,
    Frame,
    LabelledMarker,
    MarkerSet,
    MarkerSetDescription,
    RigidBody,
    RigidBodyDescription,
    Skeleton,
    SkeletonDescription,
    UnknownDescription,
)
from mocap.speed import natnet_decode_speed

V30, V40, V41 = BitstreamVersion(3, 0), BitstreamVersion(4, 0), BitstreamVersion(4, 1)
MESSAGE_IDS = (0, 1, 2, 3, 4, 5, 7, 8, 9, 10, 11, 12, 13, 14, 100)


def body(number: int) -> RigidBody:
    return RigidBody(number, 1.5, -2.25, 0.125, 0.5, -0.5, 0.5, 0.5, 0.0625, 1)


def marker(number: int) -> LabelledMarker:
    return LabelledMarker(number, 0.25, 0.5, -0.75, 0.015625, 10, 0.0009765625)


def full_frame(version: BitstreamVersion) -> Frame:
    """A frame with entries in every section; all numbers are exact in float32."""
    return Frame(
        4711,
        (MarkerSet("car", ((1.0, 2.0, 3.0), (4.0, 5.0, 6.0))), MarkerSet("Räder", ())),
        ((0.5, 0.25, 0.125),),
        (body(1), body(2)),
        (Skeleton(3, (body(3 << 16 | 1), body(3 << 16 | 2))),),
        (Asset(9, (body(1),), (marker(1), marker(2))),) if version >= V41 else (),
        (marker(0x10001), marker(50007)),
        (AnalogSource(1, ((1.0, 2.0), (3.0,))),),
        (AnalogSource(2, ((), (0.5,))),),
        0x01020304,
        5,
        12.5,
        10**12,
        10**12 + 5,
        10**12 + 9,
        77 if version >= V41 else 0,
        88 if version >= V41 else 0,
        2,
    )


def bone(number: int, parent: int, version: BitstreamVersion) -> RigidBodyDescription:
    names = ("m1", "m2") if version >= V40 else ()
    return RigidBodyDescription(f"bone{number}", number, parent, (0.0, 0.5, 0.0), ((1.0, 2.0, 3.0),) * 2, (0, 7), names)


def full_models(version: BitstreamVersion) -> tuple[Description, ...]:
    models: tuple[Description, ...] = (
        bone(4, -1, version),
        MarkerSetDescription("all", ("a", "b")),
        SkeletonDescription("man", 3, (bone(1, 0, version), bone(2, 1, version))),
        DeviceDescription(8, "device", "serial", 1, 0, ("ch1",)),
    )
    if version >= V40:
        models += (CameraDescription("Prime 13", (1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0)),)
    if version >= V41:
        markers = (AssetMarkerDescription("x", 1, (1.0, 0.5, 0.25), 0.5, 3),)
        models += (AssetDescription("suit", 1, 9, (bone(1, -1, version),), markers),)
    return models


PLATE = ForcePlateDescription(
    1,
    "serial",
    0.5,
    0.25,
    (1.0, 2.0, 3.0),
    tuple(float(i) for i in range(144)),
    tuple(map(float, range(12))),
    2,
    1,
    ("Fx",),
)


@pytest.mark.parametrize("version", SERVED_BITSTREAMS, ids=str)
def test_independent_decoder_reads_encoded_frames(version: BitstreamVersion) -> None:
    frame = full_frame(version)
    buffer = PacketBuffer(encode_frame(frame, version))
    reference = DataFrame.read_from_buffer(buffer, Version(*version))
    # The reference decoder ignores the end-of-data tag and, in 4.1, the precision timestamp of 8 bytes.
    assert len(buffer.data) - buffer.pointer == (12 if version >= V41 else 4)
    assert reference.prefix.frame_number == frame.frame_number
    assert [(s.model_name, s.marker_pos_list) for s in reference.marker_sets] == [tuple(s) for s in frame.marker_sets]
    assert reference.unlabeled_marker_pos == frame.other_markers_m

    def numbers(b: object) -> tuple[object, ...]:
        return (b.id_num, *b.pos, *b.rot, b.marker_error, int(b.tracking_valid))  # type: ignore[attr-defined]

    assert [numbers(b) for b in reference.rigid_bodies] == [tuple(b) for b in frame.rigid_bodies]
    assert [[numbers(b) for b in s.rigid_bodies] for s in reference.skeletons] == [
        [tuple(b) for b in s.bones] for s in frame.skeletons
    ]
    assert [(m.id_num, *m.pos, m.size, m.param, m.residual) for m in reference.labeled_markers] == [
        tuple(m) for m in frame.labelled_markers
    ]
    assert [(p.id_num, p.channel_arrays) for p in reference.force_plates] == [tuple(p) for p in frame.force_plates]
    assert [(p.id_num, p.channel_arrays) for p in reference.devices] == [tuple(p) for p in frame.devices]
    if version >= V41:
        (asset,) = reference.assets
        assert asset.asset_id == 9
        assert [(m.marker_id, *m.pos, m.marker_size, m.marker_params, m.residual) for m in asset.markers] == [
            tuple(m) for m in frame.assets[0].markers
        ]
    end = reference.suffix
    assert (end.timecode, end.timecode_sub, end.timestamp) == (0x01020304, 5, 12.5)
    assert (end.stamp_camera_mid_exposure, end.stamp_data_received, end.stamp_transmit) == (
        10**12,
        10**12 + 5,
        10**12 + 9,
    )
    if version < V41:  # the other decoder does not know the precision timestamp and reads the parameters from it
        assert end.tracked_models_changed


@pytest.mark.parametrize("version", SERVED_BITSTREAMS, ids=str)
def test_independent_decoder_reads_encoded_descriptions(version: BitstreamVersion) -> None:
    models = full_models(version)
    buffer = PacketBuffer(encode_model_def(models, version))
    reference = DataDescriptions.read_from_buffer(buffer, Version(*version))
    assert buffer.pointer == len(buffer.data)
    description = models[0]
    assert isinstance(description, RigidBodyDescription)
    (rigid_body,) = reference.rigid_bodies
    assert (rigid_body.name, rigid_body.id_num, rigid_body.pos) == (
        description.name,
        description.id,
        description.offset_m,
    )
    assert [m.pos for m in rigid_body.markers] == list(description.marker_positions_m)
    assert [m.active_label for m in rigid_body.markers] == [0, 7]
    assert [m.name for m in rigid_body.markers] == (["m1", "m2"] if version >= V40 else [None, None])
    assert reference.marker_sets[0].marker_names == ("a", "b")
    assert [b.name for b in reference.skeletons[0].rigid_body_descriptions] == ["bone1", "bone2"]
    assert reference.devices[0].channel_names == ("ch1",)
    if version >= V41:
        assert reference.assets[0].marker_descriptions[0].position == (1.0, 0.5, 0.25)


@pytest.mark.parametrize("version", SERVED_BITSTREAMS, ids=str)
def test_frames_and_descriptions_round_trip(version: BitstreamVersion) -> None:
    assert decode_frame(encode_frame(full_frame(version), version), version) == full_frame(version)
    models = (*full_models(version), PLATE)
    assert decode_model_def(encode_model_def(models, version), version) == models


@pytest.mark.parametrize(
    ("version", "size"), [((3, 0), 78), ((3, 1), 78), ((4, 0), 78), ((4, 1), 122)], ids=lambda v: str(v)
)
def test_empty_frames_have_the_known_size(version: tuple[int, int], size: int) -> None:
    assert len(encode_frame(Frame(1), BitstreamVersion(*version))) == size


@pytest.mark.parametrize(("minor", "size"), [(6, 46), (7, 50), (8, 50), (9, 54), (10, 54), (11, 58)])
def test_frames_of_2_x_are_decoded(minor: int, size: int) -> None:
    """Bytes made by hand from the layout, since no packet of 2.x was captured."""
    version = BitstreamVersion(2, minor)
    counts = {6: 5, 7: 5, 8: 5, 9: 6, 10: 6, 11: 7}[minor]
    stamp = struct.pack("<f" if minor == 6 else "<d", 2.5)
    end = struct.pack("<fII", 0.005, 0, 0) + stamp + struct.pack("<hi", 0, 0)
    empty = struct.pack("<i", 7) + bytes(4 * counts) + end
    assert len(empty) == size
    assert decode_frame(empty, version).timestamp_s == 2.5
    rigid_body = struct.pack("<i7f", 3, 1, 2, 3, 0, 0, 0, 1) + struct.pack("<i", 2) + bytes(2 * 20)
    rigid_body += struct.pack("<fh", 0.5, 1)
    filled = struct.pack("<4i", 7, 0, 0, 1) + rigid_body + bytes(4 * (counts - 3)) + end
    frame = decode_frame(filled, version)
    assert frame.rigid_bodies == (RigidBody(3, 1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0, 0.5, 1),)


@pytest.mark.parametrize("version", [(2, 5), (4, 2), (4, 3), (5, 0)])
def test_unsupported_versions_are_refused_with_the_remedy(version: tuple[int, int]) -> None:
    with pytest.raises(ProtocolError) as caught:
        decode_frame(bytes(78), BitstreamVersion(*version))
    text = str(caught.value)
    assert f"{version[0]}.{version[1]}" in text
    assert "2.6 to 4.1" in text
    assert "Motive" in text


def test_version_of_an_unexpected_frame_is_named() -> None:
    payload = encode_frame(full_frame(V30), V30)
    with pytest.raises(ProtocolError) as caught:
        decode_frame(payload, V41)
    text = str(explain_frame_error(payload, V41, caught.value))
    assert "3.0, 3.1 or 4.0" in text
    assert "not 4.1" in text
    assert "2.6 to 4.1" in text
    assert "Data Streaming pane" in text
    assert 'bitstream = "3.0"' in text


def test_version_of_an_unexpected_old_frame_is_named() -> None:
    payload = struct.pack("<i", 7) + bytes(4 * 7) + struct.pack("<fIIdhi", 0.005, 0, 0, 2.5, 0, 0)
    with pytest.raises(ProtocolError) as caught:
        decode_frame(payload, V41)
    text = str(explain_frame_error(payload, V41, caught.value))
    assert "bitstream 2.11, not 4.1" in text
    assert 'bitstream = "2.11"' in text


def test_error_of_garbage_is_unchanged() -> None:
    with pytest.raises(ProtocolError) as caught:
        decode_frame(bytes(range(90)), V41)
    assert explain_frame_error(bytes(range(90)), V41, caught.value) is caught.value


def test_errors_name_the_byte_and_the_section() -> None:
    payload = encode_frame(full_frame(V41), V41)
    with pytest.raises(ProtocolError, match=r"at byte \d+ of 60, in (marker sets|other markers|rigid bodies)"):
        decode_frame(payload[:60], V41)
    with pytest.raises(ProtocolError, match=r"the end-of-data tag is 1 and not 0 .* the frame's end"):
        decode_frame(payload[:-4] + b"\1\0\0\0", V41)
    with pytest.raises(ProtocolError, match="announces"):
        decode_datagram(encode_message(7, payload)[:-1], V41)


@pytest.mark.parametrize("version", SERVED_BITSTREAMS, ids=str)
def test_every_truncation_is_refused(version: BitstreamVersion) -> None:
    frame = encode_frame(full_frame(version), version)
    models = encode_model_def((*full_models(version), PLATE), version)
    for size in range(len(frame)):
        with pytest.raises(ProtocolError):
            decode_frame(frame[:size], version)
    for size in range(len(models)):
        with pytest.raises(ProtocolError):
            decode_model_def(models[:size], version)
    with pytest.raises(ProtocolError, match="left over"):
        decode_frame(frame + b"\0", version)


def read_or_refuse(datagram: bytes) -> None:
    for version in (*SERVED_BITSTREAMS, BitstreamVersion(2, 6), BitstreamVersion(2, 11), BitstreamVersion(4, 3)):
        for lenient in (False, True):
            try:
                decode_datagram(datagram, version, lenient=lenient)
            except ProtocolError as error:
                assert str(error).endswith(".")


@given(st.binary(max_size=300))
@settings(max_examples=200, deadline=None)
def test_random_bytes_are_decoded_or_refused(data: bytes) -> None:
    read_or_refuse(data)
    for message_id in MESSAGE_IDS:
        read_or_refuse(encode_message(message_id, data))


@given(st.sampled_from([5, 7]), st.sampled_from(SERVED_BITSTREAMS), st.data())
@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_flipped_bits_are_decoded_or_refused(message_id: int, version: BitstreamVersion, data: st.DataObject) -> None:
    if message_id == 7:
        datagram = bytearray(encode_message(7, encode_frame(full_frame(version), version)))
    else:
        datagram = bytearray(encode_message(5, encode_model_def(full_models(version), version)))
    for _ in range(data.draw(st.integers(1, 3))):
        bit = data.draw(st.integers(0, 8 * len(datagram) - 1))
        datagram[bit // 8] ^= 1 << bit % 8
    read_or_refuse(bytes(datagram))


def test_unknown_descriptions_are_skipped_by_their_size() -> None:
    known = full_models(V41)
    models = (known[0], UnknownDescription(42, b"from the future"), known[1])
    assert decode_model_def(encode_model_def(models, V41), V41) == models
    unknown_description = struct.pack("<ii", 1, 42) + b"from the future"
    with pytest.raises(ProtocolError, match="type 42 is unknown"):
        decode_model_def(unknown_description, V40)


def test_connect_messages_of_known_clients_are_decoded() -> None:
    options = b"\0" + bytes((4, 0, 0, 0))
    name = b"Ping".ljust(256, b"\0") + bytes(8)
    assert decode_connect(b"").bitstream is None
    assert decode_connect(b"Ping\0").name == "Ping"
    assert decode_connect(name).bitstream is None
    for payload in (name + options, name + options + b"\0\0", name + options + bytes(4)):
        assert len(payload) in (269, 271, 273)
        assert decode_connect(payload).bitstream == (4, 0)
    assert decode_connect(name + b"\1" + bytes(4)) == ("Ping", (0, 0, 0, 0), (0, 0, 0, 0), None, True)
    assert len(encode_connect("carlab", bitstream=V41)) == 269


def test_server_info_before_version_3_0_is_decoded() -> None:
    info = decode_server_info(b"Motive".ljust(256, b"\0") + bytes((1, 10, 0, 0, 2, 10, 0, 0)))
    assert (info.name, info.bitstream, info.clock_hz) == ("Motive", (2, 10), 0)


@pytest.mark.parametrize("datagram", ["0a000000", "0a00000000", "0a000400"], ids=["exact", "stray NUL", "claims four"])
def test_server_accepts_keepalives_with_a_wrong_length(datagram: str) -> None:
    assert split_message(bytes.fromhex(datagram), lenient=True) == (10, b"")


def test_numbers_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ProtocolError, match="does not fit"):
        encode_frame(Frame(2**40))
    with pytest.raises(ProtocolError, match="assets"):
        encode_frame(Frame(1, assets=(Asset(1, (), ()),)), V40)
    with pytest.raises(ProtocolError, match="cannot be written"):
        encode_frame(Frame(1), BitstreamVersion(2, 9))


def test_decode_speed_is_measured() -> None:
    speed = natnet_decode_speed(seconds=0.05)
    assert set(speed) == {"captured_3_0_hz", "captured_4_1_hz", "ten_bodies_4_1_hz"}
    assert all(value > 1000.0 for value in speed.values())
