"""The sender's logic with a fake clock and a scripted main process."""

from __future__ import annotations

from drivers.calibration import ActuatorCalibration, DeviceCommand, MotorKind
from drivers.config import ActuatorConfig
from drivers.sender.logic import Order, Request, SenderLogic, SenderState
from drivers.vesc.payloads import FirmwareVersion, MotorValues

CONFIG = ActuatorConfig(rate_hz=100.0, watchdog_s=0.15, latch_s=0.5)
CALIBRATION = ActuatorCalibration(max_current_a=10.0, servo_min=0.2, servo_max=0.8)
NEUTRAL = DeviceCommand(MotorKind.CURRENT, 0, 500)
MOVING = DeviceCommand(MotorKind.CURRENT, 3000, 600)
HEALTHY = MotorValues(erpm=0.0, input_v=11.1, fault_code=0, status_bits=0)
VERSION = FirmwareVersion(6, 5, "TEST", b"u" * 12)


class Bench:
    """The sender's logic with a fake clock and a scripted main process."""

    def __init__(self, config: ActuatorConfig = CONFIG, calibration: ActuatorCalibration = CALIBRATION) -> None:
        self.logic = SenderLogic(config, calibration)
        self.now_s = 100.0
        self.epoch = 0
        self.number = 0
        self.request = Request.NONE
        self.is_answering = True

    def connect(self) -> Bench:
        self.logic.link_up()
        self.logic.firmware(VERSION)
        self.logic.telemetry(self.now_s, HEALTHY)
        assert self.logic.state == SenderState.CONNECTED
        return self

    def send_request(self, request: Request) -> None:
        self.epoch, self.number, self.request = self.epoch + 1, 0, request
        self.logic.order(self.now_s, Order(self.epoch, request, 0, self.now_s, NEUTRAL))

    def command(self, command: DeviceCommand = MOVING, t_issued_s: float | None = None) -> None:
        self.number += 1
        issued_s = self.now_s if t_issued_s is None else t_issued_s
        self.logic.order(self.now_s, Order(self.epoch, self.request, self.number, issued_s, command))

    def tick(self, dt_s: float = 0.01) -> DeviceCommand | None:
        self.now_s += dt_s
        if self.is_answering:
            self.logic.telemetry(self.now_s, HEALTHY)
        command = self.logic.decide(self.now_s)
        if command is not None:
            self.logic.written(self.now_s, command)
        return command


def armed() -> Bench:
    bench = Bench().connect()
    bench.send_request(Request.ARM)
    assert bench.logic.state == SenderState.ARMED
    return bench


def shut_down(bench: Bench, cause: str) -> None:
    """End the sender by a request, or by the end of the main process (``main lost``)."""
    if cause == "request":
        bench.send_request(Request.SHUT_DOWN)
    else:
        bench.logic.main_lost()
