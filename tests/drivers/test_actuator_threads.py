"""One actuator used by two threads: the control loop, and the watchdog thread that stops it."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import pytest
from patient_config import patient_config

from carlab.core.errors import ActuatorFaultError, CarlabError
from carlab.core.quantities import Action
from drivers.actuator import Actuator
from drivers.calibration import ActuatorCalibration
from drivers.emulators.serial_firmware import SerialFirmware
from drivers.sender.logic import SenderState
from tests.helpers.waiting import TIMEOUT_S

pytestmark = pytest.mark.realtime

MOVING = Action(0.5, 0.3)


def make_actuator(firmware: SerialFirmware) -> Actuator:
    return Actuator(patient_config(port=firmware.port), ActuatorCalibration())


@pytest.fixture
def actuator(serial_firmware: SerialFirmware) -> Iterator[Actuator]:
    with make_actuator(serial_firmware) as opened:
        yield opened


def test_arming_does_not_overwrite_a_stop_of_another_thread(actuator: Actuator) -> None:
    """The stop comes between the check in arm() and its order; the sender's slot holds the newest order only."""
    original_await = actuator._await

    def await_and_stop(*arguments: object) -> object:
        result = original_await(*arguments)  # type: ignore[arg-type]
        actuator._await = original_await  # type: ignore[method-assign]
        thread = threading.Thread(target=actuator.stop, kwargs={"planned": False})
        thread.start()
        thread.join()
        return result

    actuator._await = await_and_stop  # type: ignore[method-assign,assignment]
    with pytest.raises(ActuatorFaultError, match="stopped for safety"):
        actuator.arm()
    assert actuator.status().state == SenderState.FAULT


def test_concurrent_close_raises_only_documented_errors(serial_firmware: SerialFirmware) -> None:
    for _ in range(3):
        actuator = make_actuator(serial_firmware)
        actuator.open()
        actuator.arm()
        unexpected: list[BaseException] = []

        def use(actuator: Actuator = actuator, unexpected: list[BaseException] = unexpected) -> None:
            try:
                while True:
                    actuator.command(MOVING)
                    actuator.stop(planned=True)
                    actuator.arm()
            except CarlabError:
                return
            except BaseException as error:
                unexpected.append(error)

        thread = threading.Thread(target=use)
        thread.start()
        time.sleep(0.3)
        actuator.close()
        thread.join(TIMEOUT_S)
        assert not thread.is_alive()
        assert unexpected == []
        assert serial_firmware.log.motor()[-1].value == 0.0
