"""The world of an emulated car in a separate process: physics, emulated firmware and a NatNet server.

    actuator bytes (pty or CAN) ──> emulated VESC ──> plant (physics, delays) ──> NatNet server ──> UDP frames

``python -m carlab.cars.emulated_world`` runs it. The first line of standard input is the configuration, each further
line a request in JSON; each request gets one line of JSON with its "id" as the answer, except "leave", which ends the
process. If standard input ends without "leave" (the parent died), or the motor is still powered, the process waits for
the firmware's motor time-out before it ends. It ignores ^C.
"""

from __future__ import annotations

import dataclasses
import json
import os
import select
import signal
import sys
import threading
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from carlab.core.clock import MonotonicClock
from carlab.core.errors import CarlabError
from carlab.core.quantities import Action, CarState
from drivers.calibration import MOTOR_SCALES, ActuatorCalibration, MotorKind
from drivers.emulators.command_log import CommandLog
from drivers.emulators.serial_firmware import SerialFirmware
from drivers.emulators.vesc_firmware import VALUES_AT_REST, VescFirmware
from drivers.vesc.payloads import MotorValues
from mocap.emulators.faults import ServerFaults
from mocap.emulators.natnet_server import NatNetServer
from mocap.emulators.scene import EmulatedBody, RigidBodySample
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.plant import Plant
from sim_backends.sensor import MocapSensor

if TYPE_CHECKING:
    from drivers.emulators.can_firmware import CanFirmware

ERPM_PER_MPS = 3000.0
WAIT_AFTER_TIMEOUT_S = 0.5
BODY_NAME = "car"


@dataclasses.dataclass(frozen=True, slots=True)
class WorldConfig:
    """Configuration of the world. Port 0 means any free port; ``can_channel`` is GROUP or GROUP:PORT."""

    simulator: Mapping[str, Any]
    actuator: str = "serial"
    seed: int = 0
    log: str = ""
    serial_link: str = ""
    can_channel: str = ""
    command_port: int = 0
    data_port: int = 0
    mode: str = "unicast"
    bitstream: str = "4.1"
    motor_timeout_s: float = 1.0


