"""A CAN bus that can be cut, with the kernel's transmit queue, which outlives the socket that filled it."""

from __future__ import annotations

import errno

import can
from can.interfaces.virtual import VirtualBus

from drivers.links.can_link import CanLink

CAPACITY = 11
"""Frames that wait for the bus: ten in the queue of the network interface (its default), one in the controller."""
ERROR_PASSIVE = can.Message(arbitration_id=0x04, is_error_frame=True, data=bytes((0, 0x20, 0, 0, 0, 0, 0, 0)))
"""The kernel's report that the controller is error-passive: it repeats a frame that no device acknowledges."""


class Wire:
    """State of the bus and the transmit queue."""

    def __init__(self) -> None:
        self.is_cut = False
        self.waiting: list[can.Message] = []

    def mend(self, channel: str) -> None:
        """Connect the wire again: the waiting frames are sent, the oldest first."""
        self.is_cut = False
        bus = VirtualBus(channel=channel)
        for message in self.waiting:
            bus.send(message)
        self.waiting.clear()
        bus.shutdown()


class CutBus(VirtualBus):
    """A bus over a ``Wire``."""

    wire: Wire
    errors: list[can.Message]

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        if not self.wire.is_cut:
            super().send(msg, timeout)
            return
        if len(self.wire.waiting) >= CAPACITY:
            raise can.CanOperationError("Failed to transmit: no buffer space available", errno.ENOBUFS)
        if not self.wire.waiting:
            self.errors.append(ERROR_PASSIVE)
        self.wire.waiting.append(msg)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        if self.errors:
            return self.errors.pop()
        return None if self.wire.is_cut else super().recv(timeout)


class CutLink(CanLink):
    """A link with socketcan's rules on a ``CutBus``."""

    def __init__(self, channel: str, wire: Wire) -> None:
        super().__init__("socketcan", channel)
        self.wire = wire

    def _open_bus(self) -> can.BusABC:
        bus = CutBus(channel=self.channel)
        bus.wire, bus.errors = self.wire, []
        return bus
