"""Simulated cars: parameters, physics, effects, sensors. Importing the package imports no array library but NumPy."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sim_backends.car_parameters import CarParameters, MocapParameters, SimulatorConfig, preset_names
from sim_backends.effects import EFFECTS
from sim_backends.plant import Plant
from sim_backends.registry import REGISTRY, ParameterInfo, register, registered
from sim_backends.sensor import MocapSensor
from sim_backends.simulated_car import SimulatedCar

if TYPE_CHECKING:
    from sim_backends.batch.rollout import Rollout, rollout

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


def __getattr__(name: str) -> Any:
    """Import the batched simulator when it is first used, since torch loads slowly."""
    if name not in ("Rollout", "rollout"):
        raise AttributeError(f"module 'sim_backends' has no attribute '{name}'")
    from sim_backends.batch import rollout as module

    return getattr(module, name)
