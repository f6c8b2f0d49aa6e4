"""The NatNet codec as one namespace: pure functions between datagrams and values, bitstreams 2.6 to 4.1.

``decode_datagram`` decodes any message. The parts are in ``messages`` (header, handshake, requests, echo),
``descriptions`` (MODELDEF) and ``frames`` (FRAMEOFDATA).
"""

from __future__ import annotations

from typing import NamedTuple

from mocap.natnet.descriptions import decode_model_def, encode_model_def
from mocap.natnet.frames import decode_frame, encode_frame, explain_frame_error, layouts_that_fit
from mocap.natnet.messages import (
    Connect,
    Response,
    ServerInfo,
    decode_connect,
    decode_echo_request,
    decode_echo_response,
    decode_server_info,
    decode_text,
    encode_connect,
    encode_echo_request,
    encode_echo_response,
    encode_message,
    encode_request,
    encode_response,
    encode_server_info,
    message_name,
    split_message,
)
from mocap.natnet.models import BitstreamVersion, Description, Frame, MessageId


class EchoResponse(NamedTuple):
    """The returned stamp of the client, with the time of the server's clock."""

    stamp: int
    server_ticks: int


class TextMessage(NamedTuple):
    """A message with a text (REQUEST or MESSAGESTRING)."""

    text: str


class NoContent(NamedTuple):
    """A message whose payload has no meaning."""

    message_id: int


Message = (
    Connect | ServerInfo | TextMessage | Response | tuple[Description, ...] | Frame | EchoResponse | int | NoContent
)


def decode_datagram(datagram: bytes, version: BitstreamVersion, *, lenient: bool = False) -> tuple[int, Message]:
    """Decode any datagram of the protocol to its message id and content.

    Raises:
        ProtocolError: The bytes do not follow the protocol; names the byte and the section.
    """
    message_id, payload = split_message(datagram, lenient=lenient)
    match message_id:
        case MessageId.FRAMEOFDATA:
            return message_id, decode_frame(payload, version)
        case MessageId.MODELDEF:
            return message_id, decode_model_def(payload, version)
        case MessageId.CONNECT | MessageId.DISCOVERY:
            return message_id, decode_connect(payload)
        case MessageId.SERVERINFO:
            return message_id, decode_server_info(payload)
        case MessageId.REQUEST | MessageId.MESSAGESTRING:
            return message_id, TextMessage(decode_text(payload))
        case MessageId.RESPONSE:
            return message_id, Response(payload)
        case MessageId.ECHOREQUEST:
            return message_id, decode_echo_request(payload)
        case MessageId.ECHORESPONSE:
            return message_id, EchoResponse(*decode_echo_response(payload))
        case _:
            return message_id, NoContent(message_id)


__all__ = [
    "BitstreamVersion",
    "Connect",
    "EchoResponse",
    "Frame",
    "Message",
    "MessageId",
    "NoContent",
    "Response",
    "ServerInfo",
    "TextMessage",
    "decode_connect",
    "decode_datagram",
    "decode_echo_request",
    "decode_echo_response",
    "decode_frame",
    "decode_model_def",
    "decode_server_info",
    "decode_text",
    "encode_connect",
    "encode_echo_request",
    "encode_echo_response",
    "encode_frame",
    "encode_message",
    "encode_model_def",
    "encode_request",
    "encode_response",
    "encode_server_info",
    "explain_frame_error",
    "layouts_that_fit",
    "message_name",
    "split_message",
]