class World:
    """Plant, firmware and NatNet server, connected to each other. ``with`` starts and stops them."""

    def __init__(self, config: WorldConfig) -> None:
        simulator = SimulatorConfig.from_tables(config.simulator, "the emulated car")
        self.config = config
        self.clock = MonotonicClock()
        self.calibration = ActuatorCalibration()
        self.log = CommandLog(Path(config.log) if config.log else None)
        self._lock = threading.Lock()
        self._plant = Plant(simulator)
        self._sensor = MocapSensor(simulator, config.seed)
        self._command = Action()
        firmware = VescFirmware(
            self.log,
            on_motor=self._on_motor,
            on_servo=self._on_servo,
            readings=self._readings,
            motor_timeout_s=config.motor_timeout_s,
        )
        self.firmware: SerialFirmware | CanFirmware
        if config.actuator == "serial":
            self.firmware = SerialFirmware(
                firmware, link=Path(config.serial_link) if config.serial_link else None, baud=115200
            )
        else:
            from drivers.emulators.can_firmware import CanFirmware  # its libraries take two fifths of the start

            self.firmware = CanFirmware(firmware, "udp_multicast", config.can_channel)
        self.server = NatNetServer(
            self._poses,
            (EmulatedBody(BODY_NAME),),
            rate_hz=simulator.mocap.rate_hz,
            mode="multicast" if config.mode == "multicast" else "unicast",
            version=config.bitstream,
            command_port=config.command_port,
            data_port=config.data_port,
            seed=config.seed,
        )
        self._stack = ExitStack()

    def __enter__(self) -> World:
        self._plant.reset(CarState(), self.clock.now_s())
        try:
            self._stack.enter_context(self.firmware)
            self._stack.enter_context(self.server)
        except BaseException:
            self._stack.close()
            raise
        return self

    def __exit__(self, *exc_info: object) -> None:
        self._stack.close()

    @property
    def addresses(self) -> dict[str, Any]:
        """Ports and channel for a host."""
        serial = isinstance(self.firmware, SerialFirmware)
        return {
            "port": self.firmware.port if isinstance(self.firmware, SerialFirmware) else "",
            "can_channel": "" if serial else self.config.can_channel,
            "command_port": self.server.command_port,
            "data_port": self.server.data_port,
            "pid": os.getpid(),
        }

    def answer(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """Execute a request; returns the answer as JSON values."""
        match request.get("do"):
            case "place":
                with self._lock:
                    now_s = self.clock.now_s()
                    self._plant.reset(CarState(*(float(v) for v in request["state"])), now_s)
                    self._command = Action()
                return {"t_s": now_s}
            case "seed":
                with self._lock:
                    self._sensor.seed(int(request["seed"]))
            case "state":
                with self._lock:
                    now_s = self.clock.now_s()
                    return {"t_s": now_s, "state": list(self._plant.advance(now_s).to_array())}
            case "log":
                since_s = float(request.get("since_s", float("-inf")))
                return {"entries": [dataclasses.astuple(e) for e in self.log.entries(since_s=since_s)]}
            case "unplug" if isinstance(self.firmware, SerialFirmware):
                self.firmware.unplug()
            case "replug" if isinstance(self.firmware, SerialFirmware):
                self.firmware.replug()
            case "wire":
                for name, value in request["faults"].items():
                    setattr(self.firmware.faults, name, value)
            case "mocap":
                self.server.faults = ServerFaults(**request["faults"])
            case other:
                return {"error": f"The emulated world has no request '{other}'; use state, for example."}
        return {"t_s": self.clock.now_s()}

    @property
    def is_driven(self) -> bool:
        """Whether the motor is powered: neither neutral nor a time-out has released it."""
        return self._command.throttle != 0.0

    def wait_for_motor_timeout(self) -> None:
        """Wait until the firmware's time-out has released the motor, like real hardware."""
        self.clock.sleep_until(self.clock.now_s() + self.config.motor_timeout_s + WAIT_AFTER_TIMEOUT_S)

    def _on_motor(self, t_s: float, kind: str, value: float) -> None:
        throttle = 0.0
        if kind in ("current", "duty"):
            motor = MotorKind.CURRENT if kind == "current" else MotorKind.DUTY
            throttle = self.calibration.throttle_of(motor, value * MOTOR_SCALES[motor])
        self._act(t_s, Action(self._command.steering, throttle))

    def _on_servo(self, t_s: float, position: float) -> None:
        self._act(t_s, Action(self.calibration.steering_of(position), self._command.throttle))

    def _act(self, t_s: float, command: Action) -> None:
        with self._lock:
            if command != self._command:
                self._command = command
                self._plant.command(t_s, command)

    def _readings(self, t_s: float) -> MotorValues:
        with self._lock:
            speed_mps = self._plant.advance(t_s).vx_mps
        return dataclasses.replace(VALUES_AT_REST, erpm=ERPM_PER_MPS * speed_mps)

    def _poses(self, t_s: float) -> Sequence[RigidBodySample | None]:
        with self._lock:
            self._plant.advance(t_s)
            sample = self._sensor.expose(t_s - self._sensor.latency_s, self._plant)
        if sample is None:
            return [None]
        return [RigidBodySample.planar(sample.t_capture_s, sample.x_m, sample.y_m, sample.yaw_rad)]


def main() -> int:
    """Serve until standard input ends."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    try:
        config = WorldConfig(**json.loads(sys.stdin.buffer.readline()))
        world = World(config)
        world.__enter__()
    except (CarlabError, OSError) as error:
        _write_answer({"error": str(error)})
        return 1
    try:
        _write_answer(world.addresses)
        pending = b""
        while True:
            select.select([0], [], [])
            data = os.read(0, 65536)
            if not data:
                break
            *lines, pending = (pending + data).split(b"\n")
            requests = [json.loads(line) for line in lines]
            if any(request.get("do") == "leave" for request in requests):
                if world.is_driven:
                    world.wait_for_motor_timeout()
                return 0
            for request in requests:
                _write_answer({**world.answer(request), "id": request.get("id")})
        world.wait_for_motor_timeout()
    finally:
        world.__exit__()
    return 0


def _write_answer(answer: Mapping[str, Any]) -> None:
    try:
        sys.stdout.write(json.dumps(answer) + "\n")
        sys.stdout.flush()
    except BrokenPipeError:
        # The parent has ended; standard input ends too.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)


if __name__ == "__main__":
    sys.exit(main())
