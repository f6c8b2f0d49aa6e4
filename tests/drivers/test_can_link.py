"""The CAN link on buses of python-can: failures, error frames, steps of the system clock."""

from __future__ import annotations

import errno
import sys
import time
import uuid
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import can
import pytest
from can.interfaces import BACKENDS
from can.interfaces.virtual import VirtualBus

from carlab.core.errors import ActuatorFaultError, NotReadyError
from drivers.links.can_link import CanLink
from drivers.vesc import can_codec as vesc_can_codec


class BrokenBus(VirtualBus):
    """A virtual bus with the failures of a real bus."""

    failure: Exception | None = None
    received: can.Message | None = None
    shutdown_failure: Exception | None = None
    flushed = 0

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        assert timeout == 0, "a frame that cannot be sent now must not be sent later"
        if self.failure is not None:
            raise self.failure
        super().send(msg, timeout)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        if self.failure is not None and self.received is None:
            raise self.failure
        message, self.received = self.received, None
        return message

    def flush_tx_buffer(self) -> None:
        self.flushed += 1

    def shutdown(self) -> None:
        super().shutdown()
        if self.shutdown_failure is not None:
            raise self.shutdown_failure


class BrokenLink(CanLink):
    """A CAN link on a ``BrokenBus``."""

    bus: BrokenBus

    def _open_bus(self) -> can.BusABC:
        self.bus = BrokenBus(channel=self.channel)
        return self.bus


@pytest.mark.parametrize(
    "failure",
    [
        can.CanOperationError("transmit buffer full"),
        OSError(errno.ENOBUFS, "no buffer space"),
        OSError(errno.ENETDOWN, "network is down"),
        IndexError("an interface reads a line that is no frame"),
    ],
)
def test_bus_errors_raise_faults_and_flush_the_queue(failure: Exception) -> None:
    link = BrokenLink("virtual", f"test-{uuid.uuid4()}")
    link.open()
    link.bus.failure = failure
    with pytest.raises(ActuatorFaultError, match="check wiring"):
        link.write(vesc_can_codec.set_current(23, 1.0))
    assert link.bus.flushed == 1
    with pytest.raises(ActuatorFaultError):
        link.read()
    link.close()
    link.close()
    with pytest.raises(ActuatorFaultError, match="not open"):
        link.read()


@pytest.mark.parametrize(
    "failure",
    [
        can.CanOperationError("Error receiving: Network is down", errno.ENETDOWN),
        can.CanOperationError("Failed to transmit: Network is down", errno.ENETDOWN),
    ],
)
def test_interface_that_is_down_names_the_command_that_brings_it_up(failure: Exception) -> None:
    """Linux binds a socket to a CAN interface that is down (net/can/raw.c); the first frame shows it."""
    link = BrokenLink("socketcan", f"test-{uuid.uuid4()}", 250_000)
    link.open()
    link.bus.failure = failure
    for use in (link.read, lambda: link.write(vesc_can_codec.set_current(23, 1.0))):
        with pytest.raises(ActuatorFaultError, match=rf"'ip link set {link.channel} up type can bitrate 250000 "):
            use()
    link.close()


def test_bus_off_is_a_fault_and_another_error_frame_is_none() -> None:
    link = BrokenLink("virtual", f"test-{uuid.uuid4()}")
    link.open()
    link.bus.received = can.Message(arbitration_id=0x04, is_error_frame=True, data=bytes(8))
    assert link.read() == []
    link.bus.received = can.Message(arbitration_id=0x40, is_error_frame=True, data=bytes(8))
    with pytest.raises(ActuatorFaultError, match="bus-off"):
        link.read()
    link.close()


@pytest.mark.parametrize(
    ("interface", "details", "is_fault"),
    [("socketcan", 0x20, True), ("socketcan", 0x18, False), ("pcan", 0x20, False)],
    ids=["sends error-passive", "warnings and receives error-passive", "another meaning"],
)
def test_controller_that_sends_without_acknowledgement_is_a_fault(interface: str, details: int, is_fault: bool) -> None:
    link = BrokenLink(interface, f"test-{uuid.uuid4()}")
    link.open()
    link.bus.received = can.Message(arbitration_id=0x04, is_error_frame=True, data=bytes((0, details)))
    if is_fault:
        with pytest.raises(ActuatorFaultError, match=r"no device acknowledges .* check wiring, termination and power"):
            link.read()
    else:
        assert link.read() == []
    link.close()


