"""FRAMEOFDATA payloads: decoded to Frame for bitstreams 2.6 to 4.1, encoded for 3.0 to 4.1. Pure.

Frames of 3.0, 3.1 and 4.0 have the same layout. 4.1 adds a size in bytes to every section, a section of assets and a
precision timestamp. Before 3.0 a rigid body carries its markers (skipped here) and the frame a latency instead of
clock stamps.
"""

from __future__ import annotations

from collections.abc import Callable
from struct import Struct
from struct import error as StructError
from typing import Any, TypeVar

from carlab.core.errors import ProtocolError
from mocap.natnet.models import (
    BITSTREAM_3_0,
    BITSTREAM_4_1,
    NEWEST_BITSTREAM,
    OLDEST_BITSTREAM,
    SERVED_BITSTREAMS,
    AnalogSource,
    Asset,
    BitstreamVersion,
    Frame,
    LabelledMarker,
    MarkerSet,
    RigidBody,
    Skeleton,
    check_readable,
)
from mocap.natnet.reader import INT32, PAIR, VECTOR, Reader, encode_counted, encode_text

_T = TypeVar("_T")

BODY = Struct("<i7ffh")
BODY_HEAD = Struct("<i7f")
BODY_TAIL = Struct("<fh")
MARKER = Struct("<i3ffhf")
MARKER_2 = Struct("<i3ffh")
FLOAT = Struct("<f")
TRAILER_26 = Struct("<fIIfhi")
TRAILER_27 = Struct("<fIIdhi")
TRAILER_30 = Struct("<IIdQQQhi")
TRAILER_41 = Struct("<IIdQQQIIhi")

# One version for each distinct layout, to identify the version of an unreadable frame.
_LAYOUTS = tuple(BitstreamVersion(*v) for v in ((4, 1), (3, 0), (2, 11), (2, 9), (2, 7), (2, 6)))
_LAYOUT_NAMES = {
    (4, 1): "4.1",
    (3, 0): "3.0, 3.1 or 4.0",
    (2, 11): "2.11",
    (2, 9): "2.9 or 2.10",
    (2, 7): "2.7 or 2.8",
    (2, 6): "2.6",
}


def decode_frame(payload: bytes, version: BitstreamVersion) -> Frame:
    """Decode a complete frame and check its layout to the last byte.

    Args:
        payload: Bytes of the message after its header.
        version: Bitstream version negotiated with the server; frames do not contain it.

    Raises:
        ProtocolError: Unsupported version, or invalid bytes; names the byte and the section.
    """
    check_readable(version)
    sized = version >= BITSTREAM_4_1
    reader = Reader(payload, f"NatNet frame read as bitstream {version}", sized=sized)
    head = reader.section_count
    frame_number = reader.integer()
    number = head("marker sets", 5)
    marker_sets = tuple([_marker_set(reader) for _ in range(number)]) if number else ()
    number = head("other markers", VECTOR.size)
    other_markers = tuple(reader.records(VECTOR, number)) if number else ()
    modern = version >= BITSTREAM_3_0
    bodies = _bodies if modern else _bodies_2
    number = head("rigid bodies", BODY.size)
    rigid_bodies = bodies(reader, number) if number else ()
    number = head("skeletons", PAIR.size)
    skeletons = tuple([Skeleton(reader.integer(), bodies(reader, reader.count(BODY.size))) for _ in range(number)])
    assets: tuple[Asset, ...] = ()
    if sized and (number := head("assets", 12)):
        assets = tuple([_asset(reader) for _ in range(number)])
    number = head("labelled markers", MARKER.size if modern else MARKER_2.size)
    labelled = _labelled(reader, number, modern) if number else ()
    force_plates = _analog(reader, head("force plates", PAIR.size)) if version >= (2, 9) else ()
    devices = _analog(reader, head("devices", PAIR.size)) if version >= (2, 11) else ()
    reader.section = "the frame's end"
    trailer = _trailer(reader, version)
    if reader.pos != reader.end:
        reader.finish()
    return Frame(
        frame_number,
        marker_sets,
        other_markers,
        rigid_bodies,
        skeletons,
        assets,
        labelled,
        force_plates,
        devices,
        *trailer,
    )


def _labelled(reader: Reader, number: int, modern: bool) -> tuple[LabelledMarker, ...]:
    if modern:
        return tuple(map(LabelledMarker._make, reader.records(MARKER, number)))
    return tuple([LabelledMarker._make((*record, 0.0)) for record in reader.records(MARKER_2, number)])


def _trailer(reader: Reader, version: BitstreamVersion) -> tuple[Any, ...]:
    """Time code to flags, in the order of ``Frame``'s last fields; zero for fields that the version lacks."""
    mid = received = transmit = precision_s = fraction = 0
    if version >= BITSTREAM_4_1:
        code, sub, time_s, mid, received, transmit, precision_s, fraction, params, end = reader.take(TRAILER_41)
    elif version >= BITSTREAM_3_0:
        code, sub, time_s, mid, received, transmit, params, end = reader.take(TRAILER_30)
    else:
        _, code, sub, time_s, params, end = reader.take(TRAILER_27 if version >= (2, 7) else TRAILER_26)
    if end != 0:
        raise reader.error(f"the end-of-data tag is {end} and not 0")
    return code, sub, time_s, mid, received, transmit, precision_s, fraction, params


