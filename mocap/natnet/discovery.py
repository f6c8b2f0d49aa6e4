"""Discovery of the NatNet servers on the network."""

from __future__ import annotations

import select
import socket
import time
from dataclasses import dataclass

from carlab.core.errors import NotReadyError, ProtocolError
from mocap.natnet.codec import MessageId, ServerInfo, decode_server_info, encode_connect, encode_message, split_message
from mocap.natnet.sockets import DATAGRAM_BYTES, DEFAULT_COMMAND_PORT, udp_socket


@dataclass(frozen=True, slots=True)
class DiscoveredServer:
    """A server that answered, with its address."""

    address: str
    info: ServerInfo


def discover(
    target: str = "255.255.255.255",
    *,
    command_port: int = DEFAULT_COMMAND_PORT,
    local_interface: str = "",
    timeout_s: float = 1.0,
) -> tuple[DiscoveredServer, ...]:
    """Request server information from every server at ``target`` (a broadcast address, or one host).

    Returns:
        The servers that answered within ``timeout_s``, sorted by address; may be empty.

    Raises:
        NotReadyError: The request cannot be sent from ``local_interface`` (empty: the system's route).
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
                "No motion capture",
                [f"the request cannot be sent to {target} ({error}); check the network."],
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
                continue  # another program's datagram, or a spurious wake-up
    finally:
        sock.close()
    return tuple(DiscoveredServer(address, info) for address, info in sorted(found.items()))
