"""Which NatNet servers are on the network."""

from __future__ import annotations

import select
import socket
import time
from dataclasses import dataclass

from carlab.core.errors import NotReadyError, ProtocolError
from mocap.natnet.codec import MessageId, ServerInfo, decode_server_info, encode_connect, encode_message, split_message
from mocap.natnet.sockets import DATAGRAM_BYTES, DEFAULT_COMMAND_PORT, udp_socket


@dataclass(frozen=True, slots=True)
class FoundServer:
    """A server that answered, and from where."""

    address: str
    info: ServerInfo


def discover(
    target: str = "255.255.255.255",
    *,
    command_port: int = DEFAULT_COMMAND_PORT,
    local_interface: str = "",
    timeout_s: float = 1.0,
) -> tuple[FoundServer, ...]:
    """Ask every server that ``target`` reaches (a broadcast address, or one host) to name itself.

    Returns:
        The servers that answered within ``timeout_s``, by address; empty for none.

    Raises:
        NotReadyError: The question cannot be sent from ``local_interface`` (empty: as the system routes it).
    """
    found: dict[str, ServerInfo] = {}
    sock = udp_socket(local_interface, 0)
    try:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        question = encode_message(MessageId.DISCOVERY, encode_connect("carlab", options=False))
        try:
            sock.sendto(question, (target, command_port))
        except OSError as error:
            raise NotReadyError(
                "No motion capture", [f"{target} cannot be asked for NatNet servers ({error}); check the network."]
            ) from error
        deadline_s = time.monotonic() + timeout_s
        while (left_s := deadline_s - time.monotonic()) > 0.0:
            if not select.select([sock], [], [], left_s)[0]:
                break
            try:
                datagram, source = sock.recvfrom(DATAGRAM_BYTES)
                message_id, payload = split_message(datagram)
                if message_id == MessageId.SERVERINFO:
                    found[source[0]] = decode_server_info(payload)
            except (ProtocolError, BlockingIOError, ConnectionError):
                continue  # somebody else's datagram, or none after all: not a server
    finally:
        sock.close()
    return tuple(FoundServer(address, info) for address, info in sorted(found.items()))
