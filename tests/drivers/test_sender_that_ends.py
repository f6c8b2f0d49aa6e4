"""A sender that ends, or does not start, while the actuator opens: the message states how it ended, and when."""

from __future__ import annotations

import os
import signal
import threading
from dataclasses import replace
from pathlib import Path

import pytest

from carlab.core.errors import ActuatorFaultError, NotReadyError
from drivers import actuator as actuator_module
from drivers.actuator import Actuator
from drivers.calibration import ActuatorCalibration
from drivers.config import ActuatorConfig
from drivers.device_kinds import DEVICE_KINDS
from drivers.emulators.serial_firmware import SerialFirmware
from drivers.sender.process import SenderProcess
from tests.helpers.waiting import until

pytestmark = pytest.mark.realtime

NO_DEADLINE_S = 60.0
"""No test waits for it: a message comes at once after the end of the sender."""


def config_for(firmware: SerialFirmware) -> ActuatorConfig:
    return ActuatorConfig(port=firmware.port, open_timeout_s=NO_DEADLINE_S)


def start_and_send(number: int, *, once_open: bool) -> type[SenderProcess]:
    """Kind of sender that receives a signal, at its start or once its port is open."""

    class SignalledSender(SenderProcess):
        def __init__(self, config: ActuatorConfig, calibration: ActuatorCalibration) -> None:
            super().__init__(config, calibration)
            if once_open:
                threading.Thread(target=self._wait_and_send).start()
            else:
                os.kill(self.pid, number)

        def _wait_and_send(self) -> None:
            until(lambda: self.status().is_link_open)
            os.kill(self.pid, number)

    return SignalledSender


@pytest.mark.parametrize(("once_open", "step"), [(False, "started"), (True, "waited for the VESC")])
def test_killed_sender_is_reported_with_its_signal(serial_firmware: SerialFirmware, once_open: bool, step: str) -> None:
    serial_firmware.faults.drops_replies = True
    start = start_and_send(signal.SIGKILL, once_open=once_open)
    with pytest.raises(NotReadyError, match=f"the sender process ended with signal SIGKILL while it {step}"):
        Actuator(config_for(serial_firmware), ActuatorCalibration(), start).open()


@pytest.mark.parametrize(
    ("code", "ending"),
    [
        ("raise ValueError('no such board')", r"status 1 \(ValueError: no such board\)"),
        ("raise SystemExit(3)", "status 3"),
    ],
)
def test_sender_that_ends_at_an_import_is_reported_with_its_last_line(
    code: str, ending: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "broken_protocol.py").write_text(code)
    kind = replace(DEVICE_KINDS["vesc_serial"], factory="broken_protocol:make_device")
    monkeypatch.setitem(DEVICE_KINDS, "broken", kind)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with pytest.raises(NotReadyError, match=f"the sender process ended with {ending} while it started"):
        Actuator(ActuatorConfig("broken"), ActuatorCalibration()).open()
    assert ("Traceback" in capfd.readouterr().err) == ("ValueError" in code), "the whole text is printed too"


def test_sender_that_loses_the_main_process_while_it_opens_is_no_silent_device(serial_firmware: SerialFirmware) -> None:
    def start(config: ActuatorConfig, calibration: ActuatorCalibration) -> SenderProcess:
        sender = SenderProcess(config, calibration)
        sender.wake.close()
        return sender

    serial_firmware.faults.drops_replies = True
    with pytest.raises(NotReadyError, match="the sender process ended with status 0 while it"):
        Actuator(config_for(serial_firmware), ActuatorCalibration(), start).open()


def test_sender_that_does_not_start_in_time_is_reported_with_its_processor_time(
    serial_firmware: SerialFirmware, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a computer that is overloaded, so that the sender gets no processor."""
    monkeypatch.setattr(actuator_module, "START_TIMEOUT_S", 0.3)
    monkeypatch.setattr(actuator_module, "ANSWER_TIMEOUT_S", 0.1)
    start = start_and_send(signal.SIGSTOP, once_open=False)
    with pytest.raises(NotReadyError, match=r"has not started within 0\.3 s; it has used [\de.-]+ s of processor time"):
        Actuator(config_for(serial_firmware), ActuatorCalibration(), start).open()


def test_sender_that_is_killed_while_it_drives_is_reported_with_its_signal(serial_firmware: SerialFirmware) -> None:
    with Actuator(config_for(serial_firmware), ActuatorCalibration()) as actuator:
        assert isinstance(actuator._sender, SenderProcess)
        os.kill(actuator._sender.pid, signal.SIGKILL)
        actuator._sender.join(NO_DEADLINE_S)
        with pytest.raises(ActuatorFaultError, match="The sender process has ended with signal SIGKILL"):
            actuator.arm()
