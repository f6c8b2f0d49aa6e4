"""Contents of NatNet messages as named tuples: metres, seconds, quaternions x, y, z, w, in the server's axes.

Sources of the layouts, here and in the other ``natnet_*`` modules: packets captured from Motive 2.1 (bitstream 3.0)
and, for the other versions, the depacketizers and headers that the vendor publishes with NatNet SDK 2.5 to 4.1.
"""

from __future__ import annotations

import enum
from typing import NamedTuple

from carlab.core.errors import ProtocolError

Vector3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


class MessageId(enum.IntEnum):
    """First field of every datagram."""

    CONNECT = 0
    SERVERINFO = 1
    REQUEST = 2
    RESPONSE = 3
    REQUEST_MODELDEF = 4
    MODELDEF = 5
    REQUEST_FRAMEOFDATA = 6
    FRAMEOFDATA = 7
    MESSAGESTRING = 8
    DISCONNECT = 9
    KEEPALIVE = 10
    DISCONNECTBYTIMEOUT = 11
    ECHOREQUEST = 12
    ECHORESPONSE = 13
    DISCOVERY = 14
    UNRECOGNIZED_REQUEST = 100


class BitstreamVersion(NamedTuple):
    """Version of the syntax of frames and descriptions; compares like a tuple."""

    major: int
    minor: int

    def __str__(self) -> str:
        return f"{self.major}.{self.minor}"

    @classmethod
    def parse(cls, text: str) -> BitstreamVersion:
        """Read ``4.1`` or ``4.1.0.0``. Raises ProtocolError."""
        parts = text.strip().split(".")
        if not 2 <= len(parts) <= 4 or not all(p.isascii() and p.isdecimal() and int(p) < 256 for p in parts):
            raise ProtocolError(f"'{text}' is not a bitstream version; write it as 4.1.")
        return cls(int(parts[0]), int(parts[1]))


OLDEST_BITSTREAM = BitstreamVersion(2, 6)
BITSTREAM_3_0, BITSTREAM_4_1 = BitstreamVersion(3, 0), BitstreamVersion(4, 1)
NEWEST_BITSTREAM = BITSTREAM_4_1
SERVED_BITSTREAMS = tuple(BitstreamVersion(*v) for v in ((3, 0), (3, 1), (4, 0), (4, 1)))
"""Versions that can be encoded and decoded; 2.6 to 2.11 can only be decoded."""


def check_readable(version: BitstreamVersion) -> None:
    """Raise ProtocolError with the remedy if frames of ``version`` cannot be decoded."""
    if not OLDEST_BITSTREAM <= version <= NEWEST_BITSTREAM:
        remedy = (
            'set Transmission Type to Unicast in Motive\'s Data Streaming pane and mode = "unicast" in '
            f"[hardware.mocap], so that carlab can ask the server for {NEWEST_BITSTREAM}."
            if version > NEWEST_BITSTREAM
            else "update Motive to 1.8 or later."
        )
        raise ProtocolError(
            f"The server streams NatNet bitstream {version}, and carlab reads {OLDEST_BITSTREAM} to "
            f"{NEWEST_BITSTREAM}; {remedy}"
        )


class MarkerSet(NamedTuple):
    """Markers of one asset in a frame."""

    name: str
    positions_m: tuple[Vector3, ...]


class RigidBody(NamedTuple):
    """Pose of a rigid body (or bone) in a frame. Bit 0 of ``params`` is set while it is tracked."""

    id: int
    x_m: float
    y_m: float
    z_m: float
    qx: float
    qy: float
    qz: float
    qw: float
    mean_error_m: float
    params: int

    @property
    def is_tracked(self) -> bool:
        """Whether the server tracked this body in this frame; otherwise the pose is stale or zero."""
        return bool(self.params & 1)


class Skeleton(NamedTuple):
    """Bones of a skeleton in a frame; a bone's id holds the skeleton's in its high 16 bits."""

    id: int
    bones: tuple[RigidBody, ...]


class LabelledMarker(NamedTuple):
    """A marker with an identity.

    ``id``: high 16 bits the model (0 none), low 16 bits the member. ``params``: 1 occluded, 2 solved from the point
    cloud, 4 filled by the model, 8 has a model, 16 unlabelled, 32 active.
    """

    id: int
    x_m: float
    y_m: float
    z_m: float
    size_m: float
    params: int
    residual_m: float


