"""A second protocol with the unchanged sender and actuator: process, arming, faults and neutral."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
import toy_protocol
from patient_config import patient_config
from toy_protocol import ToyFirmware

from carlab.core.errors import ActuatorFaultError, ConfigError, NotReadyError
from carlab.core.quantities import Action
from drivers.actuator import Actuator
from drivers.calibration import ActuatorCalibration
from drivers.config import ActuatorConfig
from drivers.device_kinds import DEVICE_KINDS
from drivers.sender.process import SenderProcess
from tests.helpers.waiting import until

CALIBRATION = ActuatorCalibration(max_current_a=10.0)
MOVING = Action(0.5, 0.3)


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(DEVICE_KINDS, "toy", toy_protocol.TOY)
    folder = str(Path(toy_protocol.__file__).parent)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(p for p in (folder, os.environ.get("PYTHONPATH", "")) if p))


@pytest.fixture
def firmware() -> Iterator[ToyFirmware]:
    with ToyFirmware() as served:
        yield served


def config_for(port: str) -> ActuatorConfig:
    return patient_config(kind="toy", port=port)


def test_commands_reach_the_firmware_and_stop_ends_in_neutral(firmware: ToyFirmware) -> None:
    with Actuator(config_for(firmware.port), CALIBRATION) as actuator:
        assert isinstance(actuator._sender, SenderProcess)
        until(lambda: len(firmware.commands) > 3)
        assert all(command[1:] == (0, 0, 500) for command in list(firmware.commands)), "neutral before arming"
        actuator.arm()
        sent = actuator.command(MOVING)
        assert sent.steering == pytest.approx(0.5)
        assert sent.throttle == pytest.approx(0.3)
        until(lambda: firmware.commands[-1][1:] == (0, 3000, 650))
        until(lambda: actuator.health().readings["motor_erpm"] == 3000.0)
        assert actuator.health().readings["battery_v"] == pytest.approx(7.4)
        actuator.stop(planned=True)
        until(lambda: firmware.motor_steps == 0)
        assert [command[2] for command in firmware.commands[-3:]] == [0, 0, 0]


def test_firmware_fault_latches_with_its_message(firmware: ToyFirmware) -> None:
    with Actuator(config_for(firmware.port), CALIBRATION) as actuator:
        actuator.arm()
        actuator.command(MOVING)
        until(lambda: firmware.motor_steps == 3000)
        firmware.fault_code = 1
        until(lambda: firmware.motor_steps == 0)
        with pytest.raises(ActuatorFaultError, match="too hot"):
            actuator.command(MOVING)


@pytest.mark.realtime
def test_motor_stops_after_the_sender_is_killed(firmware: ToyFirmware) -> None:
    with Actuator(config_for(firmware.port), CALIBRATION) as actuator:
        actuator.arm()
        actuator.command(MOVING)
        until(lambda: firmware.motor_steps == 3000)
        assert actuator._sender is not None
        os.kill(actuator._sender.pid, signal.SIGKILL)  # type: ignore[attr-defined]
        until(lambda: firmware.motor_steps == 0)
        with pytest.raises(ActuatorFaultError, match="the Toy's own time-out stops the motor"):
            actuator.command(MOVING)


def test_missing_device_is_reported_with_the_remedy_of_the_protocol() -> None:
    master, slave = os.openpty()
    try:
        with pytest.raises(NotReadyError, match=r"The Toy at .* switch the toy on"):
            Actuator(config_for(os.ttyname(slave)), CALIBRATION).open()
    finally:
        os.close(master)
        os.close(slave)


def test_unknown_kind_is_refused_with_a_list_of_the_known_kinds() -> None:
    with pytest.raises(ConfigError, match="'vesk'; it must be one of vesc_serial, vesc_can, toy"):
        ActuatorConfig("vesk")
