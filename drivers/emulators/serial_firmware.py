"""A fake VESC on a pseudo-terminal: a host opens its port like that of a real one.

Run as ``python -m drivers.emulators.serial_firmware --link PATH --log FILE`` for one in a process of its own; it says
its port on standard output and leaves when standard input ends.
"""

from __future__ import annotations

import argparse
import errno
import os
import select
import sys
import threading
import time
import tty
from collections import deque
from pathlib import Path
from typing import Self

from drivers.emulators.command_log import CommandLog
from drivers.emulators.faults import WireFaults
from drivers.emulators.vesc_firmware import VescFirmware
from drivers.vesc.serial_codec import VescFrameDecoder, encode_frame

POLL_S = 0.005
BITS_A_BYTE = 10


class SerialFirmware:
    """Puts a ``VescFirmware`` behind a pseudo-terminal, served by one thread between ``open`` and ``close``.

    Args:
        firmware: The firmware; its callbacks run in the serving thread.
        link: Where to put a symbolic link to the terminal, so that the port keeps its name after ``replug``.
        baud: Pace bytes like a line of that speed (8N1); None for no pacing, as on USB.
        faults: Switches for a bad wire.

    A host may come, go and come back. The decoder is the firmware's: one-byte resynchronisation, no time-out.
    """

    def __init__(
        self,
        firmware: VescFirmware,
        *,
        link: Path | None = None,
        baud: int | None = None,
        faults: WireFaults | None = None,
    ) -> None:
        self.firmware = firmware
        self.log = firmware.log
        self.link = link
        self.baud = baud
        self.faults = WireFaults() if faults is None else faults
        self.decoder = VescFrameDecoder(inter_byte_timeout_s=None)
        self._lock = threading.Lock()
        self._master: int | None = None
        self._terminal = ""
        self._thread: threading.Thread | None = None
        self._stop = threading.Event()
        self._is_host_there = False
        self._has_heard = False
        self._arriving: deque[tuple[float, bytes]] = deque()
        self._leaving: deque[tuple[float, bytes]] = deque()
        self._t_line_in_s = self._t_line_out_s = 0.0

    @property
    def port(self) -> str:
        """Path that a host opens."""
        return str(self.link) if self.link is not None else self._terminal

    def open(self) -> None:
        """Create the terminal and start to serve. Idempotent."""
        if self._thread is not None:
            return
        self.log.open()
        self.replug()
        self._stop.clear()
        self._thread = threading.Thread(target=self._serve, name="serial-firmware", daemon=True)
        self._thread.start()

    def unplug(self) -> None:
        """Pull the plug: the terminal vanishes under the host. The firmware goes on and times out."""
        with self._lock:
            if self._master is None:
                return
            os.close(self._master)
            self._master = None
            self._is_host_there = False
            self.log.add(time.monotonic(), "unplug")
            if self.link is not None:
                self.link.unlink(missing_ok=True)

    def replug(self) -> None:
        """Plug in (again): a new terminal, under the old name where ``link`` was given."""
        with self._lock:
            if self._master is not None:
                return
            master, slave = os.openpty()
            tty.setraw(slave)
            self._terminal = os.ttyname(slave)
            os.close(slave)
            os.set_blocking(master, False)
            if self.link is not None:
                self.link.unlink(missing_ok=True)
                self.link.symlink_to(self._terminal)
            self.decoder.clear()
            self._arriving.clear()
            self._leaving.clear()
            self._has_heard = False
            self._master = master
            self.log.add(time.monotonic(), "replug" if self._thread is not None else "open")

    def close(self) -> None:
        """Stop serving and remove the terminal. Idempotent."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        with self._lock:
            if self._master is not None:
                os.close(self._master)
                self._master = None
            if self.link is not None and self.link.is_symlink():
                self.link.unlink()
        self.log.close()

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.close()

    def say(self, data: bytes) -> None:
        """Put raw bytes on the line to the host, garbage for example."""
        with self._lock:
            self._send(data, time.monotonic())

    def _serve(self) -> None:
        while not self._stop.is_set():
            with self._lock:
                now_s = time.monotonic()
                wait_s = self._work(now_s)
                master = self._master
                watched = [master] if master is not None and self._is_host_there and not self.faults.is_deaf else []
            if wait_s > 0.0:
                try:
                    select.select(watched, [], [], wait_s)
                except (OSError, ValueError):
                    self._stop.wait(POLL_S)  # the plug was pulled while waiting

    def _work(self, now_s: float) -> float:
        """Do what is due and return how long to wait [s]."""
        if self._master is not None and not self.faults.is_deaf:
            self._hear(self._master, now_s)
        while self._arriving and self._arriving[0][0] <= now_s:
            t_s, data = self._arriving.popleft()
            for payload in self.decoder.feed(data, t_s):
                self._obey(payload, t_s)
        while self._leaving and self._leaving[0][0] <= now_s:
            self._put(self._leaving.popleft()[1])
        self.firmware.poll(now_s)
        due = [queue[0][0] - now_s for queue in (self._arriving, self._leaving) if queue]
        return max(0.0, min([POLL_S, *due]))

    def _hear(self, master: int, now_s: float) -> None:
        try:
            data = os.read(master, 4096)
        except BlockingIOError:
            self._is_host_there = True
            return
        except OSError as error:
            if error.errno != errno.EIO:
                raise
            if self._is_host_there:
                self._is_host_there = False
                self.log.add(now_s, "hang_up")
                self.decoder.clear()
            return
        self._is_host_there = True
        if data and not self._has_heard:
            self._has_heard = True
            self.log.add(now_s, "first_byte", float(data[0]))
        self._t_line_in_s = max(now_s, self._t_line_in_s) + self._wire_s(len(data))
        self._arriving.append((self._t_line_in_s, data))

    def _obey(self, payload: bytes, t_s: float) -> None:
        frame = self.faults.pass_on(payload)
        reply = self.firmware.handle(frame, t_s) if frame == payload else None  # a flipped bit fails the CRC
        if reply is not None and not self.faults.is_silent:
            self._send(self.faults.pass_on(encode_frame(reply)), t_s)

    def _send(self, data: bytes, t_s: float) -> None:
        self._t_line_out_s = max(t_s + self.faults.reply_delay_s, self._t_line_out_s) + self._wire_s(len(data))
        self._leaving.append((self._t_line_out_s, data))

    def _put(self, data: bytes) -> None:
        if self._master is None or not self._is_host_there:
            return
        try:
            os.write(self._master, data)
        except OSError as error:
            if error.errno not in (errno.EIO, errno.EAGAIN):  # nobody there, or nobody reads: lost, as on a real line
                raise

    def _wire_s(self, count: int) -> float:
        return 0.0 if self.baud is None else count * BITS_A_BYTE / self.baud


def main() -> int:
    """Serve until standard input ends."""
    parser = argparse.ArgumentParser(description="Fake VESC on a pseudo-terminal.")
    parser.add_argument("--link", type=Path, help="symbolic link to the terminal")
    parser.add_argument("--log", type=Path, help="JSON lines of what was heard and done")
    parser.add_argument("--motor-timeout", type=float, default=1.0, help="motor time-out [s]")
    parser.add_argument("--baud", type=int, help="pace bytes like a line of this speed")
    options = parser.parse_args()
    firmware = VescFirmware(CommandLog(options.log), motor_timeout_s=options.motor_timeout)
    with SerialFirmware(firmware, link=options.link, baud=options.baud) as served:
        sys.stdout.write(served.port + "\n")
        sys.stdout.flush()
        sys.stdin.buffer.read()
    return 0


if __name__ == "__main__":
    sys.exit(main())
