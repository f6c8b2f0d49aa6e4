"""Actuators and cars made of hardware. Names load on first use, so that importing this package loads nothing heavy."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from drivers.actuator import Actuator
    from drivers.calibration import ActuatorCalibration, DeviceCommand, MotorKind
    from drivers.config import ActuatorConfig, HardwareConfig
    from drivers.dry_run_car import DryRunCar
    from drivers.hardware_car import HardwareCar

_MODULES = {
    "Actuator": "actuator",
    "ActuatorCalibration": "calibration",
    "ActuatorConfig": "config",
    "DeviceCommand": "calibration",
    "DryRunCar": "dry_run_car",
    "HardwareCar": "hardware_car",
    "HardwareConfig": "config",
    "MotorKind": "calibration",
}

__all__ = [
    "Actuator",
    "ActuatorCalibration",
    "ActuatorConfig",
    "DeviceCommand",
    "DryRunCar",
    "HardwareCar",
    "HardwareConfig",
    "MotorKind",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'drivers' has no attribute '{name}'")
    return getattr(importlib.import_module(f"drivers.{_MODULES[name]}"), name)
