"""The sender in a separate process and session; newest-value slots carry orders and statuses.

It is started as ``python -m drivers.sender.process`` and not by ``multiprocessing``: the main program is not imported
again, no shared name can leak, and a terminal's ^C does not reach it. It ignores SIGINT, SIGTERM and SIGHUP. It ends
on request, or when the main process has ended, and always after at least three neutral frames over at least 120 ms.
"""

from __future__ import annotations

import contextlib
import dataclasses
import gc
import json
import math
import os
import signal
import socket
import subprocess
import sys
import threading
from abc import ABC, abstractmethod
from pathlib import Path

from carlab.core.tables import from_table
from drivers.calibration import ActuatorCalibration
from drivers.config import ActuatorConfig
from drivers.device import Device
from drivers.device_kinds import DEVICE_KINDS, DeviceKind
from drivers.sender.logic import ORDER_SIZE, Order
from drivers.sender.loop import SenderLoop
from drivers.sender.slots import Slot, anonymous_file
from drivers.sender.status import STATUS_SIZE, SenderStatus

REALTIME_PRIORITY = 20
MAX_ERROR_CHARACTERS = 300
"""Largest part of the last line of the sender's error output in a message."""


class Sender(ABC):
    """A started sender, on the side of the main process: its slots and wake line, and how to end it."""

    def __init__(self) -> None:
        self.orders = Slot.create(ORDER_SIZE)
        self.statuses = Slot.create(STATUS_SIZE)
        self.wake, self.sender_wake = socket.socketpair()
        self.wake.setblocking(False)
        self._last = SenderStatus()

    def post(self, order: Order) -> None:
        """Publish the newest order and wake the sender, without blocking.

        Errors are ignored, since the status shows an ended sender.
        """
        with contextlib.suppress(OSError, ValueError):
            self.orders.write(order.pack())
            self.wake.send(b"\1")

    def status(self) -> SenderStatus:
        """Newest status, without blocking; the last one read while the slot is being written or after it was closed."""
        with contextlib.suppress(ValueError):
            newest = self.statuses.read()
            if newest is not None:
                self._last = SenderStatus.unpack(newest[1])
        return self._last

    @abstractmethod
    def is_alive(self) -> bool:
        """Whether the sender still runs."""

    @abstractmethod
    def ending(self) -> str:
        """How the sender ended, such as "ended with status 1"; empty while it runs."""

    @abstractmethod
    def processor_time_s(self) -> float:
        """Processor time that the sender has used [s]; NaN if it is unknown."""

    @abstractmethod
    def join(self, timeout_s: float) -> bool:
        """Wait for the sender to end; returns whether it has ended."""

    @abstractmethod
    def close(self) -> None:
        """Close the wake line (the sender sends neutral and ends), wait for a bounded time, and free all resources."""

    def _free(self) -> None:
        self.wake.close()
        self.sender_wake.close()
        self.orders.close()
        self.statuses.close()


class ErrorOutput:
    """Error output of the sender, in memory: unlike a terminal or a disk, it does not make the sender wait."""

    def __init__(self) -> None:
        self.descriptor = anonymous_file("carlab-sender-errors")
        self._lock = threading.Lock()
        self._is_open = True

    def last_line(self) -> str:
        """Last line that is not empty: for an exception, its type and message. Empty after ``close``."""
        with self._lock:
            lines = self._text().strip().splitlines()
        return lines[-1].strip()[-MAX_ERROR_CHARACTERS:] if lines else ""

    def close(self) -> None:
        """Copy the text to the error output of this process, and free it. Idempotent."""
        with self._lock:
            text = self._text()
            if self._is_open:
                self._is_open = False
                os.close(self.descriptor)
        if text and sys.stderr is not None:
            with contextlib.suppress(OSError, ValueError):  # it is closed
                sys.stderr.write(text)

    def _text(self) -> str:
        if not self._is_open:
            return ""
        return os.pread(self.descriptor, os.fstat(self.descriptor).st_size, 0).decode("utf-8", "replace")


