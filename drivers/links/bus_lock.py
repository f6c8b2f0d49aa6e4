"""An exclusive lock on one id of a bus: two programs cannot command, or emulate, one motor controller.

A CAN bus accepts any number of senders. Two programs that send to one motor controller alternate between the commands
of both, and neither can see it. The frames of replies to one host id mix, and so do those of two emulated controllers
with one id. The lock is a Unix socket with an abstract name (unix(7)): it excludes programs of all users of the
computer, needs no file, and the kernel releases it when its process ends for any reason.
"""

from __future__ import annotations

import enum
import errno
import hashlib
import os
import socket
import struct
from pathlib import Path

from carlab.core.errors import NotReadyError

MAX_QUESTIONS = 4096
"""Number of programs that can ask for the holder; further ones do not learn its process."""

MULTICAST_PORT = 43113
"""UDP port of a ``udp_multicast`` bus whose channel has none (python-can's default)."""


class IdUse(enum.Enum):
    """Use of an id: the value is its name in messages, then the cause and the remedy with ``{}`` for the holder."""

    CONTROLLER = ("Controller", "another program drives it ({}); end that program first.")
    HOST = ("Host id", "another program uses it ({}); set another host_id in [hardware.actuator].")
    EMULATOR = ("Emulated controller", "another program emulates it ({}); end that program or choose another channel.")


class BusLock:
    """Lock on an id at the bus ``interface`` ``channel``: of a controller, of this program or of an emulator.

    Constructing does nothing. An emulated controller and the program that drives it have one id, so their locks do not
    exclude each other.

    Two objects exclude each other, in one process too. A ``virtual`` bus exists within one process, and so does its
    lock.
    """

    def __init__(self, interface: str, channel: str, can_id: int, use: IdUse = IdUse.CONTROLLER) -> None:
        name, self._remedy = use.value
        self.what = f"{name} {can_id} on CAN bus {interface} {channel}"
        bus = os.path.realpath(channel) if channel.startswith("/") else channel
        if interface == "udp_multicast" and ":" not in channel:
            bus = f"{channel}:{MULTICAST_PORT}"
        process = os.getpid() if interface == "virtual" else 0
        side = "\0emulator" if use is IdUse.EMULATOR else ""
        key = hashlib.sha256(f"{interface}\0{bus}\0{can_id}\0{process}{side}".encode()).hexdigest()[:24]
        self._address = f"\0carlab-bus-{key}"
        self._socket: socket.socket | None = None

    def acquire(self) -> None:
        """Take the lock; idempotent. Raises NotReadyError if another program has it, without waiting."""
        if self._socket is not None:
            return
        own = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            own.bind(self._address)
            own.listen(MAX_QUESTIONS)
        except OSError as error:
            own.close()
            if error.errno == errno.EADDRINUSE:
                raise NotReadyError(f"{self.what} is in use", (self._remedy.format(self._holder()),)) from error
            remedy = f"the system does not allow its lock, a Unix socket ({error.strerror}); allow it."
            raise NotReadyError(f"{self.what} cannot be locked", (remedy,)) from error
        self._socket = own

    def release(self) -> None:
        """Release the lock. Idempotent."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _holder(self) -> str:
        """Process that holds the lock, and its parent, for messages."""
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as asking:
            asking.setblocking(False)
            try:
                asking.connect(self._address)
                credentials = asking.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
                process = struct.unpack("3i", credentials)[0]
                parent = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[1]
            except OSError:
                return "its process is unknown"
        return f"process {process}, started by process {parent}"