def layouts_that_fit(payload: bytes) -> str:
    """Bitstream versions in which ``payload`` is a valid frame, as text; empty for none."""
    fits = []
    for version in _LAYOUTS:
        try:
            decode_frame(payload, version)
        except ProtocolError:
            continue
        fits.append(_LAYOUT_NAMES[version])
    return ", ".join(fits)


def explain_frame_error(payload: bytes, version: BitstreamVersion, error: ProtocolError) -> ProtocolError:
    """Return ``error``, or a more specific error if the frame is valid in another bitstream version."""
    fits = layouts_that_fit(payload)
    if not fits:
        return error
    oldest = fits.replace(",", " ").split()[0]
    return ProtocolError(
        f"The frames are of NatNet bitstream {fits}, not {version} as the server announced (carlab reads "
        f"{OLDEST_BITSTREAM} to {NEWEST_BITSTREAM}); restart streaming in Motive's Data Streaming pane, or set its "
        f'Transmission Type to Unicast and bitstream = "{oldest}" in [hardware.mocap] (listen: --bitstream).'
    )


def _marker_set(reader: Reader) -> MarkerSet:
    name = reader.text()
    return MarkerSet(name, tuple(reader.records(VECTOR, reader.count(VECTOR.size))))


def _bodies(reader: Reader, number: int) -> tuple[RigidBody, ...]:
    return tuple(map(RigidBody._make, reader.records(BODY, number)))


def _bodies_2(reader: Reader, number: int) -> tuple[RigidBody, ...]:
    bodies = []
    for _ in range(number):
        head = reader.take(BODY_HEAD)
        markers = reader.count(VECTOR.size + 8)
        reader.pos += markers * (VECTOR.size + 8)  # positions, ids, sizes
        bodies.append(RigidBody(*head, *reader.take(BODY_TAIL)))
    return tuple(bodies)


def _asset(reader: Reader) -> Asset:
    asset_id = reader.integer()
    bodies = _bodies(reader, reader.count(BODY.size))
    markers = tuple(map(LabelledMarker._make, reader.records(MARKER, reader.count(MARKER.size))))
    return Asset(asset_id, bodies, markers)


def _analog(reader: Reader, number: int) -> tuple[AnalogSource, ...]:
    sources = []
    for _ in range(number):
        source_id = reader.integer()
        channels = [
            tuple([value for (value,) in reader.records(FLOAT, reader.count(FLOAT.size))])
            for _ in range(reader.count(INT32.size))
        ]
        sources.append(AnalogSource(source_id, tuple(channels)))
    return tuple(sources)


def encode_frame(frame: Frame, version: BitstreamVersion = NEWEST_BITSTREAM) -> bytes:
    """Encode a frame's payload.

    Raises:
        ProtocolError: The version is not one of SERVED_BITSTREAMS, a number does not fit its field, or there are
            assets in a frame older than 4.1.
    """
    if version not in SERVED_BITSTREAMS:
        served = ", ".join(map(str, SERVED_BITSTREAMS))
        raise ProtocolError(f"Frames of bitstream {version} cannot be written; choose one of {served}.")
    sized = version >= BITSTREAM_4_1
    if frame.assets and not sized:
        raise ProtocolError(f"Bitstream {version} has no assets; write this frame as 4.1.")
    try:
        sections: list[bytes] = [
            INT32.pack(frame.frame_number),
            _section(frame.marker_sets, _encode_marker_set, sized),
            _section(frame.other_markers_m, lambda p: VECTOR.pack(*p), sized),
            _section(frame.rigid_bodies, lambda b: BODY.pack(*b), sized),
            _section(frame.skeletons, _encode_skeleton, sized),
            *([_section(frame.assets, _encode_asset, sized)] if sized else []),
            _section(frame.labelled_markers, lambda m: MARKER.pack(*m), sized),
            _section(frame.force_plates, _encode_analog, sized),
            _section(frame.devices, _encode_analog, sized),
        ]
        stamps = (frame.mid_exposure_ticks, frame.received_ticks, frame.transmit_ticks)
        start = (frame.timecode, frame.timecode_sub, frame.timestamp_s, *stamps)
        if sized:
            sections.append(TRAILER_41.pack(*start, frame.precision_s, frame.precision_fraction, frame.params, 0))
        else:
            sections.append(TRAILER_30.pack(*start, frame.params, 0))
    except (StructError, OverflowError) as error:
        raise ProtocolError(
            f"Frame {frame.frame_number} holds a number that does not fit its field: {error}."
        ) from error
    return b"".join(sections)


def _section(items: tuple[_T, ...], encode: Callable[[_T], bytes], sized: bool) -> bytes:
    body = b"".join([encode(item) for item in items])
    return (PAIR.pack(len(items), len(body)) if sized else INT32.pack(len(items))) + body


def _encode_marker_set(markers: MarkerSet) -> bytes:
    return encode_text(markers.name) + encode_counted(VECTOR.pack(*p) for p in markers.positions_m)


def _encode_skeleton(skeleton: Skeleton) -> bytes:
    return INT32.pack(skeleton.id) + encode_counted(BODY.pack(*bone) for bone in skeleton.bones)


def _encode_asset(asset: Asset) -> bytes:
    bodies = encode_counted(BODY.pack(*body) for body in asset.rigid_bodies)
    return INT32.pack(asset.id) + bodies + encode_counted(MARKER.pack(*marker) for marker in asset.markers)


def _encode_analog(source: AnalogSource) -> bytes:
    return INT32.pack(source.id) + encode_counted(
        encode_counted(FLOAT.pack(v) for v in channel) for channel in source.channels
    )
