"""Nominal and true car: parameters of the base model, which differ by up to 10 %."""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tomli_w

Kind = Literal["dynamic", "linear_tyre", "kinematic", "blend"]
GRAVITY_MPS2 = 9.81

FREE = {
    "vehicle.yaw_inertia": "yaw_inertia",
    "tyre.front.B": "b_front",
    "tyre.front.C": "c_front",
    "tyre.front.mu": "mu_front",
    "tyre.rear.B": "b_rear",
    "tyre.rear.C": "c_rear",
    "tyre.rear.mu": "mu_rear",
    "motor.drive_gain": "drive_gain",
    "motor.damping": "damping",
    "steering.max_angle": "max_angle",
}
"""Base parameters that a refit may change, by dotted name; the others are measured and fixed."""
FIELD_BY_NAME = {
    "vehicle.mass": "mass",
    "vehicle.yaw_inertia": "yaw_inertia",
    "vehicle.front_axle": "front_axle",
    "vehicle.rear_axle": "rear_axle",
    **FREE,
    "timing.control_period": "control_period",
    "timing.command_delay": "command_delay",
    "model.kind": "kind",
    "mocap.rate": "mocap_rate",
    "mocap.position_std": "position_std",
    "mocap.yaw_std": "yaw_std",
    "mocap.latency": "latency",
}
"""All parameters by dotted name, in the order of the car file."""


@dataclass(frozen=True)
class BaseCar:
    """Parameters of the single-track model; B [1/rad] and C [1] are Pacejka's stiffness and shape factor.

    Units: mass [kg], yaw_inertia [kg m2], axles [m] from the centre of mass, drive_gain [N], damping [N s/m], max_angle
    [rad], control_period, command_delay and latency [s], mocap_rate [Hz], position_std [m], yaw_std [rad].
    """

    mass: float = 1.65
    yaw_inertia: float = 0.06
    front_axle: float = 0.13
    rear_axle: float = 0.17
    b_front: float = 2.75
    c_front: float = 1.45
    mu_front: float = 0.43
    b_rear: float = 5.0
    c_rear: float = 1.3
    mu_rear: float = 0.42
    drive_gain: float = 8.2
    damping: float = 1.56
    max_angle: float = 0.6
    control_period: float = 1.0 / 30.0
    command_delay: float = 0.08
    kind: Kind = "dynamic"
    mocap_rate: float = 120.0
    position_std: float = 0.0006
    yaw_std: float = 0.002
    latency: float = 0.008

    @property
    def wheelbase(self) -> float:
        """Distance between the axles [m]."""
        return self.front_axle + self.rear_axle

    @property
    def load_front(self) -> float:
        """Static load of the front axle [N]."""
        return self.mass * GRAVITY_MPS2 * self.rear_axle / self.wheelbase

    @property
    def load_rear(self) -> float:
        """Static load of the rear axle [N]."""
        return self.mass * GRAVITY_MPS2 * self.front_axle / self.wheelbase

    def free(self) -> dict[str, float]:
        """The base parameters by their dotted names in the car file."""
        return {name: float(getattr(self, field)) for name, field in FREE.items()}

    def with_free(self, values: Mapping[str, float]) -> BaseCar:
        """The same car with other base parameters, given by dotted names."""
        return dataclasses.replace(self, **{FREE[name]: float(value) for name, value in values.items()})  # type: ignore[arg-type]

    def perturbed(self, rng: np.random.Generator, share: float = 0.1) -> BaseCar:
        """Multiply every base parameter by a uniform factor in 1 +- ``share``."""
        return self.with_free({name: value * (1.0 + rng.uniform(-share, share)) for name, value in self.free().items()})

    def write(self, path: Path) -> None:
        """Write the car file (TOML)."""
        path.write_bytes(tomli_w.dumps(self.table()).encode())

    @classmethod
    def read(cls, path: Path) -> BaseCar:
        """Read a file of ``write``."""
        tables = tomllib.loads(path.read_text())
        values: dict[str, Any] = {}
        for name, field in FIELD_BY_NAME.items():
            entry: Any = tables
            for key in name.split("."):
                entry = entry[key]
            values[field] = entry
        return cls(**values)

    def table(self) -> dict[str, Any]:
        """The car file as nested tables."""
        tables: dict[str, Any] = {}
        for name, field in FIELD_BY_NAME.items():
            *path, key = name.split(".")
            table = tables
            for part in path:
                table = table.setdefault(part, {})
            table[key] = getattr(self, field)
        tables["mocap"]["dropout"] = 0.0
        return tables


def draw_nominal(rng: np.random.Generator, period_s: float = 1.0 / 30.0, kind: Kind = "dynamic") -> BaseCar:
    """A nominal car of the 1:10 class: grip, power, delay and mass differ from case to case."""
    base = BaseCar(kind=kind, control_period=period_s)
    grip = rng.uniform(0.9, 1.5)
    return dataclasses.replace(
        base,
        mass=round(base.mass * rng.uniform(0.9, 1.3), 3),
        yaw_inertia=round(base.yaw_inertia * rng.uniform(0.7, 1.4), 4),
        mu_front=round(base.mu_front * grip, 3),
        mu_rear=round(base.mu_rear * grip * rng.uniform(1.08, 1.25), 3),
        b_front=round(base.b_front * rng.uniform(0.9, 1.5), 3),
        b_rear=round(base.b_rear * rng.uniform(0.9, 1.3), 3),
        drive_gain=round(base.drive_gain * rng.uniform(0.9, 1.2), 3),
        damping=round(base.damping * rng.uniform(0.8, 1.2), 3),
        max_angle=round(base.max_angle * rng.uniform(0.75, 1.05), 3),
        command_delay=round(float(rng.uniform(0.03, 0.09)), 4),
        latency=round(float(rng.uniform(0.004, 0.012)), 4),
        position_std=round(float(rng.uniform(0.0004, 0.0008)), 6),
        yaw_std=round(float(rng.uniform(0.0015, 0.0025)), 6),
    )
