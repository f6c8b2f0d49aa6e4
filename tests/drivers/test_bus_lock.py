"""Two programs cannot command, or emulate, one motor controller of a CAN bus."""

from __future__ import annotations

import errno
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import uuid
from pathlib import Path

import pytest
from patient_config import patient_config

from carlab.core.errors import NotReadyError
from carlab.core.quantities import Action
from drivers.actuator import Actuator
from drivers.calibration import ActuatorCalibration
from drivers.config import ActuatorConfig
from drivers.emulators.can_firmware import CanFirmware
from drivers.emulators.command_log import CommandLog
from drivers.emulators.vesc_firmware import VescFirmware
from drivers.links.bus_lock import BusLock
from drivers.links.can_link import CanLink
from tests.helpers.waiting import TIMEOUT_S, until

pytestmark = pytest.mark.realtime

ROOT = Path(__file__).resolve().parents[2]
CHANNEL = f"test-{uuid.uuid4()}"
HOLDER = """
import sys, time
from drivers.links.bus_lock import BusLock
lock = BusLock("socketcan", sys.argv[1], 23)
lock.acquire()
print("locked", flush=True)
time.sleep(60.0)
"""


def multicast_config() -> ActuatorConfig:
    channel = f"239.74.163.2:{20000 + uuid.uuid4().int % 20000}"
    return patient_config(
        kind="vesc_can", interface="udp_multicast", channel=channel, watchdog_s=25.0, open_timeout_s=TIMEOUT_S
    )


def test_second_sender_is_refused_and_sends_nothing_to_the_controller() -> None:
    config = multicast_config()
    log = CommandLog()
    with CanFirmware(VescFirmware(log), "udp_multicast", config.channel):
        with Actuator(config, ActuatorCalibration(max_current_a=10.0)) as first:
            first.arm()
            first.command(Action(0.5, 0.3))
            until(lambda: any(entry.value == 3.0 for entry in log.motor()))
            t_s = time.monotonic()
            sender_pid = first._sender.pid  # type: ignore[union-attr]
            with pytest.raises(NotReadyError, match=rf"is in use: .*process {sender_pid}, .* end that program first"):
                Actuator(config, ActuatorCalibration()).open()
            first.command(Action(0.5, 0.3))
            time.sleep(0.1)
            values = [entry.value for entry in log.motor(t_s)]
            assert values
            assert set(values) == {3.0}, "neutral commands of the second sender would be between them"
        with Actuator(config, ActuatorCalibration()) as next_one:
            next_one.arm()


def test_killed_holder_releases_the_lock(tmp_path: Path) -> None:
    """The programs have different folders for temporary files, as those of two users may have."""
    lock, other = BusLock("socketcan", CHANNEL, 23), BusLock("socketcan", CHANNEL, 24)
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLDER, CHANNEL],
        cwd=ROOT, stdout=subprocess.PIPE, text=True, env=os.environ | {"TMPDIR": str(tmp_path)},
    )  # fmt: skip
    try:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "locked\n"
        with pytest.raises(NotReadyError, match=f"process {holder.pid}, started by process {os.getpid()}"):
            lock.acquire()
        other.acquire()
        other.release()
        holder.send_signal(signal.SIGKILL)
        holder.communicate(timeout=TIMEOUT_S)
        lock.acquire()
        with pytest.raises(NotReadyError, match=f"process {os.getpid()}"):
            BusLock("socketcan", CHANNEL, 23).acquire()
    finally:
        holder.kill()
        holder.communicate()
        lock.release()


def test_two_links_exclude_each_other_until_one_is_closed() -> None:
    channel = f"test-{uuid.uuid4()}"
    first, second = CanLink("virtual", channel, controller_id=23), CanLink("virtual", channel, controller_id=23)
    first.open()
    first.open()
    with pytest.raises(NotReadyError, match=r"Controller 23 on CAN bus virtual .* is in use"):
        second.open()
    other = CanLink("virtual", channel, controller_id=24)
    other.open()
    other.close()
    first.close()
    second.open()
    second.close()
    second.close()


def test_two_cars_on_one_bus_need_different_host_ids() -> None:
    """The frames of the replies of both controllers to one host id would mix."""
    channel = f"test-{uuid.uuid4()}"
    first = CanLink("virtual", channel, controller_id=23, host_id=42)
    second = CanLink("virtual", channel, controller_id=24, host_id=42)
    other = CanLink("virtual", channel, controller_id=24, host_id=43)
    first.open()
    for _ in range(2):
        with pytest.raises(NotReadyError, match=r"Host id 42 on CAN bus .* in use: .*; set another host_id in"):
            second.open()
    other.open()
    other.close()
    with pytest.raises(NotReadyError, match=r"Host id 23 on CAN bus"):
        CanLink("virtual", channel, controller_id=24, host_id=23).open()
    first.close()
    second.open()
    second.close()


def test_two_emulated_controllers_on_one_bus_need_different_ids() -> None:
    """A channel without a port has the default port, so it is the same bus."""
    group = f"239.74.163.{2 + uuid.uuid4().int % 250}"
    first = CanFirmware(VescFirmware(CommandLog()), channel=group)
    second = CanFirmware(VescFirmware(CommandLog()), channel=f"{group}:43113")
    with first, CanFirmware(VescFirmware(CommandLog(), controller_id=24), channel=group):
        with pytest.raises(NotReadyError, match=r"Emulated controller 23 on CAN bus .* end that program or choose"):
            second.open()
        link = CanLink("udp_multicast", group, controller_id=23)
        link.open()
        link.close()
    with second:
        pass


@pytest.mark.parametrize(("interface", "channel"), [("no_such_interface", "x"), ("udp_multicast", "239.1.1.1:99999")])
def test_failed_opening_releases_the_controller(interface: str, channel: str) -> None:
    link = CanLink(interface, channel, controller_id=23)
    for _ in range(2):
        with pytest.raises(NotReadyError, match="cannot be opened"):
            link.open()


def test_a_lock_that_the_system_does_not_allow_is_refused_with_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    class Forbidden(socket.socket):
        def bind(self, address: str) -> None:  # type: ignore[override]
            raise PermissionError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr("socket.socket", Forbidden)
    with pytest.raises(NotReadyError, match=r"cannot be locked: .*Unix socket \(Operation not permitted\)"):
        BusLock("socketcan", CHANNEL, 23).acquire()


def test_one_of_many_threads_holds_the_lock_at_any_time() -> None:
    holders: list[int] = []
    counts: list[int] = []

    def work() -> None:
        for _ in range(300):
            lock = BusLock("socketcan", CHANNEL, 23)
            try:
                lock.acquire()
            except NotReadyError:
                continue
            holders.append(1)
            counts.append(len(holders))
            holders.pop()
            lock.release()

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(counts) > 10
    assert set(counts) == {1}