def test_echo_of_an_own_frame_is_ignored() -> None:
    link = BrokenLink("virtual", f"test-{uuid.uuid4()}")
    link.open()
    for is_rx in (False, True):
        link.bus.received = can.Message(arbitration_id=0x117, data=bytes(4), is_rx=is_rx)
        assert len(link.read()) == is_rx
    link.close()


@pytest.mark.parametrize(("interface", "channel"), [("kvaser", "0"), ("socketcand", "can0"), ("robotell", "")])
def test_interface_that_raises_an_error_of_its_library_is_not_ready(interface: str, channel: str) -> None:
    with pytest.raises(NotReadyError, match=r"cannot be opened: .* the driver of the adapter"):
        CanLink(interface, channel).open()


def test_gs_usb_adapter_is_opened_by_its_number(monkeypatch: pytest.MonkeyPatch) -> None:
    """The bus is that of python-can; only the library of the adapter is replaced."""
    library = MagicMock()
    library.GsUsb.scan.return_value = [adapter := MagicMock()]
    adapter.device_capability.fclk_can = 48_000_000
    for name in ("usb", "gs_usb", "gs_usb.constants", "gs_usb.gs_usb", "gs_usb.gs_usb_frame"):
        monkeypatch.setitem(sys.modules, name, library)
    monkeypatch.delitem(sys.modules, "can.interfaces.gs_usb", raising=False)
    link = CanLink("gs_usb", "0", 250_000)
    link.open()
    link.close()
    timing = adapter.set_timing.call_args.kwargs
    quanta = 1 + timing["prop_seg"] + timing["phase_seg1"] + timing["phase_seg2"]
    assert 48_000_000 / (timing["brp"] * quanta) == 250_000


@pytest.mark.parametrize("channel", ["can0", "", "-1"])
def test_gs_usb_adapter_without_a_number_is_not_ready(channel: str) -> None:
    with pytest.raises(NotReadyError) as caught:
        CanLink("gs_usb", channel).open()
    assert caught.value.reasons == ('the channel of gs_usb is the number of the adapter, such as "0".',)


def test_every_interface_gets_the_bitrate(monkeypatch: pytest.MonkeyPatch) -> None:
    bitrates = []

    class Recorder(VirtualBus):
        def __init__(self, channel: str, bitrate: int = 500_000, **options: Any) -> None:
            bitrates.append(bitrate)
            super().__init__(channel)

    monkeypatch.setitem(sys.modules, "recorder", SimpleNamespace(Recorder=Recorder))
    interfaces = ("pcan", "seeedstudio", "systec", "cantact", "of_another_package")
    for interface in interfaces:
        monkeypatch.setitem(BACKENDS, interface, ("recorder", "Recorder"))
        link = CanLink(interface, f"test-{uuid.uuid4()}", 250_000)
        link.open()
        link.close()
    assert bitrates == [250_000] * len(interfaces)


def test_adapter_that_cannot_be_shut_down_is_closed() -> None:
    link = BrokenLink("virtual", f"test-{uuid.uuid4()}")
    link.open()
    link.bus.shutdown_failure = can.CanOperationError("the adapter was removed")
    link.close()
    link.open()
    link.close()


def test_reading_does_not_wait_after_a_backward_step_of_the_system_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    """python-can measures the time-out of a read with the system clock."""
    clock_s = iter((1000.0, 990.0, 2000.0))
    link = CanLink("udp_multicast", f"239.74.163.2:{20000 + uuid.uuid4().int % 20000}")
    link.open()
    monkeypatch.setattr("can.bus.time", lambda: next(clock_s))
    started_s = time.monotonic()
    assert link.read() == []
    assert time.monotonic() - started_s < 5.0
    link.close()
