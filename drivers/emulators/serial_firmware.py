"""An emulated VESC on a pseudo-terminal: a host opens its port like that of a real VESC.

``python -m drivers.emulators.serial_firmware --link PATH`` runs it in a separate process, which prints its port on
standard output and ends when standard input ends.
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

from carlab.core.errors import NotReadyError
from carlab.core.resource import Resource
from drivers.emulators.command_log import CommandLog
from drivers.emulators.faults import WireFaults
from drivers.emulators.vesc_firmware import VescFirmware
from drivers.links.lines import BITS_PER_BYTE
from drivers.vesc.serial_codec import VescFrameDecoder, encode_frame

POLL_S = 0.005


class SerialFirmware(Resource):
    """A ``VescFirmware`` behind a pseudo-terminal; one thread serves it between ``open`` and ``close``.

    Args:
        firmware: The firmware; its callbacks run in the serving thread.
        link: Path of a symbolic link to the terminal, so that the port keeps its name after ``replug``.
        baud: Line speed (8N1) at which bytes are paced; None for no pacing, as on USB.
        faults: Faults of the wire.

    Hosts may connect repeatedly. The decoder works like the firmware's: one-byte resynchronisation, no time-out.
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
        self.decoder = VescFrameDecoder(frame_timeout_s=None)
        self._lock = threading.Lock()
        self._master: int | None = None
        self._terminal = ""
        self._unplugged: list[int] = []
        self._thread: threading.Thread | None = None
        self._stop = threading.Event()
        self._has_host = False
        self._has_received = False
        self._received: deque[tuple[float, bytes]] = deque()
        self._outgoing: deque[tuple[float, bytes]] = deque()
        self._t_line_in_s = self._t_line_out_s = 0.0

    @property
    def port(self) -> str:
        """Path that a host opens."""
        return str(self.link) if self.link is not None else self._terminal

    def open(self) -> None:
        """Create the terminal and start serving. Idempotent. Raises NotReadyError if the link cannot be made."""
        if self._thread is not None:
            return
        self.log.open()
        self.replug()
        self._stop.clear()
        self._thread = threading.Thread(target=self._serve, name="serial-firmware", daemon=True)
        self._thread.start()

    def unplug(self) -> None:
        """Remove the terminal, as an unplugged cable does. The firmware keeps running and times out.

        Until ``close`` no other terminal gets its name; a host that reconnects would find the device of another car.
        """
        with self._lock:
            if self._master is None:
                return
            # The system would give the name of a terminal that no process has open to the next one.
            self._unplugged.append(os.open(self._terminal, os.O_RDWR | os.O_NOCTTY))
            os.close(self._master)
            self._master = None
            self._has_host = False
            self.log.add(time.monotonic(), "unplug")
            if self.link is not None:
                self.link.unlink(missing_ok=True)

    def replug(self) -> None:
        """Create a new terminal, under the old name if ``link`` was given."""
        with self._lock:
            if self._master is not None:
                return
            master, slave = os.openpty()
            tty.setraw(slave)
            self._terminal = os.ttyname(slave)
            os.close(slave)
            os.set_blocking(master, False)
            if self.link is not None:
                try:
                    self.link.unlink(missing_ok=True)
                    self.link.symlink_to(self._terminal)
                except OSError as error:
                    os.close(master)
                    remedy = f"{error.strerror}; choose a folder in which you may write."
                    raise NotReadyError(f"The link {self.link} to the serial port cannot be made", (remedy,)) from error
            self.decoder.clear()
            self._received.clear()
            self._outgoing.clear()
            self._has_received = False
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
            while self._unplugged:
                os.close(self._unplugged.pop())
            if self.link is not None and self.link.is_symlink():
                self.link.unlink()
        self.log.close()

    def send_raw(self, data: bytes) -> None:
        """Send raw bytes to the host, for example garbage."""
        with self._lock:
            self._send(data, time.monotonic())

    def _serve(self) -> None:
        while not self._stop.is_set():
            with self._lock:
                now_s = time.monotonic()
                wait_s = self._step(now_s)
                master = self._master
                watched = [master] if master is not None and self._has_host and not self.faults.stops_reading else []
            if wait_s > 0.0:
                try:
                    select.select(watched, [], [], wait_s)
                except (OSError, ValueError):
                    self._stop.wait(POLL_S)  # the terminal was removed while waiting

    def _step(self, now_s: float) -> float:
        """Process received and outgoing bytes that are due; return the time to wait [s]."""
        if self._master is not None and not self.faults.stops_reading:
            self._read(self._master)
        while self._received and self._received[0][0] <= now_s:
            t_s, data = self._received.popleft()
            for payload in self.decoder.feed(data, t_s):
                self._handle_payload(payload, t_s)
        while self._outgoing and self._outgoing[0][0] <= now_s:
            self._write(self._outgoing.popleft()[1])
        self.firmware.poll(now_s)
        due = [queue[0][0] - now_s for queue in (self._received, self._outgoing) if queue]
        return max(0.0, min([POLL_S, *due]))

    def _read(self, master: int) -> None:
        try:
            data = os.read(master, 4096)
        except BlockingIOError:
            self._has_host = True
            return
        except OSError as error:
            if error.errno != errno.EIO:
                raise
            if self._has_host:
                self._has_host = False
                self.log.add(time.monotonic(), "hang_up")
                self.decoder.clear()
            return
        now_s = time.monotonic()  # read after the data, so that it is later than their write
        self._has_host = True
        if data and not self._has_received:
            self._has_received = True
            self.log.add(now_s, "first_byte", float(data[0]))
        self._t_line_in_s = max(now_s, self._t_line_in_s) + self._wire_s(len(data))
        self._received.append((self._t_line_in_s, data))

    def _handle_payload(self, payload: bytes, t_s: float) -> None:
        frame = self.faults.transmit(payload)
        reply = self.firmware.handle(frame, t_s) if frame == payload else None  # a flipped bit fails the CRC
        if reply is not None and not self.faults.drops_replies:
            self._send(self.faults.transmit(encode_frame(reply)), t_s)

    def _send(self, data: bytes, t_s: float) -> None:
        self._t_line_out_s = max(t_s, self._t_line_out_s) + self._wire_s(len(data))
        self._outgoing.append((self._t_line_out_s, data))

    def _write(self, data: bytes) -> None:
        if self._master is None or not self._has_host:
            return
        try:
            os.write(self._master, data)
        except OSError as error:
            if error.errno not in (errno.EIO, errno.EAGAIN):  # no host, or it does not read: lost, as on a line
                raise

    def _wire_s(self, count: int) -> float:
        return 0.0 if self.baud is None else count * BITS_PER_BYTE / self.baud


def main() -> int:
    """Serve until standard input ends."""
    parser = argparse.ArgumentParser(description="Emulated VESC on a pseudo-terminal.")
    parser.add_argument("--link", type=Path, help="symbolic link to the terminal")
    with SerialFirmware(VescFirmware(CommandLog()), link=parser.parse_args().link) as served:
        sys.stdout.write(served.port + "\n")
        sys.stdout.flush()
        sys.stdin.buffer.read()
    return 0


if __name__ == "__main__":
    sys.exit(main())
