"""A CAN bus as a frame link (any interface of python-can)."""

from __future__ import annotations

import contextlib
import errno
import ipaddress
import select
from pathlib import Path
from typing import Final

import can

from carlab.core.errors import ActuatorFaultError, NotReadyError
from drivers.links.bus_lock import BusLock, IdUse
from drivers.links.link import CanFrame

BUS_OFF: Final = 0x40
"""Bit of a Linux CAN error frame's identifier (CAN_ERR_BUSOFF)."""
CONTROLLER_PROBLEM: Final = 0x04
"""Bit of a Linux CAN error frame's identifier (CAN_ERR_CRTL); the second byte of its data has the details."""
SENDS_ERROR_PASSIVE: Final = 0x20
"""Detail: error-passive, since frames were repeated without acknowledgement (CAN_ERR_CRTL_TX_PASSIVE)."""
MAX_FRAMES_PER_READ: Final = 256


def open_bus(interface: str, channel: str, bitrate: int) -> can.BusABC:
    """Open a python-can bus without reading the user's python-can configuration files.

    Interfaces whose bitrate the system sets (socketcan) ignore ``bitrate``. The channel of ``gs_usb`` is a number.
    ``udp_multicast`` with an IPv4 group stays on this host's loopback interface; its channel is GROUP or GROUP:PORT.
    Raises NotReadyError if the channel of ``gs_usb`` is not a number.
    """
    if interface == "udp_multicast" and _is_ipv4(channel):
        from drivers.links.loopback_multicast import LoopbackMulticastBus

        return LoopbackMulticastBus(channel)
    if interface == "gs_usb" and not channel.isdecimal():
        raise NotReadyError(
            f"CAN bus gs_usb {channel} cannot be opened",
            ('the channel of gs_usb is the number of the adapter, such as "0".',),
        )
    adapter = int(channel) if interface == "gs_usb" else channel
    return can.Bus(adapter, interface=interface, ignore_config=True, bitrate=bitrate)


def _is_ipv4(channel: str) -> bool:
    try:
        ipaddress.IPv4Address(channel.partition(":")[0])
    except ValueError:
        return False
    return True


