"""NatNet datagrams and their short messages: header, handshake, requests, echo. Pure."""

from __future__ import annotations

from struct import Struct
from typing import NamedTuple

from carlab.core.errors import ProtocolError
from mocap.natnet.models import BitstreamVersion
from mocap.natnet.reader import UINT16_PAIR

HEADER_BYTES = 4
MAX_PAYLOAD_BYTES = 65503
NAME_BYTES = 256
SENDER_BYTES = 264
CONNECT_BYTES = 269
SERVERINFO_BYTES = 279

_FOUR = Struct("<4B")
_INFO = Struct("<QHB4s")
_ECHO = Struct("<Q")
_ECHO_RESPONSE = Struct("<QQ")
_INT = Struct("<i")
_FLOAT = Struct("<f")

FourVersion = tuple[int, int, int, int]


def encode_message(message_id: int, payload: bytes = b"") -> bytes:
    """Encode a datagram: id, payload length, payload. Raises ProtocolError if the payload exceeds a datagram."""
    if len(payload) > MAX_PAYLOAD_BYTES:
        raise ProtocolError(f"{len(payload)} bytes do not fit into one datagram of {MAX_PAYLOAD_BYTES}; send less.")
    return UINT16_PAIR.pack(message_id, len(payload)) + payload


def split_message(datagram: bytes, *, lenient: bool = False) -> tuple[int, bytes]:
    """Split a datagram into message id and payload.

    One extra NUL after the payload is accepted. ``lenient``, for a server, accepts all wrong lengths: some clients
    announce more bytes than they send.

    Raises:
        ProtocolError: No header, or a payload shorter or longer than the header says.
    """
    if len(datagram) < HEADER_BYTES:
        raise ProtocolError(f"A datagram of {len(datagram)} bytes is too short for the NatNet header of 4 bytes.")
    message_id, size = UINT16_PAIR.unpack_from(datagram)
    extra = len(datagram) - HEADER_BYTES - size
    if extra == 0:
        return message_id, datagram[HEADER_BYTES:]
    if lenient:
        return message_id, datagram[HEADER_BYTES : HEADER_BYTES + size]
    if extra < 0:
        raise ProtocolError(
            f"NatNet message {message_id} announces {size} bytes and has {size + extra}: it was truncated "
            f"at byte {len(datagram)}, in the payload."
        )
    if extra == 1 and datagram[-1] == 0:
        return message_id, datagram[HEADER_BYTES:-1]
    raise ProtocolError(
        f"NatNet message {message_id} announces {size} bytes and has {size + extra}: byte {HEADER_BYTES + size}, "
        "after the payload, is unexpected."
    )


class Connect(NamedTuple):
    """Identification of a client in CONNECT or DISCOVERY; None for missing fields."""

    name: str
    app_version: FourVersion | None
    natnet_version: FourVersion | None
    bitstream: BitstreamVersion | None
    subscribed_data_only: bool


class ServerInfo(NamedTuple):
    """Identification of a server. The last four fields are zero or empty for servers before 3.0."""

    name: str
    app_version: FourVersion
    natnet_version: FourVersion
    clock_hz: int = 0
    data_port: int = 0
    is_multicast: bool = False
    multicast_group: str = ""

    @property
    def bitstream(self) -> BitstreamVersion:
        """The version of the frames this server sends."""
        return BitstreamVersion(*self.natnet_version[:2])


def decode_text(data: bytes) -> str:
    """Text of a name, REQUEST, MESSAGESTRING or RESPONSE, up to the first NUL; Motive sends garbage after it."""
    return data.partition(b"\0")[0].decode("utf-8", "replace")


def _four(data: bytes) -> FourVersion:
    a, b, c, d = _FOUR.unpack(data)
    return a, b, c, d


def _sender(name: str, app_version: FourVersion, natnet_version: FourVersion) -> bytes:
    encoded = name.encode("utf-8")
    if len(encoded) >= NAME_BYTES or b"\0" in encoded:
        raise ProtocolError(f"The name {name!r} does not fit into {NAME_BYTES - 1} bytes without a NUL; shorten it.")
    return encoded.ljust(NAME_BYTES, b"\0") + bytes(app_version) + bytes(natnet_version)


