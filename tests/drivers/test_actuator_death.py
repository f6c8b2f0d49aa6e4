"""Kill tests: after any end of main process or sender, the log of the firmware ends in neutral or in its time-out."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from drivers.calibration import ActuatorCalibration
from drivers.config import ActuatorConfig
from drivers.emulators.command_log import CommandLog, LogEntry
from drivers.emulators.serial_firmware import SerialFirmware
from drivers.emulators.vesc_firmware import VescFirmware
from drivers.sender.process import SenderProcess
from tests.helpers.waiting import TIMEOUT_S, until

pytestmark = pytest.mark.realtime

ROOT = Path(__file__).resolve().parents[2]
MOTOR_TIMEOUT_S = 0.4

CHILD = """
import os, signal, sys, threading, time
# The shell may start the tests with ignored signals (nohup, background job); restore their handlers.
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)
from carlab.core.errors import CarlabError
from carlab.core.quantities import Action
from drivers.actuator import Actuator
from drivers.calibration import ActuatorCalibration
from drivers.config import ActuatorConfig

port, failure = sys.argv[1:3]
config = ActuatorConfig(
    port=port, watchdog_s=0.4, latch_s=1.0, telemetry_stale_s=5.0, telemetry_lost_s=10.0, open_timeout_s=20.0
)
actuator = Actuator(config, ActuatorCalibration())

def report(*values):
    print(*values, flush=True)

def drive():
    n = 0
    while True:
        n += 1
        actuator.command(Action(0.5, 0.3))
        time.sleep(0.02)
        if n == 20:
            if failure == "exception":
                raise RuntimeError("injected")
            if failure == "os_exit":
                os._exit(7)
            if failure == "sys_exit":
                sys.exit(3)
            if failure == "hang":
                report("hanging")
                time.sleep(2.4)
            if failure == "fork":
                pid = os.fork()
                if pid == 0:
                    try:
                        actuator.command(Action(0.5, 0.3))
                    except CarlabError as error:
                        report("forked", type(error).__name__)
                    actuator.close()
                    os._exit(0)
                os.waitpid(pid, 0)
            if failure == "forked_worker_then_sigkill":
                worker = os.fork()
                if worker == 0:
                    time.sleep(60.0)
                    os._exit(0)
                report(worker)
                os.kill(os.getpid(), 9)

def main():
    if failure == "no_close":
        actuator.open()
        actuator.arm()
        for _ in range(20):
            actuator.command(Action(0.5, 0.3))
            time.sleep(0.02)
        return
    with actuator:
        actuator.arm()
        report("sender", actuator._sender.pid)
        try:
            drive()
        except CarlabError as error:
            report("error", type(error).__name__, str(error).replace(chr(10), " "))
            if failure == "retry_on_request":
                sys.stdin.readline()
            for retry in (actuator.arm, lambda: actuator.command(Action(0.5, 0.3))):
                try:
                    retry()
                    report("accepted")
                except CarlabError as retry_error:
                    report("refused", type(retry_error).__name__)

main()
"""


FORK_AND_DIE = """
import os, sys, time
from drivers.calibration import ActuatorCalibration
from drivers.config import ActuatorConfig
from drivers.sender.process import SenderProcess

sender = SenderProcess(ActuatorConfig(port=sys.argv[1]), ActuatorCalibration())
worker = os.fork()
if worker == 0:
    time.sleep(60.0)
    os._exit(0)
