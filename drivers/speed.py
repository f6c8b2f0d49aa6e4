"""Benchmark of the sender's lateness, idle and with a CPU-bound Python thread in the main process."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from carlab.core.errors import NotReadyError
from carlab.core.quantities import Action
from drivers.actuator import Actuator
from drivers.calibration import ActuatorCalibration
from drivers.config import ActuatorConfig
from drivers.sender.status import SenderStatus


@contextmanager
def firmware_process() -> Iterator[str]:
    """Run an emulated VESC in a separate process; yields its port. Raises NotReadyError if it does not start."""
    with tempfile.TemporaryDirectory() as folder:
        link = Path(folder) / "vesc"
        process = subprocess.Popen(
            [sys.executable, "-m", "drivers.emulators.serial_firmware", "--link", str(link)],
            cwd=Path(__file__).resolve().parents[1],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )
        try:
            assert process.stdout is not None
            port = process.stdout.readline().decode().strip()
            if not port:
                raise NotReadyError(
                    "The emulated firmware did not start",
                    ("run drivers.emulators.serial_firmware by hand.",),
                )
            yield port
        finally:
            process.communicate()


@contextmanager
def busy_thread(is_busy: bool) -> Iterator[None]:
    """Run a CPU-bound Python thread if ``is_busy``."""
    done = threading.Event()

    def burn() -> None:
        total = 0
        while not done.is_set():
            total += sum(range(1000))

    thread = threading.Thread(target=burn, name="busy", daemon=True)
    if is_busy:
        thread.start()
    try:
        yield
    finally:
        done.set()
        if is_busy:
            thread.join()


def _drive(port: str, rate_hz: float, seconds: float, *, is_busy: bool) -> SenderStatus:
    """Drive at 30 Hz for some seconds and return the sender's status with its lateness."""
    config = ActuatorConfig(
        port=port,
        rate_hz=rate_hz,
        telemetry_rate_hz=min(50.0, rate_hz),
        watchdog_s=1.0,
        latch_s=5.0,
        realtime_priority=True,
    )
    with Actuator(config, ActuatorCalibration()) as actuator, busy_thread(is_busy):
        actuator.arm()
        until_s = time.monotonic() + seconds
        while time.monotonic() < until_s:
            actuator.command(Action(0.1, 0.1))
            time.sleep(1.0 / 30.0)
        return actuator.status()


def sender_lateness(seconds: float = 5.0, rates_hz: Sequence[float] = (30.0, 100.0)) -> dict[str, float]:
    """Measure the lateness of the sender's deadlines with an emulated firmware in another process.

    For every rate R and condition C (``idle``, and ``loaded`` with a CPU-bound Python thread in this process):
    ``sender_R_hz_C_late_p50_ms``, ``..._p99_ms``, ``..._max_ms``; per rate ``sender_R_hz_loaded_to_idle_p99_ratio``;
    and ``sender_realtime_flag``, 1 if the sender got SCHED_FIFO. Takes about ``2 len(rates_hz) seconds``.
    """
    figures: dict[str, float] = {}
    with firmware_process() as port:
        for rate_hz in rates_hz:
            for condition in ("idle", "loaded"):
                status = _drive(port, rate_hz, seconds, is_busy=condition == "loaded")
                stem = f"sender_{rate_hz:g}_hz_{condition}_late"
                figures[f"{stem}_p50_ms"] = status.late_p50_ms
                figures[f"{stem}_p99_ms"] = status.late_p99_ms
                figures[f"{stem}_max_ms"] = status.late_max_ms
                figures["sender_realtime_flag"] = float(status.is_realtime)
            stem = f"sender_{rate_hz:g}_hz"
            ratio = figures[f"{stem}_loaded_late_p99_ms"] / max(figures[f"{stem}_idle_late_p99_ms"], 1e-6)
            figures[f"{stem}_loaded_to_idle_p99_ratio"] = ratio
    return figures
