"""UDP sockets for NatNet clients and servers."""

from __future__ import annotations

import contextlib
import errno
import socket
import sys

from carlab.core.errors import NotReadyError

DEFAULT_GROUP = "239.255.42.99"
DEFAULT_COMMAND_PORT = 1510
DEFAULT_DATA_PORT = 1511
RECEIVE_BUFFER_BYTES = 1 << 20
DATAGRAM_BYTES = 65536


def not_ready(reason: str) -> NotReadyError:
    """Create the error for missing motion capture."""
    return NotReadyError("No motion capture", [reason])


def resolve(host: str, setting: str = "server_address") -> str:
    """IPv4 address of a host. Raises NotReadyError, which names ``setting``."""
    try:
        return socket.gethostbyname(host)
    except (OSError, ValueError) as error:  # ValueError: an invalid name, for example with two consecutive dots
        raise not_ready(
            f"'{host}' is no known IPv4 address or host name ({error}); check {setting} in [hardware.mocap], or the "
            "option of carlab listen."
        ) from error


def interface_towards(address: str) -> str:
    """Address of the interface that routes to ``address``. Raises NotReadyError."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((address, 9))
        except OSError as error:
            raise not_ready(f"there is no route to {address} ({error}); check cable and address.") from error
        return str(probe.getsockname()[0])


def udp_socket(address: str, port: int, *, shared: bool = False) -> socket.socket:
    """Create a bound, non-blocking UDP socket with a large receive buffer. Raises NotReadyError."""
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        if shared:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        sock.bind((address, port))
        sock.setblocking(False)
    except OSError as error:
        sock.close()
        place = f"{address or 'any interface'}:{port}"
        remedy = {
            errno.EADDRINUSE: "close the program that uses it, or set another port ([hardware.mocap], --command-port).",
            errno.EADDRNOTAVAIL: "no interface of this computer has that address: "
            "check local_interface (listen: --interface).",
        }.get(error.errno or 0, "choose another address or port.")
        raise not_ready(f"UDP {place} cannot be used ({error.strerror}); {remedy}") from error
    return sock


def multicast_receiver(group: str, port: int, interface: str) -> socket.socket:
    """Create a socket that receives datagrams to ``group:port`` at ``interface``. Raises NotReadyError."""
    # On Linux a socket bound to the group receives nothing else; Windows cannot bind to a group.
    sock = udp_socket("" if sys.platform == "win32" else group, port, shared=True)
    try:
        join_group(sock, group, interface)
    except OSError as error:
        sock.close()
        raise not_ready(
            f"group {group} cannot be joined on interface {interface} ({error}); "
            "check local_interface (listen: --interface)."
        ) from error
    return sock


def join_group(sock: socket.socket, group: str, interface: str) -> None:
    """Receive datagrams to ``group`` at ``interface``. Raises OSError."""
    membership = socket.inet_aton(group) + socket.inet_aton(interface)
    sock.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)


def join_group_again(sock: socket.socket, group: str, interface: str) -> None:
    """Join after the network adapter was removed, which ends the membership; without effect for a member."""
    with contextlib.suppress(OSError):  # a member, or the adapter is still missing
        join_group(sock, group, interface)
