"""Decoding of any NatNet datagram."""

from typing import Any

from mocap.natnet.descriptions import decode_model_def
from mocap.natnet.frames import decode_frame
from mocap.natnet.messages import (
    decode_connect,
    decode_echo_request,
    decode_echo_response,
    decode_integer_response,
    decode_server_info,
    decode_text,
    split_message,
)
from mocap.natnet.models import BitstreamVersion, MessageId


def decode_datagram(datagram: bytes, version: BitstreamVersion, *, lenient: bool = False) -> tuple[int, Any]:
    """Decode a datagram to its message id and content; the content is None if its payload has no meaning."""
    message_id, payload = split_message(datagram, lenient=lenient)
    decoders = {
        MessageId.FRAMEOFDATA: lambda data: decode_frame(data, version),
        MessageId.MODELDEF: lambda data: decode_model_def(data, version),
        MessageId.CONNECT: decode_connect,
        MessageId.DISCOVERY: decode_connect,
        MessageId.SERVERINFO: decode_server_info,
        MessageId.REQUEST: decode_text,
        MessageId.MESSAGESTRING: decode_text,
        MessageId.RESPONSE: decode_integer_response,
        MessageId.ECHOREQUEST: decode_echo_request,
        MessageId.ECHORESPONSE: decode_echo_response,
    }
    return message_id, decoders[message_id](payload) if message_id in decoders else None