print(sender.pid, worker, flush=True)
os.kill(os.getpid(), 9)
"""


class Drive:
    """A child process that drives at 50 Hz, and its emulated firmware."""

    def __init__(self, firmware: SerialFirmware, failure: str) -> None:
        self.log, self.failure = firmware.log, failure
        self.process = subprocess.Popen(
            [sys.executable, "-c", CHILD, firmware.port, failure],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        assert self.process.stdout is not None
        self.lines = self.process.stdout
        self.sender_pid = 0

    def wait_until_moving(self) -> None:
        """Wait for the first motor command that is not neutral; the child prints its sender, except "no_close"."""
        if self.failure != "no_close":
            self.sender_pid = int(self.lines.readline().split()[1])
        try:
            until(lambda: any(e.value == 3.0 for e in self.log.motor()))
        except AssertionError:
            self.process.kill()
            pytest.fail(f"the car does not move; the child printed: {self.end()}")

    def end(self) -> str:
        """Wait for the child to end and return its remaining output."""
        output, _ = self.process.communicate(timeout=TIMEOUT_S)
        return str(output)

    def kill(self) -> None:
        """End the child of a test that failed; else a later test would fail by its warning."""
        self.process.kill()
        self.process.communicate()


@pytest.fixture
def firmware(tmp_path: Path) -> SerialFirmware:
    return SerialFirmware(
        VescFirmware(CommandLog(tmp_path / "log.jsonl"), motor_timeout_s=MOTOR_TIMEOUT_S), link=tmp_path / "vesc"
    )


Start = Callable[[str], Drive]


@pytest.fixture
def start_drive(firmware: SerialFirmware) -> Iterator[Start]:
    """Start a child with a failure, and wait until its car moves."""
    drives: list[Drive] = []

    def start(failure: str) -> Drive:
        drives.append(Drive(firmware, failure))
        drives[-1].wait_until_moving()
        return drives[-1]

    yield start
    for drive in drives:
        drive.kill()


def assert_ended_in_neutral(log: CommandLog) -> list[LogEntry]:
    """The last commands are three or more neutral motor commands over 60 ms and a centred servo."""
    assert log.wait_for("hang_up", TIMEOUT_S) is not None
    motor = log.motor()
    last_moving = max(i for i, e in enumerate(motor) if e.value != 0.0)
    neutral = motor[last_moving + 1 :]
    assert len(neutral) >= 3
    assert all((e.name, e.value) == ("current", 0.0) for e in neutral)
    assert neutral[-1].t_s - neutral[0].t_s >= 0.02  # times of reception: a busy machine receives several at once
    servo = log.entries("servo")
    assert [e.value for e in servo[-3:]] == [0.5] * 3
    assert log.wait_for("motor_timeout", TIMEOUT_S) is not None, "the firmware did not release the motor"
    return neutral


@pytest.mark.parametrize(
    "failure", ["exception", "os_exit", "sys_exit", "no_close", "fork", "forked_worker_then_sigkill"]
)
def test_every_exit_of_the_main_process_ends_in_neutral(
    firmware: SerialFirmware, start_drive: Start, failure: str
) -> None:
    with firmware:
        drive = start_drive(failure)
        if failure == "fork":
            assert drive.lines.readline().split() == ["forked", "NotOpenError"]
            t_s = time.monotonic()
            until(lambda: len([e for e in firmware.log.motor(t_s) if e.value == 3.0]) > 20)
            drive.process.send_signal(signal.SIGINT)
        if failure == "forked_worker_then_sigkill":
            worker = int(drive.lines.readline())
            drive.process.wait(TIMEOUT_S)
        else:
            drive.end()
        try:
            assert_ended_in_neutral(firmware.log)
        finally:
            if failure == "forked_worker_then_sigkill":
                os.kill(worker, signal.SIGKILL)
                drive.end()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGKILL])
def test_every_signal_to_the_main_process_ends_in_neutral(
    firmware: SerialFirmware, start_drive: Start, number: signal.Signals
) -> None:
    with firmware:
        drive = start_drive("forever")
        drive.process.send_signal(number)
        t_s = time.monotonic()
        drive.end()
        neutral = assert_ended_in_neutral(firmware.log)
        moving_afterwards = [e for e in firmware.log.motor(t_s) if e.t_s < neutral[0].t_s]
        assert len(moving_afterwards) < 100, "one second at the send rate"


def test_suspended_main_process_ends_in_neutral_and_is_refused_after_resuming(
    firmware: SerialFirmware, start_drive: Start
) -> None:
    with firmware:
        drive = start_drive("forever")
        drive.process.send_signal(signal.SIGSTOP)
        time.sleep(1.7)
        moving = [e.t_s for e in firmware.log.motor() if e.value != 0.0]
        neutral = [e for e in firmware.log.motor() if e.t_s > moving[-1]]
        assert len(neutral) >= 20, "neutral is sent while the main process is suspended"
        t_resumed_s = time.monotonic()
        drive.process.send_signal(signal.SIGCONT)
        output = drive.end()
        assert "error ActuatorFaultError no command arrived" in output
        assert output.count("refused ActuatorFaultError") == 2
        assert "accepted" not in output
        assert all(e.value == 0.0 for e in firmware.log.motor(t_resumed_s))


def test_hung_main_thread_ends_in_neutral_and_a_latched_fault(firmware: SerialFirmware, start_drive: Start) -> None:
    with firmware:
        drive = start_drive("hang")
        assert drive.lines.readline().strip() == "hanging"
        t_s = time.monotonic()
        output = drive.end()
        assert "error ActuatorFaultError no command arrived" in output
        assert output.count("refused ActuatorFaultError") == 2
        later = [e for e in firmware.log.motor() if e.t_s > t_s + 1.0]
        assert len(later) >= 20
        assert all(e.value == 0.0 for e in later)


def test_firmware_timeout_stops_the_motor_after_the_sender_is_killed(
    firmware: SerialFirmware, start_drive: Start
) -> None:
    with firmware:
        drive = start_drive("forever")
        os.kill(drive.sender_pid, signal.SIGKILL)
        t_s = time.monotonic()
        output = drive.end()
        assert "error ActuatorFaultError The sender process has ended" in output
        assert output.count("refused ActuatorFaultError") == 2
        timeout = firmware.log.wait_for("motor_timeout", TIMEOUT_S)
        assert timeout is not None
        assert not [e for e in firmware.log.motor() if e.t_s > max(timeout.t_s, t_s + 0.5)]


def test_suspended_sender_is_detected_and_cannot_move_the_car_later(
    firmware: SerialFirmware, start_drive: Start
) -> None:
    with firmware:
        drive = start_drive("retry_on_request")
        os.kill(drive.sender_pid, signal.SIGSTOP)
        assert firmware.log.wait_for("motor_timeout", TIMEOUT_S) is not None
        line = drive.lines.readline()
        assert "error ActuatorFaultError The sender process hangs" in line
        t_s = time.monotonic()
        os.kill(drive.sender_pid, signal.SIGCONT)
        until(lambda: len(firmware.log.motor(t_s)) > 10)
        assert drive.process.stdin is not None
        drive.process.stdin.write("continue\n")
        output = drive.end()
        assert output.count("refused ActuatorFaultError") == 2
        assert all(e.value == 0.0 for e in firmware.log.motor(t_s))


def test_unplugging_latches_a_fault_and_the_firmware_times_out(firmware: SerialFirmware, start_drive: Start) -> None:
    with firmware:
        drive = start_drive("forever")
        firmware.unplug()
        output = drive.end()
        assert "error ActuatorFaultError" in output
        assert "was lost" in output
        assert output.count("refused ActuatorFaultError") == 2
        assert firmware.log.wait_for("motor_timeout", TIMEOUT_S) is not None
        unplugged_s = firmware.log.entries("unplug")[0].t_s
        assert not [e for e in firmware.log.motor() if e.t_s > unplugged_s + 0.5]


def test_sender_whose_wake_line_closes_sends_neutral_and_ends(firmware: SerialFirmware) -> None:
    with firmware:
        sender = SenderProcess(ActuatorConfig(port=firmware.port), ActuatorCalibration())
        until(lambda: len(firmware.log.motor()) > 3)
        sender.close()
        assert sender._process.returncode == 0, "the sender ended by itself"
        assert firmware.log.wait_for("hang_up", TIMEOUT_S) is not None


def test_sender_ends_if_the_main_process_dies_while_it_starts(firmware: SerialFirmware) -> None:
    """A forked worker holds the wake line open, and the sender has another parent before its first check."""
    with firmware:
        command = [sys.executable, "-c", FORK_AND_DIE, firmware.port]
        with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            sender, worker = map(int, process.stdout.readline().split())
            try:
                until(lambda: not Path(f"/proc/{sender}").exists())
            finally:
                for pid in (worker, sender):
                    with contextlib.suppress(ProcessLookupError):
                        os.kill(pid, signal.SIGKILL)


def test_closing_does_not_wait_for_a_sender_that_cannot_be_killed(
    firmware: SerialFirmware, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in the kernel's wait for a device that hangs, where no signal ends a process."""
    with firmware:
        sender = SenderProcess(ActuatorConfig(port=firmware.port), ActuatorCalibration())
        until(lambda: len(firmware.log.motor()) > 3)
        os.kill(sender.pid, signal.SIGSTOP)
        monkeypatch.setattr(sender._process, "kill", lambda: None)
        begin_s = time.monotonic()
        closing = threading.Thread(target=sender.close)
        closing.start()
        closing.join(10.0)
        duration_s = time.monotonic() - begin_s
        os.kill(sender.pid, signal.SIGKILL)
        closing.join()
        sender._process.wait()
        assert duration_s < 8.0
