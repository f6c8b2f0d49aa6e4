"""MODELDEF payloads, the server's list of tracked models: decoded for 2.6 to 4.1, encoded for 3.0 to 4.1. Pure."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from struct import Struct
from struct import error as StructError
from typing import Any

from carlab.core.errors import ProtocolError
from mocap.natnet.models import (
    BITSTREAM_3_0,
    BITSTREAM_4_1,
    NEWEST_BITSTREAM,
    SERVED_BITSTREAMS,
    AssetDescription,
    AssetMarkerDescription,
    BitstreamVersion,
    CameraDescription,
    Description,
    DeviceDescription,
    ForcePlateDescription,
    MarkerSetDescription,
    RigidBodyDescription,
    SkeletonDescription,
    UnknownDescription,
    check_readable,
)
from mocap.natnet.reader import INT32, PAIR, VECTOR, Reader, encode_counted, encode_text

BODY = Struct("<ii3f")

_BITSTREAM_4_0 = BitstreamVersion(4, 0)


@dataclass(frozen=True, slots=True)
class _Field:
    """How a value is read and encoded, and its least size."""

    read: Callable[[Reader], Any]
    encode: Callable[[Any], bytes]
    smallest_bytes: int


def _number(code: str) -> _Field:
    layout = Struct(f"<{code}")
    return _Field(lambda reader: reader.take(layout)[0], layout.pack, layout.size)


def _floats(count: int) -> _Field:
    layout = Struct(f"<{count}f")
    return _Field(lambda reader: reader.take(layout), lambda values: layout.pack(*values), layout.size)


def _several(field: _Field) -> _Field:
    """The number of entries, and the entries."""

    def read(reader: Reader) -> tuple[Any, ...]:
        return tuple([field.read(reader) for _ in range(reader.count(field.smallest_bytes))])

    return _Field(read, lambda values: encode_counted(map(field.encode, values)), INT32.size)


def _record(kind: Callable[..., Any], *fields: _Field) -> _Field:
    """The attributes of a description, one after the other."""
    return _Field(
        lambda reader: kind(*[field.read(reader) for field in fields]),
        lambda item: b"".join([field.encode(value) for field, value in zip(fields, item, strict=True)]),
        sum(field.smallest_bytes for field in fields),
    )


def _layouts(version: BitstreamVersion) -> dict[type, _Field]:
    """The layout of each class of descriptions; its position in the dictionary is the number of its type."""
    text, integer, real, vector = _Field(Reader.text, encode_text, 1), _number("i"), _number("f"), _floats(3)
    texts = _several(text)
    body = _Field(partial(_read_body, version), partial(_encode_body, version), 1 + BODY.size)
    marker = _record(AssetMarkerDescription, text, integer, vector, real, _number("h"))
    plate = (integer, text, real, real, vector, _floats(144), _floats(12), integer, integer, texts)
    return {
        MarkerSetDescription: _record(MarkerSetDescription, text, texts),
        RigidBodyDescription: body,
        SkeletonDescription: _record(SkeletonDescription, text, integer, _several(body)),
        ForcePlateDescription: _record(ForcePlateDescription, *plate),
        DeviceDescription: _record(DeviceDescription, integer, text, text, integer, integer, texts),
        CameraDescription: _record(CameraDescription, text, vector, _floats(4)),
        AssetDescription: _record(AssetDescription, text, integer, integer, _several(body), _several(marker)),
    }


def decode_model_def(payload: bytes, version: BitstreamVersion) -> tuple[Description, ...]:
    """Decode all descriptions.

    From 4.1 on each description has a size: an unknown type becomes an UnknownDescription, and bytes that a later
    server appends to a known type are skipped. Before 4.1 an unknown type cannot be skipped and is an error.

    Raises:
        ProtocolError: Unsupported version, or invalid bytes; names the byte and the section.
    """
    check_readable(version)
    reader = Reader(payload, f"NatNet model definitions read as bitstream {version}")
    sized = version >= BITSTREAM_4_1
    layouts = list(_layouts(version).values())
    descriptions: list[Description] = []
    for index in range(reader.count(5)):
        reader.section = f"description {index}"
        kind = reader.integer()
        read = layouts[kind].read if 0 <= kind < len(layouts) else None
        if not sized:
            if read is None:
                reader.pos -= INT32.size
                raise reader.error(f"type {kind} is unknown and bitstream {version} gives no size to skip it by")
            descriptions.append(read(reader))
            continue
        size = reader.integer()
        if size < 0 or size > reader.end - reader.pos:
            raise reader.error(f"a description of {size} bytes does not fit into the {reader.end - reader.pos} left")
        stop = reader.pos + size
        if read is None:
            descriptions.append(UnknownDescription(kind, payload[reader.pos : stop]))
        else:
            whole, reader.end = reader.end, stop
            descriptions.append(read(reader))
            reader.end = whole
        reader.pos = stop
    reader.section = "the end"
    reader.finish()
    return tuple(descriptions)


def _read_body(version: BitstreamVersion, reader: Reader) -> RigidBodyDescription:
    name = reader.text()
    body_id, parent_id, *offset = reader.take(BODY)
    positions: tuple[tuple[float, ...], ...] = ()
    labels: tuple[int, ...] = ()
    names: tuple[str, ...] = ()
    if version >= BITSTREAM_3_0:
        markers = reader.count(VECTOR.size + INT32.size)
        positions = tuple(reader.records(VECTOR, markers))
        labels = tuple([label for (label,) in reader.records(INT32, markers)])
        if version >= _BITSTREAM_4_0:
            names = reader.texts(markers)
    return RigidBodyDescription(name, body_id, parent_id, tuple(offset), positions, labels, names)  # type: ignore[arg-type]


def encode_model_def(descriptions: Sequence[Description], version: BitstreamVersion = NEWEST_BITSTREAM) -> bytes:
    """Encode descriptions in the given order.

    Raises:
        ProtocolError: The version is not one of SERVED_BITSTREAMS, or a number does not fit its field.
    """
    if version not in SERVED_BITSTREAMS:
        served = ", ".join(map(str, SERVED_BITSTREAMS))
        raise ProtocolError(f"Model definitions of bitstream {version} cannot be written; choose one of {served}.")
    parts = [INT32.pack(len(descriptions))]
    for description in descriptions:
        try:
            kind, body = _encode(description, version)
        except StructError as error:
            raise ProtocolError(f"{description} holds a number that does not fit its field: {error}.") from error
        parts.append(PAIR.pack(kind, len(body)) if version >= BITSTREAM_4_1 else INT32.pack(kind))
        parts.append(body)
    return b"".join(parts)


def _encode(item: Description, version: BitstreamVersion) -> tuple[int, bytes]:
    if not isinstance(item, UnknownDescription):
        layouts = _layouts(version)
        return list(layouts).index(type(item)), layouts[type(item)].encode(item)
    if version < BITSTREAM_4_1:
        raise ProtocolError(f"Bitstream {version} cannot carry a description of unknown type {item.type_id}.")
    return item.type_id, item.data


def _encode_body(version: BitstreamVersion, body: RigidBodyDescription) -> bytes:
    count = len(body.marker_positions_m)
    labels = body.marker_labels or (0,) * count
    names = body.marker_names or tuple(f"Marker{i + 1}" for i in range(count))
    if len(labels) != count or len(names) != count:
        raise ProtocolError(f"Rigid body '{body.name}' has {count} markers, {len(labels)} labels, {len(names)} names.")
    parts = [encode_text(body.name), BODY.pack(body.id, body.parent_id, *body.offset_m), INT32.pack(count)]
    parts += [VECTOR.pack(*p) for p in body.marker_positions_m]
    parts += [INT32.pack(label) for label in labels]
    if version >= _BITSTREAM_4_0:
        parts += [encode_text(name) for name in names]
    return b"".join(parts)