class CanLink:
    """Frame link on a CAN bus: a frame is sent at once or an ActuatorFaultError is raised.

    A frame that the controller cannot send now must not be sent later. Each send has a time-out of zero; after an
    error the device closes the link, which drops the frames in the adapter's queue, and opens it again. The queue of
    socketcan belongs to the network interface: no program can drop its frames, and the kernel sends them when a cut bus
    returns. There an error-passive controller, which shows a cut bus within milliseconds, is a failure of the bus: the
    queue still has room for neutral behind the few moving commands. An interface of python-can raises the errors of its
    own library too; each of them is a failure of the bus.

    With a ``controller_id`` and a ``host_id``, the open link holds the locks on them (``drivers.links.bus_lock``).
    """

    def __init__(
        self,
        interface: str,
        channel: str,
        bitrate: int = 500_000,
        controller_id: int | None = None,
        host_id: int | None = None,
    ) -> None:
        self.interface = interface
        self.channel = channel
        self.bitrate = bitrate
        self.opens = 0
        self._bus: can.BusABC | None = None
        self._descriptor: int | None = None
        self._locks = [
            BusLock(interface, channel, can_id, IdUse.HOST if can_id == host_id else IdUse.CONTROLLER)
            for can_id in (controller_id, host_id)
            if can_id is not None
        ]

    def open(self) -> None:
        """Lock the ids and open the bus. Raises NotReadyError with the remedy."""
        if self._bus is not None:
            return
        try:
            for lock in self._locks:
                lock.acquire()
            self._bus = self._open_bus()
        except NotReadyError:
            self._unlock()
            raise
        except Exception as error:
            self._unlock()
            raise NotReadyError(
                f"CAN bus {self.interface} {self.channel} cannot be opened", (self._reason(error),)
            ) from error
        try:
            self._descriptor = self._bus.fileno()
        except NotImplementedError:
            self._descriptor = None
        if self._descriptor is not None and self._descriptor < 0:
            self._descriptor = None
        self.opens += 1

    def write(self, frame: CanFrame) -> None:
        """Send a data frame with a 29-bit identifier. Raises ActuatorFaultError if the bus does not accept it."""
        message = can.Message(arbitration_id=frame.identifier, data=frame.data, is_extended_id=True)
        bus = self._opened()
        try:
            bus.send(message, timeout=0)
        except Exception as error:
            self._flush()
            raise self._failed(error) from error

    def read(self) -> list[CanFrame]:
        """Frames of others that have arrived. Raises ActuatorFaultError on bus-off or a lost adapter."""
        bus = self._opened()
        frames: list[CanFrame] = []
        for _ in range(MAX_FRAMES_PER_READ):
            try:
                message = bus.recv(0) if self._has_input() else None
            except Exception as error:
                raise self._failed(error) from error
            if message is None:
                break
            if message.is_error_frame:
                if message.arbitration_id & BUS_OFF:
                    self._flush()
                    raise self._failed("the controller went bus-off")
                if self._is_cut(message):
                    raise self._failed("no device acknowledges frames of this bitrate: the controller is error-passive")
            elif message.is_extended_id and not message.is_remote_frame and not self._is_echo(message):
                frames.append(CanFrame(message.arbitration_id, bytes(message.data)))
        return frames

    def fileno(self) -> int | None:
        """File descriptor of the bus, or None if its interface has none."""
        return self._descriptor

    def close(self) -> None:
        """Shut the bus down, drop unsent frames, and release the ids."""
        bus, self._bus, self._descriptor = self._bus, None, None
        try:
            if bus is not None:
                with contextlib.suppress(Exception):  # the adapter was removed
                    bus.shutdown()
        finally:
            self._unlock()

    def _unlock(self) -> None:
        for lock in self._locks:
            lock.release()

    def _open_bus(self) -> can.BusABC:
        return open_bus(self.interface, self.channel, self.bitrate)

    def _opened(self) -> can.BusABC:
        if self._bus is None:
            raise ActuatorFaultError(f"CAN bus {self.interface} {self.channel} is not open; open the car first.")
        return self._bus

    def _is_echo(self, message: can.Message) -> bool:
        """Whether an adapter such as gs_usb returns a frame of this link.

        socketcan returns none, but marks the frames of other programs on this computer in the same way.
        """
        return not message.is_rx and self.interface != "socketcan"

    def _is_cut(self, error: can.Message) -> bool:
        """Whether an error frame of socketcan reports that the controller has become error-passive by sending."""
        is_of_controller = self.interface == "socketcan" and error.arbitration_id & CONTROLLER_PROBLEM
        return bool(is_of_controller and len(error.data) > 1 and error.data[1] & SENDS_ERROR_PASSIVE)

    def _has_input(self) -> bool:
        """Whether ``recv`` returns at once: without input it waits as long as a backward step of the system clock."""
        return self._descriptor is None or bool(select.select([self._descriptor], [], [], 0.0)[0])

    def _flush(self) -> None:
        if self._bus is None:
            return
        with contextlib.suppress(Exception):  # no queue, or the adapter was removed
            self._bus.flush_tx_buffer()

    def _failed(self, error: object) -> ActuatorFaultError:
        remedy = "check wiring, termination and power"
        codes = (getattr(error, "errno", None), getattr(error, "error_code", None))
        if self.interface == "socketcan" and errno.ENETDOWN in codes:  # a socket can be bound to it while it is down
            remedy = f"bring it up with {self._command_up}"
        return ActuatorFaultError(
            f"CAN bus {self.interface} {self.channel} failed ({error}); {remedy}, then reset the fault."
        )

    @property
    def _command_up(self) -> str:
        return f"'ip link set {self.channel} up type can bitrate {self.bitrate} restart-ms 100'"

    def _reason(self, error: BaseException) -> str:
        cause = error.__cause__ or error
        if self.interface == "socketcan":
            found = sorted(path.name for path in Path("/sys/class/net").glob("*can*"))
            there = f"the available CAN interfaces are {', '.join(found)}" if found else "there is no CAN interface"
            return f"{cause}; {there}. Bring it up with {self._command_up} and set 'channel' in [hardware.actuator]."
        return f"{cause}. Check 'interface' and 'channel' in [hardware.actuator], and the driver of the adapter."
