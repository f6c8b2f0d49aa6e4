"""The sender's loop with a fake device and a fake clock: commands written after the process was suspended."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Iterator

import pytest

from drivers.calibration import DeviceCommand, MotorKind
from drivers.device import DeviceCounters
from drivers.sender import loop as loop_module
from drivers.sender.logic import ORDER_SIZE, Order, Request, SenderState
from drivers.sender.loop import SenderLoop
from drivers.sender.slots import Slot
from drivers.sender.status import STATUS_SIZE
from tests.helpers.sender_bench import CALIBRATION, CONFIG, HEALTHY, MOVING, VERSION

SUSPENDED_S = 0.18


class FakeDevice:
    """A device that records written commands and sends no replies."""

    def __init__(self) -> None:
        self.counters = DeviceCounters()
        self.written: list[DeviceCommand] = []

    def open(self) -> None: ...
    def close(self) -> None: ...
    def fileno(self) -> None: ...
    def receive(self, now_s: float) -> list[object]:
        return []

    def send(self, command: DeviceCommand) -> None:
        self.written.append(command)

    def request_firmware(self) -> None: ...
    def request_telemetry(self) -> None: ...


class FakeTime:
    """The loop's clock."""

    CLOCK_BOOTTIME = time.CLOCK_BOOTTIME

    def __init__(self) -> None:
        self.now_s = 100.0
        self.suspended_s = 0.0

    def monotonic(self) -> float:
        return self.now_s

    def clock_gettime(self, clock: int) -> float:
        assert clock == self.CLOCK_BOOTTIME
        return self.now_s + self.suspended_s

    def sleep(self, duration_s: float) -> None:
        self.now_s += duration_s


class Bench:
    """An armed sender with one fresh moving command."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.time = FakeTime()
        monkeypatch.setattr(loop_module, "time", self.time)
        self.orders, self.statuses = Slot.create(ORDER_SIZE), Slot.create(STATUS_SIZE)
        self.wake, self._other_end = socket.socketpair()
        self.device = FakeDevice()
        self.loop = SenderLoop(
            self.device,  # type: ignore[arg-type]
            CONFIG,
            CALIBRATION,
            self.orders,
            self.statuses,
            self.wake,
            lambda: True,
        )
        self.loop._is_link_open = True
        self.loop.logic.link_up()
        self.loop.logic.firmware(VERSION)
        self.loop.logic.telemetry(self.time.now_s, HEALTHY)
        self.order(1, Request.ARM, 0)
        self.loop._tick(self.time.now_s)
        assert self.loop.logic.state == SenderState.ARMED
        self.order(1, Request.ARM, 1)

    def order(self, epoch: int, request: Request, number: int) -> None:
        self.orders.write(Order(epoch, request, number, self.time.now_s, MOVING).pack())

    def suspend_process_after_decision(self, meanwhile: Callable[[], None] = lambda: None) -> None:
        """Suspend the process after the next decision while the main process runs ``meanwhile``."""
        decide = self.loop.logic.decide

        def decide_then_pause(now_s: float) -> DeviceCommand | None:
            decided = decide(now_s)
            self.loop.logic.decide = decide  # type: ignore[method-assign]
            meanwhile()
            self.time.now_s += SUSPENDED_S
            return decided

        self.loop.logic.decide = decide_then_pause  # type: ignore[method-assign]

    def pause_after_each_decision(self, pause_s: float) -> None:
        decide = self.loop.logic.decide

        def decide_then_pause(now_s: float) -> DeviceCommand | None:
            decided = decide(now_s)
            self.time.now_s += pause_s
            return decided

        self.loop.logic.decide = decide_then_pause  # type: ignore[method-assign]

    def close(self) -> None:
        self.wake.close()
        self._other_end.close()


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    armed_bench = Bench(monkeypatch)
    yield armed_bench
    armed_bench.close()


def test_fresh_command_is_written(bench: Bench) -> None:
    bench.loop._tick(bench.time.now_s)
    assert bench.device.written[-1] == MOVING


def test_command_that_is_too_old_at_the_write_is_not_written(bench: Bench) -> None:
    bench.suspend_process_after_decision()
    bench.loop._tick(bench.time.now_s)
    assert bench.device.written[-1] == CALIBRATION.neutral
    assert MOVING not in bench.device.written


def test_stop_between_decision_and_write_takes_effect(bench: Bench) -> None:
    bench.suspend_process_after_decision(lambda: bench.order(2, Request.STOP_AND_LATCH, 0))
    bench.loop._tick(bench.time.now_s)
    assert bench.device.written[-1] == CALIBRATION.neutral
    assert MOVING not in bench.device.written
    assert bench.loop.logic.state == SenderState.FAULT


def test_command_before_a_suspension_of_the_computer_is_not_written(bench: Bench) -> None:
    """The monotonic clock stands still while the computer is suspended, so the command is young."""
    bench.loop._tick(bench.time.now_s)
    assert bench.device.written[-1] == MOVING
    bench.time.suspended_s += 3600.0
    for _ in range(2):
        bench.time.now_s += 0.001
        bench.loop._tick(bench.time.now_s)
        assert bench.device.written[-1] == CALIBRATION.neutral
    assert "the computer was suspended" in bench.loop.logic.fault
    bench.order(2, Request.RESET_FAULT, 0)
    bench.loop._tick(bench.time.now_s)
    assert bench.loop.logic.state == SenderState.CONNECTED


def test_newer_command_between_decision_and_write_is_written(bench: Bench) -> None:
    newer = DeviceCommand(MotorKind.CURRENT, 1000, 500)

    def meanwhile() -> None:
        issued_s = bench.time.now_s + SUSPENDED_S - 0.02
        bench.orders.write(Order(1, Request.ARM, 2, issued_s, newer).pack())
        bench.loop.logic.telemetry(issued_s, HEALTHY)

    bench.suspend_process_after_decision(meanwhile)
    bench.loop._tick(bench.time.now_s)
    assert bench.device.written[-1] == newer


def test_repeatedly_suspended_process_writes_neutral(bench: Bench) -> None:
    bench.pause_after_each_decision(0.02)
    bench.loop._tick(bench.time.now_s)
    assert bench.device.written[-1] == CALIBRATION.neutral


def test_only_written_neutral_frames_count_before_the_sender_ends(bench: Bench) -> None:
    """At least three neutral frames are written before the sender ends, also with a pause after each decision."""
    bench.pause_after_each_decision(0.05)
    bench.order(2, Request.SHUT_DOWN, 0)
    bench.device.written.clear()
    while not bench.loop.logic.is_finished:
        bench.loop._tick(bench.time.now_s)
    assert len(bench.device.written) >= 3
    assert set(bench.device.written) == {CALIBRATION.neutral}


def test_unexpected_error_ends_the_sender_with_neutral(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(now_s: float) -> list[object]:
        raise KeyError("an error in the program")

    bench.loop._tick(bench.time.now_s)
    assert bench.device.written[-1] == MOVING
    monkeypatch.setattr(bench.device, "receive", fail)
    started_s = bench.time.now_s
    with pytest.raises(KeyError):
        bench.loop.run()
    assert bench.device.written[-3:] == [CALIBRATION.neutral] * 3
    assert bench.time.now_s - started_s >= 0.06
    assert bench.loop.logic.state == SenderState.FAULT


def test_command_replaced_by_neutral_is_not_reported_as_sent(bench: Bench) -> None:
    bench.pause_after_each_decision(0.02)
    bench.loop._tick(bench.time.now_s)
    assert bench.device.written[-1] == CALIBRATION.neutral
    assert bench.loop.logic.sent_number == 0