class Asset(NamedTuple):
    """A trained marker set in a frame (bitstream 4.1)."""

    id: int
    rigid_bodies: tuple[RigidBody, ...]
    markers: tuple[LabelledMarker, ...]


class AnalogSource(NamedTuple):
    """A force plate or another device in a frame: samples by channel."""

    id: int
    channels: tuple[tuple[float, ...], ...]


class ServerMode(enum.IntEnum):
    """Mode of the server, its answer to the request CurrentMode. Higher numbers are further kinds of Edit mode.

    1 means recording in the headers of the vendor, and Edit mode in the documentation of Motive 3.
    """

    LIVE = 0
    RECORDING_OR_EDIT = 1
    EDIT = 2


FRAME_RECORDING = 0x01
FRAME_MODELS_CHANGED = 0x02
FRAME_BITSTREAM_CHANGED = 0x08


class Frame(NamedTuple):
    """One frame of mocap data. Stamps ending in ``_ticks`` are on the server's high-resolution clock, 0 for none."""

    frame_number: int
    marker_sets: tuple[MarkerSet, ...] = ()
    other_markers_m: tuple[Vector3, ...] = ()
    rigid_bodies: tuple[RigidBody, ...] = ()
    skeletons: tuple[Skeleton, ...] = ()
    assets: tuple[Asset, ...] = ()
    labelled_markers: tuple[LabelledMarker, ...] = ()
    force_plates: tuple[AnalogSource, ...] = ()
    devices: tuple[AnalogSource, ...] = ()
    timecode: int = 0
    timecode_sub: int = 0
    timestamp_s: float = 0.0
    mid_exposure_ticks: int = 0
    received_ticks: int = 0
    transmit_ticks: int = 0
    precision_s: int = 0
    precision_fraction: int = 0
    params: int = 0


class MarkerSetDescription(NamedTuple):
    """Names of the markers of an asset."""

    name: str
    marker_names: tuple[str, ...]


class RigidBodyDescription(NamedTuple):
    """Definition of a rigid body (or bone) in the server. ``marker_names`` exist since 4.0 and are empty before.

    ``marker_positions_m`` are unchanged. In the packets captured from Motive 2.1 their x is mirrored: with -x they
    agree with the body's pose and the labelled markers of the frames.
    """

    name: str
    id: int
    parent_id: int = -1
    offset_m: Vector3 = (0.0, 0.0, 0.0)
    marker_positions_m: tuple[Vector3, ...] = ()
    marker_labels: tuple[int, ...] = ()
    marker_names: tuple[str, ...] = ()


class SkeletonDescription(NamedTuple):
    """A skeleton and its bones."""

    name: str
    id: int
    bones: tuple[RigidBodyDescription, ...]


class ForcePlateDescription(NamedTuple):
    """A force plate: calibration 12 x 12 row by row, four corners."""

    id: int
    serial: str
    width_m: float
    length_m: float
    origin_m: Vector3
    calibration: tuple[float, ...]
    corners_m: tuple[float, ...]
    plate_type: int
    channel_data_type: int
    channel_names: tuple[str, ...]


class DeviceDescription(NamedTuple):
    """An analog device."""

    id: int
    name: str
    serial: str
    device_type: int
    channel_data_type: int
    channel_names: tuple[str, ...]


class CameraDescription(NamedTuple):
    """A camera and its pose."""

    name: str
    position_m: Vector3
    quaternion: Quaternion


class AssetMarkerDescription(NamedTuple):
    """A marker of an asset."""

    name: str
    id: int
    position_m: Vector3
    size_m: float
    params: int


class AssetDescription(NamedTuple):
    """A trained marker set (bitstream 4.1)."""

    name: str
    asset_type: int
    id: int
    rigid_bodies: tuple[RigidBodyDescription, ...]
    markers: tuple[AssetMarkerDescription, ...]


class UnknownDescription(NamedTuple):
    """A description of unknown type, skipped by its size (bitstream 4.1)."""

    type_id: int
    data: bytes


Description = (
    MarkerSetDescription
    | RigidBodyDescription
    | SkeletonDescription
    | ForcePlateDescription
    | DeviceDescription
    | CameraDescription
    | AssetDescription
    | UnknownDescription
)