def encode_connect(
    name: str,
    *,
    app_version: FourVersion = (1, 0, 0, 0),
    natnet_version: FourVersion = (4, 1, 0, 0),
    bitstream: BitstreamVersion | None = None,
    options: bool = True,
) -> bytes:
    """Payload of CONNECT (or DISCOVERY): 269 bytes with the options of NatNet 4, 264 without them.

    ``bitstream`` None requests the server's native version. Raises ProtocolError for a name that is too long or has a
    NUL.
    """
    sender = _sender(name, app_version, natnet_version)
    if not options:
        return sender
    wanted = (bitstream.major, bitstream.minor, 0, 0) if bitstream else (0, 0, 0, 0)
    return sender + b"\0" + bytes(wanted)


def decode_connect(payload: bytes) -> Connect:
    """Decode CONNECT of any known client: 0, 5 ("Ping"), 264, 269, 271 or 273 bytes. Never raises."""
    app_version = natnet_version = bitstream = None
    if len(payload) >= SENDER_BYTES:
        app_version, natnet_version = _four(payload[256:260]), _four(payload[260:264])
    if len(payload) >= CONNECT_BYTES and any(payload[265:269]):
        bitstream = BitstreamVersion(payload[265], payload[266])
    subscribed_only = len(payload) >= CONNECT_BYTES and payload[264] != 0
    return Connect(decode_text(payload[:NAME_BYTES]), app_version, natnet_version, bitstream, subscribed_only)


def encode_server_info(info: ServerInfo) -> bytes:
    """Payload of SERVERINFO, 279 bytes. Raises ProtocolError for a name that is too long or has a NUL."""
    group = bytes(int(part) for part in info.multicast_group.split(".")) if info.multicast_group else bytes(4)
    tail = _INFO.pack(info.clock_hz, info.data_port, info.is_multicast, group)
    return _sender(info.name, info.app_version, info.natnet_version) + tail


def decode_server_info(payload: bytes) -> ServerInfo:
    """Decode SERVERINFO, 279 bytes from 3.0 on and 264 before. Raises ProtocolError for fewer bytes."""
    if len(payload) < SENDER_BYTES:
        raise ProtocolError(
            f"NatNet server info ends at byte {len(payload)}, in the name and versions of {SENDER_BYTES} bytes."
        )
    sender = decode_text(payload[:NAME_BYTES]), _four(payload[256:260]), _four(payload[260:264])
    if len(payload) == SENDER_BYTES:
        return ServerInfo(*sender)
    if len(payload) < SERVERINFO_BYTES:
        raise ProtocolError(
            f"NatNet server info ends at byte {len(payload)}, in the clock and multicast fields that end at byte "
            f"{SERVERINFO_BYTES}."
        )
    clock_hz, data_port, is_multicast, group = _INFO.unpack_from(payload, SENDER_BYTES)
    dotted = ".".join(map(str, group)) if any(group) else ""
    return ServerInfo(*sender, clock_hz, data_port, bool(is_multicast), dotted)


def encode_request(command: str) -> bytes:
    """Payload of REQUEST: the command and a NUL."""
    return command.encode("utf-8") + b"\0"


def decode_integer_response(payload: bytes) -> int | None:
    """Integer answer to a REQUEST, which has four bytes; None for another length, which is text."""
    return int(_INT.unpack(payload)[0]) if len(payload) == _INT.size else None


def encode_response(value: int | float | str) -> bytes:
    """Payload of RESPONSE: int32, float32, or text with a NUL."""
    if isinstance(value, str):
        return encode_request(value)
    return (_INT if isinstance(value, int) else _FLOAT).pack(value)


def encode_echo_request(stamp: int) -> bytes:
    """Payload of ECHOREQUEST: the client's stamp, opaque to the server."""
    return _ECHO.pack(stamp)


def decode_echo_request(payload: bytes) -> int:
    """Decode the client's stamp. Raises ProtocolError."""
    return _fixed(_ECHO, payload, "echo request")[0]


def encode_echo_response(stamp: int, server_ticks: int) -> bytes:
    """Payload of ECHORESPONSE: the client's stamp and the server's clock when it arrived."""
    return _ECHO_RESPONSE.pack(stamp, server_ticks)


def decode_echo_response(payload: bytes) -> tuple[int, int]:
    """Decode the client's stamp and the server's ticks. Raises ProtocolError."""
    stamp, ticks = _fixed(_ECHO_RESPONSE, payload, "echo response")
    return stamp, ticks


def _fixed(layout: Struct, payload: bytes, what: str) -> tuple[int, ...]:
    if len(payload) != layout.size:
        raise ProtocolError(f"NatNet {what} ends at byte {len(payload)}, in its stamps, and not at byte {layout.size}.")
    return layout.unpack(payload)
