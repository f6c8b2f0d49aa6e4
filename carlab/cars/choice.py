"""The cars of ``--car``: sim, emulated, emulated-can, a plug-in, a preset, or a car file."""

from __future__ import annotations

import importlib.metadata
import logging
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

from carlab.cars.car_file import CarFile, default_car, is_preset, read_car
from carlab.core.car import Car
from carlab.core.errors import CarlabError, ConfigError
from carlab.core.geofence import stopping_distance_m
from carlab.core.quantities import Action, ActionLimits, CarState, Reality
from carlab.core.safety import SafetyEnvelope
from carlab.core.state_estimator import StateEstimator
from carlab.core.track import Track
from drivers.config import ActuatorConfig
from sim_backends.car_parameters import SimulatorConfig, preset_names
from sim_backends.plant import Plant
from sim_backends.simulated_car import SimulatedCar

_LOG = logging.getLogger(__name__)
PLUGIN_GROUP = "carlab.cars"
WATCHDOG_PERIODS = 2.0
"""Minimum ratio of the watchdog to the control period, and of the latch to the watchdog, of a car without hardware."""
COASTING_S = 10.0
COASTING_STEP_S = 0.02
"""Duration and step of the simulation of a coasting car [s]."""
COASTING_MARGIN_M = 0.1
"""Largest distance [m] by which a car may coast further than the geofence assumes, without a warning."""


@dataclass(slots=True)
class CarChoice:
    """A car that is built but not open, with the settings for an episode.

    ``log_to`` sets the folder for the firmware log of an emulated car; other cars ignore it. ``as_sent`` maps an
    action to the action that the car would send (rounded by the calibration), for a dry run. ``track`` is that of the
    car file. ``watchdog_s`` is the age of a command at which the car replaces it by neutral [s]; None if unknown.
    """

    car: Car
    simulator: SimulatorConfig
    envelope: SafetyEnvelope
    config_toml: str
    log_to: Callable[[Path], None] = field(default=lambda folder: None)
    as_sent: Callable[[Action], Action] | None = None
    track: Track | None = None
    watchdog_s: float | None = None

    @property
    def control_period_s(self) -> float:
        """Period of the control loop [s]."""
        return self.simulator.control_period_s


def choose_car(
    name: str | Path | CarFile,
    *,
    vehicle: str | Path | CarFile | None = None,
    reality: str | Path | CarFile | None = None,
    dry_run: bool = False,
    seed: int = 0,
    is_driven: bool = True,
) -> CarChoice:
    """Build the car of ``--car`` without opening it.

    Args:
        name: sim, emulated, emulated-can, the name of a plug-in (entry point group ``carlab.cars``: a callable that
            takes a CarFile and a seed and returns a CarChoice), a preset (simulated),
            the path of a car file (``str`` or ``Path``), or a car file that was read.
        vehicle: car file whose physics sim, emulated and plug-ins use; the default car without it.
        reality: car file with the true physics of a simulated or emulated car, while ``CarChoice.simulator`` and the
            recordings keep the parameters of the other file; by default the same file.
        dry_run: discard commands.
        seed: of the sensors' noise.
        is_driven: whether commands are sent to the car; a simulator that only predicts has no watchdog.

    Raises:
        ConfigError: unknown car, an error in its file, or a control period that its watchdog does not permit.
    """
    choice = _choose(name, vehicle, reality, seed)
    if is_driven:
        _check_watchdog(choice)
        _warn_of_coasting(choice)
    if dry_run:
        from drivers.dry_run_car import DryRunCar

        choice.car = DryRunCar(choice.car, choice.as_sent)
    return choice


def _choose(
    name: str | Path | CarFile, vehicle: str | Path | CarFile | None, reality: str | Path | CarFile | None, seed: int
) -> CarChoice:
    truth = None if reality is None else read_car(reality, "--reality").simulator
    plugins = {point.name: point for point in importlib.metadata.entry_points(group=PLUGIN_GROUP)}
    if isinstance(name, str) and name in BUILT_IN:
        return BUILT_IN[name](default_car() if vehicle is None else read_car(vehicle, "--vehicle"), seed, truth)
    if isinstance(name, str) and name in plugins:
        if truth is not None:
            raise ConfigError(f"--reality needs a simulated or emulated car; '{name}' is a plug-in. Remove --reality.")
        return _from_plugin(plugins[name], default_car() if vehicle is None else read_car(vehicle, "--vehicle"), seed)
    if vehicle is not None:
        raise ConfigError(f"--vehicle needs --car sim or emulated; '{_name_of(name)}' has its own physics.")
    if isinstance(name, str):
        path = Path(name)
        if path.suffix != ".toml" and not path.exists() and not is_preset(path):
            raise ConfigError(
                f"There is no car '{name}'; name one of {', '.join([*BUILT_IN, *plugins, *preset_names()])}, "
                "or a FILE.toml."
            )
    file = read_car(name)
    if file.real is None:
        return _simulated(file, seed, truth)
    if truth is not None:
        raise ConfigError(f"--reality needs a simulated or emulated car; '{_name_of(name)}' is real. Remove --reality.")
    return _real(file, seed)


