"""MODELDEF payloads, the server's list of tracked models: decoded for 2.6 to 4.1, encoded for 3.0 to 4.1. Pure."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from struct import Struct
from struct import error as StructError

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
PLATE = Struct("<ff3f144f12f")
POSE = Struct("<3f4f")
ASSET_MARKER = Struct("<i3ffh")

_BITSTREAM_4_0 = BitstreamVersion(4, 0)


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
    descriptions: list[Description] = []
    for index in range(reader.count(5)):
        reader.section = f"description {index}"
        kind = reader.integer()
        read = _READERS.get(kind)
        if not sized:
            if read is None:
                reader.pos -= INT32.size
                raise reader.error(f"type {kind} is unknown and bitstream {version} gives no size to skip it by")
            descriptions.append(read(reader, version))
            continue
        size = reader.integer()
        if size < 0 or size > reader.end - reader.pos:
            raise reader.error(f"a description of {size} bytes does not fit into the {reader.end - reader.pos} left")
        stop = reader.pos + size
        if read is None:
            descriptions.append(UnknownDescription(kind, payload[reader.pos : stop]))
        else:
            whole, reader.end = reader.end, stop
            descriptions.append(read(reader, version))
            reader.end = whole
        reader.pos = stop
    reader.section = "the end"
    reader.finish()
    return tuple(descriptions)


def _read_marker_set(reader: Reader, version: BitstreamVersion) -> MarkerSetDescription:
    return MarkerSetDescription(reader.text(), reader.texts(reader.count(1)))


def _read_body(reader: Reader, version: BitstreamVersion) -> RigidBodyDescription:
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


def _read_skeleton(reader: Reader, version: BitstreamVersion) -> SkeletonDescription:
    name, skeleton_id = reader.text(), reader.integer()
    bones = tuple([_read_body(reader, version) for _ in range(reader.count(1 + BODY.size))])
    return SkeletonDescription(name, skeleton_id, bones)


def _read_force_plate(reader: Reader, version: BitstreamVersion) -> ForcePlateDescription:
    plate_id, serial = reader.integer(), reader.text()
    numbers = reader.take(PLATE)
    plate_type, channel_type = reader.take(PAIR)
    names = reader.texts(reader.count(1))
    width, length, origin, calibration, corners = *numbers[:2], numbers[2:5], numbers[5:149], numbers[149:]
    return ForcePlateDescription(
        plate_id,
        serial,
        width,
        length,
        origin,
        calibration,
        corners,
        plate_type,
        channel_type,
        names,
    )


def _read_device(reader: Reader, version: BitstreamVersion) -> DeviceDescription:
    device_id, name, serial = reader.integer(), reader.text(), reader.text()
    device_type, channel_type = reader.take(PAIR)
    return DeviceDescription(device_id, name, serial, device_type, channel_type, reader.texts(reader.count(1)))


def _read_camera(reader: Reader, version: BitstreamVersion) -> CameraDescription:
    name = reader.text()
    pose = reader.take(POSE)
    return CameraDescription(name, pose[:3], pose[3:])


def _read_asset(reader: Reader, version: BitstreamVersion) -> AssetDescription:
    name = reader.text()
    asset_type, asset_id = reader.take(PAIR)
    bodies = tuple([_read_body(reader, version) for _ in range(reader.count(1 + BODY.size))])
    markers = []
    for _ in range(reader.count(1 + ASSET_MARKER.size)):
        marker_name = reader.text()
        marker_id, x, y, z, size, params = reader.take(ASSET_MARKER)
        markers.append(AssetMarkerDescription(marker_name, marker_id, (x, y, z), size, params))
    return AssetDescription(name, asset_type, asset_id, bodies, tuple(markers))


_READERS: dict[int, Callable[[Reader, BitstreamVersion], Description]] = {
    0: _read_marker_set,
    1: _read_body,
    2: _read_skeleton,
    3: _read_force_plate,
    4: _read_device,
    5: _read_camera,
    6: _read_asset,
}


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
    match item:
        case MarkerSetDescription():
            return 0, encode_text(item.name) + _texts(item.marker_names)
        case RigidBodyDescription():
            return 1, _encode_body(item, version)
        case SkeletonDescription():
            bones = encode_counted(_encode_body(bone, version) for bone in item.bones)
            return 2, encode_text(item.name) + INT32.pack(item.id) + bones
        case ForcePlateDescription():
            numbers = PLATE.pack(item.width_m, item.length_m, *item.origin_m, *item.calibration, *item.corners_m)
            kinds = PAIR.pack(item.plate_type, item.channel_data_type)
            return 3, INT32.pack(item.id) + encode_text(item.serial) + numbers + kinds + _texts(item.channel_names)
        case DeviceDescription():
            kinds = PAIR.pack(item.device_type, item.channel_data_type)
            names = encode_text(item.name) + encode_text(item.serial)
            return 4, INT32.pack(item.id) + names + kinds + _texts(item.channel_names)
        case CameraDescription():
            return 5, encode_text(item.name) + POSE.pack(*item.position_m, *item.quaternion)
        case AssetDescription():
            bodies = encode_counted(_encode_body(body, version) for body in item.rigid_bodies)
            markers = encode_counted(
                encode_text(m.name) + ASSET_MARKER.pack(m.id, *m.position_m, m.size_m, m.params) for m in item.markers
            )
            return 6, encode_text(item.name) + PAIR.pack(item.asset_type, item.id) + bodies + markers
        case UnknownDescription():
            if version < BITSTREAM_4_1:
                raise ProtocolError(f"Bitstream {version} cannot carry a description of unknown type {item.type_id}.")
            return item.type_id, item.data


def _encode_body(body: RigidBodyDescription, version: BitstreamVersion) -> bytes:
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


def _texts(names: Sequence[str]) -> bytes:
    return encode_counted(encode_text(name) for name in names)