class SenderProcess(Sender):
    """The sender's process, started on construction; ``Actuator`` owns and closes it."""

    def __init__(self, config: ActuatorConfig, calibration: ActuatorCalibration) -> None:
        super().__init__()
        self._errors = ErrorOutput()
        try:
            self._process = self._start(config, calibration)
        except BaseException:
            self._free()
            self._errors.close()
            raise
        self.sender_wake.close()
        self.pid = self._process.pid

    def _start(self, config: ActuatorConfig, calibration: ActuatorCalibration) -> subprocess.Popen[bytes]:
        descriptors = (self.orders.descriptor, self.statuses.descriptor, self.sender_wake.fileno())
        settings = json.dumps(
            {
                "device_kind": dataclasses.asdict(config.device_kind),
                "actuator": dataclasses.asdict(config),
                "calibration": dataclasses.asdict(calibration),
            }
        )
        root = str(Path(__file__).resolve().parents[2])
        path = os.pathsep.join(p for p in (root, os.environ.get("PYTHONPATH", "")) if p)
        return subprocess.Popen(
            [sys.executable, "-P", "-m", "drivers.sender.process", *map(str, descriptors), settings, str(os.getpid())],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=self._errors.descriptor,
            pass_fds=descriptors,
            start_new_session=True,
            env={**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
        )

    def is_alive(self) -> bool:
        """Whether the process still runs."""
        return self._process.poll() is None

    def ending(self) -> str:
        """How the process ended, with the last line of its error output; empty while it runs."""
        code = self._process.poll()
        if code is None:
            return ""
        how = f"status {code}" if code >= 0 else f"signal {_signal_name(-code)}"
        line = self._errors.last_line()
        return f"ended with {how} ({line})" if line else f"ended with {how}"

    def processor_time_s(self) -> float:
        """Processor time of the main thread [s]; NaN if the system does not state it."""
        try:
            return int(Path(f"/proc/{self.pid}/schedstat").read_text(encoding="ascii").split()[0]) * 1e-9
        except (OSError, ValueError, IndexError):
            return math.nan

    def join(self, timeout_s: float) -> bool:
        """Wait for the process to end."""
        try:
            self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return False
        return True

    def close(self) -> None:
        """Close the wake line and wait; kill a process that does not end (the firmware's time-out stops the motor).

        A process that waits in a driver of the kernel, for a device that hangs, ends only after that wait.
        """
        self.wake.close()
        if not self.join(2.0):
            self._process.kill()
            self.join(2.0)
        self._free()
        self._errors.close()


class SenderThread(Sender):
    """The sender as a thread, for buses that exist only within one process (python-can's ``virtual``)."""

    def __init__(self, config: ActuatorConfig, calibration: ActuatorCalibration, device: Device | None = None) -> None:
        super().__init__()
        loop = SenderLoop(
            config.device_kind.load()(config) if device is None else device,
            config,
            calibration,
            self.orders,
            self.statuses,
            self.sender_wake,
            lambda: True,
        )
        self._thread = threading.Thread(target=loop.run, name="sender", daemon=True)
        self._thread.start()

    def is_alive(self) -> bool:
        """Whether the thread still runs."""
        return self._thread.is_alive()

    def ending(self) -> str:
        """Empty while the thread runs."""
        return "" if self.is_alive() else "ended"

    def processor_time_s(self) -> float:
        """Unknown."""
        return math.nan

    def join(self, timeout_s: float) -> bool:
        """Wait for the thread to end."""
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def close(self) -> None:
        """Close the wake line and wait; a thread that does not end keeps its memory."""
        self.wake.close()
        if self.join(5.0):
            self._free()


def start_sender(config: ActuatorConfig, calibration: ActuatorCalibration) -> Sender:
    """Start a sender: a process, or a thread for the ``virtual`` bus, which exists within one process only."""
    if config.device_kind.is_bus and config.interface == "virtual":
        return SenderThread(config, calibration)
    return SenderProcess(config, calibration)


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:  # a real-time signal
        return str(number)


def _try_realtime() -> bool:
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(REALTIME_PRIORITY))
    except (AttributeError, OSError):
        return False
    return True


def main(arguments: list[str]) -> int:
    """Run the sender's process.

    Arguments: descriptors of orders, statuses and wake line, settings as JSON, process id of the main process.
    """
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    orders_fd, statuses_fd, wake_fd, main_pid = (int(arguments[i]) for i in (0, 1, 2, 4))
    settings = json.loads(arguments[3])
    DEVICE_KINDS[settings["actuator"]["kind"]] = DeviceKind(**settings["device_kind"])
    config = from_table(ActuatorConfig, settings["actuator"], "the sender's settings")
    calibration = from_table(ActuatorCalibration, settings["calibration"], "the sender's settings")
    orders, statuses = Slot(orders_fd, ORDER_SIZE), Slot(statuses_fd, STATUS_SIZE)
    is_realtime = config.realtime_priority and _try_realtime()
    with socket.socket(fileno=wake_fd) as wake:
        wake.setblocking(False)
        loop = SenderLoop(
            config.device_kind.load()(config),
            config,
            calibration,
            orders,
            statuses,
            wake,
            lambda: os.getppid() == main_pid,  # a forked worker of the main process may hold the wake line open
            is_realtime=is_realtime,
        )
        gc.collect()
        gc.freeze()
        loop.run()
    orders.close()
    statuses.close()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
