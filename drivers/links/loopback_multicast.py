"""python-can's UDP multicast bus on the loopback interface: it needs no network, and no command leaves the host.

python-can joins the group on the default route's interface, which fails without a default route (a container without a
network) and sends every frame to the local network otherwise. Here the group is joined and sent to on 127.0.0.1.
"""

from __future__ import annotations

import socket

from can.interfaces.udp_multicast import UdpMulticastBus
from can.interfaces.udp_multicast.bus import GeneralPurposeUdpMulticastBus

from drivers.links.bus_lock import MULTICAST_PORT

LOOPBACK = "127.0.0.1"


class _LoopbackSocket(GeneralPurposeUdpMulticastBus):
    """The base class's socket on the loopback interface."""

    def _create_socket(self, address_family: socket.AddressFamily) -> socket.socket:
        timestamp_nanoseconds = 35  # SO_TIMESTAMPNS, which the base class reads back with each datagram
        sock = socket.socket(address_family, socket.SOCK_DGRAM)
        try:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            if hasattr(socket, "SO_REUSEPORT"):
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
            try:
                sock.setsockopt(socket.SOL_SOCKET, timestamp_nanoseconds, 1)
                self.timestamp_nanosecond = True
            except OSError:
                self.timestamp_nanosecond = False
            sock.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
            sock.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(LOOPBACK))
            sock.bind((self.group, self.port))
            membership = socket.inet_aton(self.group) + socket.inet_aton(LOOPBACK)
            sock.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
        except BaseException:
            sock.close()
            raise
        return sock


class LoopbackMulticastBus(UdpMulticastBus):
    """``udp_multicast`` for an IPv4 group, on loopback only; ``channel`` is GROUP or GROUP:PORT."""

    def __init__(self, channel: str) -> None:
        group, _, port = channel.partition(":")
        self._multicast = _LoopbackSocket(group, int(port or MULTICAST_PORT), hop_limit=0)
        super(UdpMulticastBus, self).__init__(channel)
