"""The whole computer pauses for a moment, as a busy virtual machine does: all processes stop and resume together."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator

import pytest
from patient_config import patient_config

from carlab.core.errors import ActuatorFaultError
from carlab.core.quantities import Action
from drivers.actuator import SILENT_SENDER_S, Actuator
from drivers.calibration import ActuatorCalibration
from drivers.emulators.serial_firmware import SerialFirmware
from drivers.sender.process import SenderProcess
from tests.helpers.waiting import until

pytestmark = pytest.mark.realtime

MOVING = Action(0.5, 0.3)  # 3 A


@pytest.fixture
def actuator(serial_firmware: SerialFirmware) -> Iterator[Actuator]:
    with Actuator(patient_config(port=serial_firmware.port), ActuatorCalibration(max_current_a=10.0)) as opened:
        opened.arm()
        yield opened


def pause_sender(actuator: Actuator) -> int:
    """Stop the sender until its last status is older than that of a sender that hangs; returns its process id."""
    sender = actuator._sender
    assert isinstance(sender, SenderProcess)
    os.kill(sender.pid, signal.SIGSTOP)
    until(lambda: time.monotonic() - actuator.status().t_published_s > SILENT_SENDER_S + 0.1)
    return sender.pid


def test_sender_that_resumes_after_this_process_is_no_fault(
    actuator: Actuator, serial_firmware: SerialFirmware
) -> None:
    resume = threading.Timer(0.01, os.kill, (pause_sender(actuator), signal.SIGCONT))
    resume.start()
    actuator.command(MOVING)
    resume.join()
    until(lambda: any(entry.value == 3.0 for entry in serial_firmware.log.motor()))


def test_stop_waits_for_neutral_of_a_sender_that_resumes(
    actuator: Actuator, serial_firmware: SerialFirmware, caplog: pytest.LogCaptureFixture
) -> None:
    actuator.command(MOVING)
    until(lambda: serial_firmware.log.motor()[-1].value == 3.0)
    resume = threading.Timer(0.01, os.kill, (pause_sender(actuator), signal.SIGCONT))
    resume.start()
    actuator.stop(planned=True)
    resume.join()
    assert caplog.text == ""
    assert actuator.status().is_neutral_settled


def test_sender_that_does_not_resume_hangs(actuator: Actuator) -> None:
    pid = pause_sender(actuator)
    try:
        with pytest.raises(ActuatorFaultError, match="The sender process hangs"):
            actuator.command(MOVING)
    finally:
        os.kill(pid, signal.SIGCONT)
