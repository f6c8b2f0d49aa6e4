"""``carlab emulate``."""

from __future__ import annotations

import ipaddress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from rich.text import Text

from carlab.api.arguments import valid_seed
from carlab.cli.console import console
from carlab.cli.options import arguments_of, log_file
from carlab.core.errors import ConfigError, NotReadyError
from carlab.experiment.episodes.interrupts import Interrupts
from drivers.calibration import ActuatorCalibration


@dataclass
class Emulate:
    """Run emulated hardware as a process: a VESC and a NatNet server that share one simulated car.

    The VESC is on a pseudo-terminal or a CAN bus. Any program with these protocols can use the hardware; carlab uses it
    with a car file that has the printed tables. It runs until ^C.
    """

    actuator: Literal["serial", "can"] = "serial"
    """A VESC on a pseudo-terminal, or on a CAN bus (python-can udp_multicast on this host)."""

    port: Path = Path("carlab-vesc")
    """Name of the serial port: a link to the pseudo-terminal."""

    can_channel: str = "239.74.163.2:43113"
    """Group and port of the CAN bus."""

    vehicle: Path | None = None
    """Car file for physics and motion capture; by default the default car's."""

    mode: Literal["unicast", "multicast"] = "unicast"
    """Transmission type of NatNet frames."""

    bitstream: str = "4.1"
    """NatNet bitstream version: 3.0, 3.1, 4.0 or 4.1."""

    command_port: int = 1510
    """NatNet command port; 0 for any."""

    data_port: int = 1511
    """NatNet data port; 0 for any."""

    seed: int = 0
    """Seed of the sensor noise."""

    log: Path | None = None
    """Append each command that the firmware receives to this file as a JSON line; its folder must exist."""

    verbose: bool = False
    """Show the whole log."""

    def run(self) -> int:
        """Serve until interrupted."""
        import tomli_w

        from carlab.cars import default_car, load_car_file
        from carlab.cars.emulated_world import BODY_NAME, World, WorldConfig

        self._check_options()
        valid_seed(seed=self.seed)
        file = default_car() if self.vehicle is None else load_car_file(self.vehicle)
        paths = {
            "log": "" if self.log is None else str(self.log),
            "serial_link": str(self.port.absolute()) if self.actuator == "serial" else "",
        }
        config = WorldConfig(file.simulator.to_tables(), **arguments_of(self, WorldConfig) | paths)
        with Interrupts() as interrupts, World(config) as world:
            addresses = world.addresses
            console.print(Text("EMULATED", "bold"), " Car file for a program on this host:")
            actuator = {"kind": "vesc_serial", "port": addresses["port"]}
            if self.actuator == "can":
                channel = addresses["can_channel"]
                actuator = {"kind": "vesc_can", "interface": "udp_multicast", "channel": channel}
            mocap = {"server_address": "127.0.0.1", "local_interface": "127.0.0.1", "mode": self.mode}
            mocap |= {"command_port": addresses["command_port"], "body": BODY_NAME}
            hardware = {"actuator": actuator, "mocap": mocap, "calibration": asdict(ActuatorCalibration())}
            console.print(tomli_w.dumps({"hardware": hardware}).rstrip(), soft_wrap=True)
            console.print("^C ends it.")
            while not interrupts.requested.wait(0.2):
                pass
        return 0

    def _check_options(self) -> None:
        if self.log is not None:
            log_file(self.log, "--log")
        for name, port in (("command-port", self.command_port), ("data-port", self.data_port)):
            if not 0 <= port <= 65535:
                raise ConfigError(f"--{name} {port}: give a number from 0 to 65535.")
        if self.actuator == "can":
            group, _, number = self.can_channel.partition(":")
            try:
                is_valid = ipaddress.IPv4Address(group).is_multicast and 0 < int(number or 1) <= 65535
            except ValueError:
                is_valid = False
            if not is_valid:
                raise ConfigError(
                    f"--can-channel {self.can_channel}: give GROUP or GROUP:PORT such as 239.74.163.2:43113."
                )
        elif not self.port.absolute().parent.is_dir():
            raise ConfigError(f"--port {self.port}: its folder does not exist; create it or choose another one.")
        elif self.port.exists():
            # A dangling link of a killed process does not count as existing and is replaced.
            raise NotReadyError(
                f"--port {self.port}", ["it exists already, perhaps of another carlab emulate; choose another name."]
            )
