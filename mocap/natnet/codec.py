"""The NatNet codec as one namespace: pure functions between datagrams and values, bitstreams 2.6 to 4.1.

The parts are in ``messages`` (header, handshake, requests, echo), ``descriptions`` (MODELDEF) and ``frames``
(FRAMEOFDATA).
"""

from __future__ import annotations

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
    split_message,
)
from mocap.natnet.models import BitstreamVersion, Frame, MessageId

__all__ = [
    "BitstreamVersion",
    "Connect",
    "Frame",
    "MessageId",
    "Response",
    "ServerInfo",
    "decode_connect",
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
    "split_message",
]
