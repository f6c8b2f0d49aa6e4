"""Simulated cars: parameters, physics, effects, sensors. Importing the package imports no array library but NumPy."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sim_backends.batch.rollout import Rollout, rollout
    from sim_backends.car_parameters import CarParameters, MocapParameters, SimulatorConfig, preset_names
    from sim_backends.effects import EFFECTS
    from sim_backends.plant import Plant
    from sim_backends.registry import REGISTRY, ParameterInfo, register, registered
    from sim_backends.sensor import MocapSensor
    from sim_backends.simulated_car import SimulatedCar

__all__ = [
    "EFFECTS",
    "REGISTRY",
    "CarParameters",
    "MocapParameters",
    "MocapSensor",
    "ParameterInfo",
    "Plant",
    "Rollout",
    "SimulatedCar",
    "SimulatorConfig",
    "preset_names",
    "register",
    "registered",
    "rollout",
]

_MODULES = {
    "CarParameters": "car_parameters",
    "MocapParameters": "car_parameters",
    "SimulatorConfig": "car_parameters",
    "preset_names": "car_parameters",
    "EFFECTS": "effects",
    "Plant": "plant",
    "REGISTRY": "registry",
    "ParameterInfo": "registry",
    "register": "registry",
    "registered": "registry",
    "Rollout": "batch.rollout",
    "rollout": "batch.rollout",
    "MocapSensor": "sensor",
    "SimulatedCar": "simulated_car",
}


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return getattr(importlib.import_module(f"sim_backends.{_MODULES[name]}"), name)
    raise AttributeError(f"module 'sim_backends' has no attribute '{name}'")
