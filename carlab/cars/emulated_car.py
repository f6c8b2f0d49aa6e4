"""A hardware car with emulators at the other end of the wire: it runs the driver code of a real car."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import select
import socket
import subprocess
import sys
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from carlab.cars.car_file import CarFile
from carlab.cars.emulated_world import BODY_NAME, WorldConfig
from carlab.core.car import Car
from carlab.core.clock import MonotonicClock
from carlab.core.errors import NotOpenError, NotReadyError
from carlab.core.quantities import Action, ActionLimits, CarState, Health, Observation, Reality
from carlab.core.state_estimator import StateEstimator
from drivers.actuator import Actuator
from drivers.calibration import ActuatorCalibration
from drivers.config import MULTICAST_GROUP, ActuatorConfig
from drivers.hardware_car import HardwareCar
from mocap.config import MocapConfig
from mocap.rigid_body import RigidBodyPoseSource
from sim_backends.car_parameters import SimulatorConfig

START_TIMEOUT_S = 30.0
ANSWER_TIMEOUT_S = 5.0
SETTLE_S = 0.15


class EmulatedWorld:
    """Client of the process with physics, emulated firmware and NatNet server; ``open`` starts the process."""

    def __init__(self, config: WorldConfig) -> None:
        self.config = config
        self.addresses: dict[str, Any] = {}
        self._process: subprocess.Popen[bytes] | None = None
        self._lock = threading.Lock()
        self._pending = b""
        self._request_id = 0

    def open(self) -> None:
        """Start the process. Raises NotReadyError if it does not start."""
        if self._process is not None:
            return
        self._pending = b""
        self._process = subprocess.Popen(
            [sys.executable, "-m", "carlab.cars.emulated_world"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
            bufsize=0,
        )
        try:
            self.addresses = self._exchange(dataclasses.asdict(self.config), START_TIMEOUT_S)
        except BaseException:
            self.close()
            raise

    def request(self, **request: Any) -> dict[str, Any]:
        """Send a request and return its answer. Raises NotOpenError, or NotReadyError without an answer."""
        self._request_id += 1
        return self._exchange({**request, "id": self._request_id}, ANSWER_TIMEOUT_S)

    def close(self) -> None:
        """End the process and wait for it. Idempotent."""
        process, self._process = self._process, None
        if process is None:
            return
        assert process.stdin is not None
        assert process.stdout is not None
        with contextlib.suppress(OSError):
            process.stdin.write(b'{"do": "leave"}\n')
        with contextlib.suppress(OSError):
            process.stdin.close()
        process.stdout.close()
        try:
            process.wait(ANSWER_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()

    def _exchange(self, request: Mapping[str, Any], timeout_s: float) -> dict[str, Any]:
        with self._lock:
            if self._process is None:
                raise NotOpenError("The emulated world is not open; open the car first.")
            assert self._process.stdin is not None
            assert self._process.stdout is not None
            try:
                self._process.stdin.write(json.dumps(request).encode() + b"\n")
                answer = json.loads(self._read_line(self._process.stdout.fileno(), timeout_s))
                while answer.pop("id", None) != request.get("id"):  # a late answer to an earlier request
                    answer = json.loads(self._read_line(self._process.stdout.fileno(), timeout_s))
            except NotReadyError:
                raise
            except (OSError, ValueError) as error:
                raise NotReadyError("The emulated car's world has ended", [str(error)]) from error
        if "error" in answer:
            raise NotReadyError("The emulated car's world", [answer["error"]])
        return dict(answer)

    def _read_line(self, descriptor: int, timeout_s: float) -> bytes:
        clock = MonotonicClock()
        deadline_s = clock.now_s() + timeout_s
        while b"\n" not in self._pending:
            ready, _, _ = select.select([descriptor], [], [], max(deadline_s - clock.now_s(), 0.0))
            data = os.read(descriptor, 65536) if ready else b""
            if not data:
                reason = "it has ended" if ready else f"no answer within {timeout_s:g} s"
                raise NotReadyError("The emulated car's world does not answer", [f"{reason}; see the lines above."])
            self._pending += data
        line, self._pending = self._pending.split(b"\n", 1)
        return line


class EmulatedCar(Car):
    """``HardwareCar`` over a pty or CAN bus and NatNet on loopback, with the emulated world at the other end.

    Args:
        file: car file with the physics and motion capture of the world.
        actuator: ``serial`` or ``can``.
        seed: seed of the motion capture's noise.
        reality: physics and motion capture of the world if they differ from the file's; the driver knows the file only.
        actuator_options: further options of the actuator (rates, watchdog ...).
    """

    reality = Reality.EMULATED

    def __init__(
        self,
        file: CarFile,
        *,
        actuator: str = "serial",
        seed: int = 0,
        reality: SimulatorConfig | None = None,
        actuator_options: Mapping[str, Any] | None = None,
    ) -> None:
        self.name = f"{file.name} ({actuator})"
        self.limits = ActionLimits()
        self.clock = MonotonicClock()
        self._actuator = actuator
        self._actuator_options = dict(actuator_options or {})
        physics = (reality or file.simulator).to_tables()
        self._config = WorldConfig(simulator=physics, actuator=actuator, seed=seed)
        self._world: EmulatedWorld | None = None
        self._car: HardwareCar | None = None

    def log_to(self, folder: Path) -> None:
        """Write the firmware's log of commands and events to ``firmware.jsonl`` in a folder."""
        self._config = dataclasses.replace(self._config, log=str(folder / "firmware.jsonl"))

    @property
    def world(self) -> EmulatedWorld:
        """The process with the emulators, for requests of its log or of faults. Raises NotOpenError."""
        if self._world is None:
            raise NotOpenError(f"{self.name} is not open; call open() first, or use it in a with block.")
        return self._world

    @property
    def hardware(self) -> HardwareCar:
        """The hardware car of the driver. Raises NotOpenError."""
        if self._car is None:
            raise NotOpenError(f"{self.name} is not open; call open() first, or use it in a with block.")
        return self._car

    def open(self) -> None:
        """Start the world, then connect to it like to real hardware."""
        if self._car is not None:
            return
        if self._actuator == "can" and not self._config.can_channel:
            self._config = dataclasses.replace(self._config, can_channel=f"{MULTICAST_GROUP}:{free_udp_port()}")
        self._world = EmulatedWorld(self._config)
        try:
            self._world.open()
            self._car = self._driver(self._world.addresses)
            self._car.open()
        except BaseException:
            self.close()
            raise

    def _driver(self, addresses: Mapping[str, Any]) -> HardwareCar:
        """Create the hardware car for the addresses of the world."""
        options: dict[str, Any] = {"kind": "vesc_serial", "port": addresses["port"]}
        if self._actuator == "can":
            options = {"kind": "vesc_can", "interface": "udp_multicast", "channel": addresses["can_channel"]}
        mocap = MocapConfig(command_port=addresses["command_port"], local_interface="127.0.0.1", body=BODY_NAME)
        return HardwareCar(
            self.name,
            Actuator(ActuatorConfig(**(options | self._actuator_options)), ActuatorCalibration()),
            RigidBodyPoseSource(mocap),
            StateEstimator(),
            reality=Reality.EMULATED,
            place=self._place,
        )

    def observe(self) -> Observation:
        """Observe by the driver."""
        return self.hardware.observe()

    def arm(self) -> None:
        """Arm the driver."""
        self.hardware.arm()

    def command(self, action: Action) -> Action:
        """Command by the driver."""
        return self.hardware.command(action)

    def stop(self, *, planned: bool) -> None:
        """Stop by the driver."""
        if self._car is not None:
            self._car.stop(planned=planned)

    def reset_fault(self) -> None:
        """Reset a fault of the driver."""
        self.hardware.reset_fault()

    def health(self) -> Health:
        """Health of the driver."""
        return Health(False, (f"{self.name} is not open.",)) if self._car is None else self._car.health()

    @property
    def watchdog_trips(self) -> int:
        """Trips of the driver's watchdog since ``open``; 0 when closed."""
        return 0 if self._car is None else self._car.watchdog_trips

    def pose_problems(self) -> tuple[str, ...]:
        """Suspected errors of the driver's motion capture; empty when closed."""
        return () if self._car is None else self._car.pose_problems()

    def place(self, state: CarState) -> bool:
        """Put the car at ``state`` and wait until no pose of the old place is in a velocity window."""
        placed = self.hardware.place(state)
        if placed:
            self.clock.sleep_until(self.clock.now_s() + SETTLE_S)
            self.hardware.observe()
        return placed

    def seed_noise(self, seed: int) -> None:
        """Restart the random numbers of the emulated motion capture with a seed."""
        self.world.request(do="seed", seed=seed)

    def close(self) -> None:
        """Send neutral, disconnect, and end the world."""
        car, self._car = self._car, None
        try:
            if car is not None:
                car.close()
        finally:
            if self._world is not None:
                self._world.close()
                self._world = None

    def _place(self, state: CarState) -> bool:
        self.world.request(do="place", state=list(state.to_array()))
        return True


def free_udp_port() -> int:
    """A UDP port that is currently free."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
