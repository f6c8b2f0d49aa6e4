"""An exclusive lock on one motor controller of a bus, so that two programs cannot command it.

A CAN bus accepts any number of senders. Two programs that send to one motor controller alternate between the commands
of both, and neither can see it. The lock is a file in the folder for temporary files, locked by ``flock``: it also
excludes programs of other users with the same folder, and the kernel releases it when its process ends for any reason.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import stat
import tempfile
from pathlib import Path

from carlab.core.errors import NotReadyError

MAX_ATTEMPTS = 100
"""Number of attempts to lock a file that its holder removes at the same time."""
MAX_HOLDER_BYTES = 100


class BusLock:
    """Lock on ``controller_id`` at the bus ``interface`` ``channel``. Constructing does nothing.

    Two objects exclude each other, in one process too. A ``virtual`` bus exists within one process, and so does its
    lock.
    """

    def __init__(self, interface: str, channel: str, controller_id: int) -> None:
        self.what = f"Controller {controller_id} on CAN bus {interface} {channel}"
        bus = os.path.realpath(channel) if channel.startswith("/") else channel
        process = os.getpid() if interface == "virtual" else 0
        key = hashlib.sha256(f"{interface}\0{bus}\0{controller_id}\0{process}".encode()).hexdigest()[:24]
        self.path = Path(tempfile.gettempdir()) / f"carlab-bus-{key}.lock"
        self._descriptor: int | None = None

    def acquire(self) -> None:
        """Take the lock; idempotent. Raises NotReadyError if another program has it, without waiting."""
        if self._descriptor is not None:
            return
        for _ in range(MAX_ATTEMPTS):
            descriptor = self._open()
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                holder = os.pread(descriptor, MAX_HOLDER_BYTES, 0).decode("ascii", "replace")
                os.close(descriptor)
                raise NotReadyError(
                    f"{self.what} is in use",
                    (f"another program drives it ({holder or 'its process is unknown'}); end that program first.",),
                ) from error
            if self._is_current(descriptor):
                self._descriptor = descriptor
                with contextlib.suppress(OSError):  # the file system is full: the holder has no name in messages
                    os.ftruncate(descriptor, 0)
                    os.pwrite(descriptor, f"process {os.getpid()}, started by process {os.getppid()}".encode(), 0)
                return
            os.close(descriptor)
        raise NotReadyError(f"{self.what} is in use", ("other programs open and close it all the time; end them.",))

    def release(self) -> None:
        """Release the lock and remove its file. Idempotent."""
        descriptor, self._descriptor = self._descriptor, None
        if descriptor is None:
            return
        if self._is_current(descriptor):
            with contextlib.suppress(OSError):  # the file of another user
                self.path.unlink()
        os.close(descriptor)

    def _open(self) -> int:
        """Open the file, or create it for all users. Raises NotReadyError if that is impossible."""
        flags = os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
        try:
            try:
                descriptor = os.open(self.path, flags | os.O_CREAT | os.O_EXCL, 0o666)
                os.fchmod(descriptor, 0o666)
            except FileExistsError:
                descriptor = os.open(self.path, flags)
        except FileNotFoundError:
            if self.path.parent.is_dir():  # its holder has removed it in between
                return self._open()
            raise self._impossible("the folder does not exist") from None
        except OSError as error:
            raise self._impossible(str(error.strerror)) from error
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            os.close(descriptor)
            raise self._impossible("it is no regular file")
        return descriptor

    def _is_current(self, descriptor: int) -> bool:
        """Whether the locked file still has its name; its former holder may have removed it."""
        try:
            return os.path.samestat(os.fstat(descriptor), self.path.stat())
        except FileNotFoundError:
            return False

    def _impossible(self, reason: str) -> NotReadyError:
        return NotReadyError(
            f"{self.what} cannot be locked",
            (f"the lock file {self.path} cannot be opened ({reason}); make the file or its folder writable.",),
        )