def _from_plugin(point: importlib.metadata.EntryPoint, file: CarFile, seed: int) -> CarChoice:
    """The car of another package. Raises ConfigError if its function fails or returns something else."""
    try:
        choice = point.load()(file, seed)
    except CarlabError:
        raise
    except Exception as error:
        _LOG.debug("The car of another package failed.", exc_info=True)
        raise ConfigError(
            f"The car '{point.name}' cannot be made: {point.value} failed with {type(error).__name__}: {error}. With "
            "--verbose carlab prints where."
        ) from error
    if not isinstance(choice, CarChoice):
        raise ConfigError(
            f"The car '{point.name}' cannot be made: {point.value} returned an object of type "
            f"{type(choice).__name__}; return a carlab.cars.CarChoice."
        )
    return choice


def _check_watchdog(choice: CarChoice) -> None:
    """Raise ConfigError if the watchdog sets neutral within each tick: recordings would contain commands not held."""
    period_s, watchdog_s = choice.control_period_s, choice.watchdog_s
    if watchdog_s is not None and not period_s < watchdog_s:
        raise ConfigError(
            f"control_period in [timing] is {period_s:g} s, but the watchdog sets neutral {watchdog_s:g} s after a "
            f"command, within each tick; set a control_period below {watchdog_s:g} s, or a longer watchdog_s (and "
            "latch_s) in [hardware.actuator]."
        )


def _warn_of_coasting(choice: CarChoice) -> None:
    """Warn if a real car that does not brake in neutral coasts further than the geofence assumes, by its car file."""
    from drivers.hardware_car import HardwareCar

    car, envelope = choice.car, choice.envelope
    if not isinstance(car, HardwareCar) or car.config.calibration.neutral_brake_a > 0.0:
        return
    plant = Plant(choice.simulator)
    plant.reset(CarState(vx_mps=envelope.max_speed_mps), 0.0)
    try:
        states = [plant.advance(t_s) for t_s in np.arange(0.0, COASTING_S, COASTING_STEP_S).tolist()]
    except (OverflowError, ValueError):  # A simulator that diverges is no prediction of the car.
        return
    speed_mps = np.array([state.vx_mps for state in states])
    coasts_m = states[-1].x_m - np.array([state.x_m for state in states]) + speed_mps * choice.simulator.command_delay_s
    assumed_m = stopping_distance_m(speed_mps, envelope.reaction_s, envelope.deceleration_mps2)
    worst = int(np.argmax(coasts_m - assumed_m))
    if coasts_m[worst] - assumed_m[worst] > COASTING_MARGIN_M:
        _LOG.warning(
            "In neutral the car coasts: by its file %.1f m from %.1f m/s, but the geofence assumes %.1f m. Set "
            "neutral_brake_a in [hardware.calibration], so that neutral brakes, or lower deceleration_mps2 or raise "
            "reaction_s in [hardware.limits].",
            coasts_m[worst],
            speed_mps[worst],
            assumed_m[worst],
        )


def _name_of(car: str | Path | CarFile) -> str:
    return car.name if isinstance(car, CarFile) else str(car)


def _config_toml(file: CarFile, car: str) -> str:
    return f"# --car {car}\n{file.text}"


def _simulated(file: CarFile, seed: int, truth: SimulatorConfig | None = None) -> CarChoice:
    watchdog_s = _actuator(file).watchdog_s
    # The period of the control loop is that of the car file.
    simulator = replace(truth or file.simulator, control_period_s=file.simulator.control_period_s)
    car = SimulatedCar(simulator, seed=seed, name=file.name, watchdog_s=watchdog_s)
    text = _config_toml(file, "sim")
    return CarChoice(car, file.simulator, _envelope(file), text, track=file.track, watchdog_s=watchdog_s)


def _emulated(file: CarFile, seed: int, truth: SimulatorConfig | None = None, actuator: str = "serial") -> CarChoice:
    from carlab.cars.emulated_car import EmulatedCar

    config = _actuator(file)
    deadlines = {"rate_hz": config.rate_hz, "watchdog_s": config.watchdog_s, "latch_s": config.latch_s}
    car = EmulatedCar(file, actuator=actuator, seed=seed, reality=truth, actuator_options=deadlines)
    return CarChoice(
        car,
        file.simulator,
        _envelope(file),
        _config_toml(file, "emulated" if actuator == "serial" else "emulated-can"),
        car.log_to,
        track=file.track,
        watchdog_s=config.watchdog_s,
    )


def _real(file: CarFile, seed: int) -> CarChoice:
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
        track=file.track,
        watchdog_s=real.hardware.actuator.watchdog_s,
    )


def _actuator(file: CarFile) -> ActuatorConfig:
    """The actuator of the real car, whose deadlines its simulation and emulation share.

    Without a real car the default one, with deadlines longer than the control period.
    """
    if file.real is not None:
        return file.real.hardware.actuator
    default, period_s = ActuatorConfig(), file.simulator.control_period_s
    watchdog_s = max(default.watchdog_s, WATCHDOG_PERIODS * period_s)
    return replace(default, watchdog_s=watchdog_s, latch_s=max(default.latch_s, WATCHDOG_PERIODS * watchdog_s))


def _envelope(file: CarFile) -> SafetyEnvelope:
    return SafetyEnvelope() if file.real is None else file.real.envelope


BUILT_IN: dict[str, Callable[[CarFile, int, SimulatorConfig | None], CarChoice]] = {
    "sim": _simulated,
    "emulated": _emulated,
    "emulated-can": partial(_emulated, actuator="can"),
}
