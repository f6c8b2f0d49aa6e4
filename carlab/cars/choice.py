"""``--car sim``, ``emulated``, ``emulated-can``, a plug-in, the name of a car that comes along, or a car file."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from carlab.cars.car_file import CarFile, default_car, is_preset, load_car_file
from carlab.core.car import Car
from carlab.core.errors import ConfigError
from carlab.core.quantities import Action, ActionLimits, Reality
from carlab.core.safety import SafetyEnvelope
from sim_backends.car_parameters import preset_names

if TYPE_CHECKING:
    from sim_backends.car_parameters import SimulatorConfig

PLUGIN_GROUP = "carlab.cars"


@dataclass(slots=True)
class CarChoice:
    """A car that is built and not yet open, with what an episode on it needs to know.

    ``log_to`` tells an emulated car where to write what its firmware saw; others ignore it. ``as_sent`` is what the
    wire would make of an action, for a dry run.
    """

    car: Car
    simulator: SimulatorConfig
    envelope: SafetyEnvelope
    config_toml: str
    log_to: Callable[[Path], None] = field(default=lambda folder: None)
    as_sent: Callable[[Action], Action] | None = None

    @property
    def control_period_s(self) -> float:
        """Period of the control loop [s]."""
        return self.simulator.control_period_s


def choose_car(
    name: str, *, vehicle: Path | None = None, dry_run: bool = False, seed: int = 0, log_folder: Path | None = None
) -> CarChoice:
    """Build the car that ``--car`` names; nothing is opened.

    Args:
        name: sim, emulated, emulated-can, the name of a plug-in (entry point group ``carlab.cars``: a callable that
            takes a CarFile and a seed and returns a CarChoice), a car that comes with the package (simulated), or
            the path of a car file.
        vehicle: car file whose physics sim, emulated and plug-ins use; the default car without it.
        dry_run: swallow commands.
        seed: of the sensors' noise.
        log_folder: where an emulated car writes its log.

    Raises:
        ConfigError: there is no such car, or its file is wrong.
    """
    plugins = {point.name: point for point in importlib.metadata.entry_points(group=PLUGIN_GROUP)}
    if name in BUILT_IN:
        choice = BUILT_IN[name](default_car() if vehicle is None else load_car_file(vehicle), seed)
    elif name in plugins:
        choice = plugins[name].load()(default_car() if vehicle is None else load_car_file(vehicle), seed)
    else:
        if vehicle is not None:
            raise ConfigError(f"--vehicle goes with --car sim or emulated; '{name}' is a car of its own.")
        path = Path(name)
        if path.suffix != ".toml" and not path.exists() and not is_preset(path):
            raise ConfigError(
                f"There is no car '{name}'; name one of {', '.join([*BUILT_IN, *plugins, *preset_names()])}, "
                "or a FILE.toml."
            )
        file = load_car_file(path)
        choice = _real(file, seed) if file.real is not None else _simulated(file, seed)
    if log_folder is not None:
        choice.log_to(log_folder)
    if dry_run:
        from drivers.dry_run_car import DryRunCar

        choice.car = DryRunCar(choice.car, choice.as_sent)
    return choice


def _config_toml(file: CarFile, car: str) -> str:
    import tomli_w

    return f"# --car {car}\n" + (file.text or tomli_w.dumps(file.simulator.to_tables()))


def _simulated(file: CarFile, seed: int) -> CarChoice:
    from sim_backends.simulated_car import SimulatedCar

    car = SimulatedCar(file.simulator, seed=seed, name=file.name)
    return CarChoice(car, file.simulator, _envelope(file), _config_toml(file, "sim"))


def _emulated(file: CarFile, seed: int, actuator: str = "serial") -> CarChoice:
    from carlab.cars.emulated_car import EmulatedCar

    car = EmulatedCar(file, actuator=actuator, seed=seed)
    name = "emulated" if actuator == "serial" else "emulated-can"
    return CarChoice(car, file.simulator, _envelope(file), _config_toml(file, name), car.log_to)


def _emulated_can(file: CarFile, seed: int) -> CarChoice:
    return _emulated(file, seed, "can")


def _real(file: CarFile, seed: int) -> CarChoice:
    from carlab.core.state_estimator import StateEstimator
    from drivers.actuator import Actuator
    from drivers.hardware_car import HardwareCar
    from mocap.rigid_body import RigidBodyPoseSource

    real = file.real
    assert real is not None
    car = HardwareCar(
        real.name,
        Actuator(real.hardware.actuator, real.hardware.calibration),
        RigidBodyPoseSource(real.mocap),
        StateEstimator(),
        config=real.hardware,
        reality=Reality.REAL,
        limits=ActionLimits(real.envelope.max_steering, real.envelope.max_throttle),
    )
    calibration = real.hardware.calibration
    return CarChoice(
        car,
        file.simulator,
        real.envelope,
        _config_toml(file, real.name),
        as_sent=lambda action: calibration.from_device(calibration.to_device(action)),
    )


def _envelope(file: CarFile) -> SafetyEnvelope:
    return SafetyEnvelope() if file.real is None else file.real.envelope


BUILT_IN: dict[str, Callable[[CarFile, int], CarChoice]] = {
    "sim": _simulated,
    "emulated": _emulated,
    "emulated-can": _emulated_can,
}
