"""A second protocol: lines of text over a pseudo-terminal. A codec, a device, fake firmware and a registry entry."""

from __future__ import annotations

import os
import select
import threading
import time
import tty
from dataclasses import dataclass, replace

from drivers.calibration import DeviceCommand
from drivers.config import ActuatorConfig
from drivers.device import DeviceCounters, FirmwareIdentity, Reply
from drivers.device_kinds import DeviceKind
from drivers.links.serial_link import SerialLink

TOY = DeviceKind(factory="toy_protocol:make_device", name="Toy", silent_hint="switch the toy on.")
MOTOR_TIMEOUT_S = 0.3


@dataclass(frozen=True)
class ToyTelemetry:
    """Telemetry of the toy: it measures speed and voltage and has one fault."""

    erpm: float | None = None
    input_v: float | None = None
    fault_code: int | None = None
    tachometer_steps: float | None = None
    motor_timeout_active: bool | None = None

    def fault(self) -> str:
        return "the toy is too hot; let it cool, then reset the fault." if self.fault_code else ""

    def updated(self, newer: ToyTelemetry) -> ToyTelemetry:
        return replace(newer)


def encode_command(command: DeviceCommand) -> bytes:
    """``M <kind> <motor steps> <servo steps>``."""
    return f"M {int(command.motor_kind)} {command.motor_steps} {command.servo_steps}\n".encode()


def decode_reply(line: str) -> Reply:
    """``F <major> <minor>`` or ``T <erpm> <mV> <fault>``."""
    kind, *numbers = line.split()
    if kind == "F":
        return FirmwareIdentity(int(numbers[0]), int(numbers[1]), "toy", b"toy")
    return ToyTelemetry(float(numbers[0]), int(numbers[1]) / 1e3, int(numbers[2]))


class ToyDevice:
    """The toy on a serial line."""

    def __init__(self, link: SerialLink) -> None:
        self.link = link
        self.counters = DeviceCounters()
        self._buffer = b""

    def open(self) -> None:
        self._buffer = b""
        self.link.open()

    def send(self, command: DeviceCommand) -> None:
        self.link.write(encode_command(command))

    def request_firmware(self) -> None:
        self.link.write(b"?F\n")

    def request_telemetry(self) -> None:
        self.link.write(b"?T\n")

    def receive(self, now_s: float) -> list[Reply]:
        *lines, self._buffer = (self._buffer + self.link.read()).split(b"\n")
        return [decode_reply(line.decode()) for line in lines]

    def fileno(self) -> int | None:
        return self.link.fileno()

    def close(self) -> None:
        self.link.close()


def make_device(config: ActuatorConfig) -> ToyDevice:
    """The toy device at the configured port."""
    return ToyDevice(SerialLink(config.port, config.baud))


class ToyFirmware:
    """Fake firmware on a pseudo-terminal; releases the motor after ``MOTOR_TIMEOUT_S`` without a command."""

    def __init__(self) -> None:
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        self.port = os.ttyname(self._slave)
        self.commands: list[tuple[float, int, int, int]] = []
        self.motor_steps = 0
        self.fault_code = 0
        self._t_command_s = 0.0
        self._is_running = True
        self._thread = threading.Thread(target=self._serve)

    def __enter__(self) -> ToyFirmware:
        self._thread.start()
        return self

    def __exit__(self, *exc_info: object) -> None:
        self._is_running = False
        self._thread.join()
        os.close(self._master)
        os.close(self._slave)

    def _serve(self) -> None:
        buffer = b""
        while self._is_running:
            if select.select([self._master], [], [], 0.01)[0]:
                *lines, buffer = (buffer + os.read(self._master, 4096)).split(b"\n")
                for line in lines:
                    self._handle(line.decode())
            if time.monotonic() - self._t_command_s > MOTOR_TIMEOUT_S:
                self.motor_steps = 0

    def _handle(self, line: str) -> None:
        if line == "?F":
            os.write(self._master, b"F 1 0\n")
        elif line == "?T":
            os.write(self._master, f"T {self.motor_steps} 7400 {self.fault_code}\n".encode())
        else:
            kind, motor, servo = map(int, line.split()[1:])
            self._t_command_s = time.monotonic()
            self.motor_steps = motor
            self.commands.append((self._t_command_s, kind, motor, servo))
