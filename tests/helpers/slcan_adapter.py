"""An emulated slcan adapter: a pseudo-terminal in front of a ``virtual`` CAN bus of python-can."""

from __future__ import annotations

import os
import select
import threading
import tty
from pathlib import Path
from typing import Self

import can


class SlcanAdapter:
    """It forwards frames in both directions and acknowledges each line, like the firmware of such adapters.

    As there, frames of the bus arrive at the host between the commands ``O`` and ``C``.

    ``link`` is a symbolic link to the port, so that the port has the same name after ``plug``.
    """

    def __init__(self, channel: str, link: Path | None = None) -> None:
        self.reads = True
        self.lines: list[bytes] = []
        self._channel = channel
        self._link = link
        self._terminal: int | None = None

    @property
    def port(self) -> str:
        """Path that a host opens."""
        return self._name if self._link is None else str(self._link)

    def send(self, data: bytes) -> None:
        """Send raw bytes to the host."""
        os.write(self._master, data)

    def plug(self) -> None:
        """Create the port and start the adapter."""
        self._bus = can.Bus(self._channel, interface="virtual", ignore_config=True)
        self._master, self._terminal = os.openpty()
        tty.setraw(self._terminal)
        self._name = os.ttyname(self._terminal)
        if self._link is not None:
            self._link.symlink_to(self._name)
        self._stop = threading.Event()
        self._is_on_the_bus = False
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def unplug(self) -> None:
        """End the adapter and remove its port."""
        if self._terminal is None:
            return
        self._stop.set()
        self._thread.join()
        os.close(self._master)
        os.close(self._terminal)
        self._terminal = None
        if self._link is not None:
            self._link.unlink()
        self._bus.shutdown()

    def __enter__(self) -> Self:
        self.plug()
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.unplug()

    def _serve(self) -> None:
        pending = b""
        while not self._stop.is_set():
            if self.reads and select.select([self._master], [], [], 0.002)[0]:
                *lines, pending = (pending + os.read(self._master, 4096)).split(b"\r")
                for line in lines:
                    self._execute(line)
            wait_s = 0.001
            while (message := self._bus.recv(wait_s)) is not None:  # all of them: a busy machine loops rarely
                wait_s = 0.0
                if self._is_on_the_bus:
                    self.send(f"T{message.arbitration_id:08X}{message.dlc}{message.data.hex().upper()}\r".encode())

    def _execute(self, line: bytes) -> None:
        self.lines.append(line)
        if line in (b"O", b"C"):
            self._is_on_the_bus = line == b"O"
        if line.startswith(b"T"):
            data = bytes.fromhex(line[10:].decode())
            self._bus.send(can.Message(arbitration_id=int(line[1:9], 16), data=data, is_extended_id=True))
            self.send(b"Z\r")
        else:
            self.send(b"\r")
