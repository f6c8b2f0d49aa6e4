"""Measured curves of a side force and a yaw moment over the speed, as rivals of effects that turn to one side."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from carlab.core.quantities import FloatArray
from sim_backends.array_ops import Ops, Value
from sim_backends.effects.base import DynamicsEffect, Forces, Parameters
from sim_backends.effects.curves import Axis, MeasuredCurve

_FORCE_AXES = (Axis("speed", "m/s", (-3.0, -1.5, -0.5, 0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0), anchor=0.0),)


class _OverSpeed(MeasuredCurve, DynamicsEffect):
    """A force or moment on the body over the speed; the base model has none, and a standing car gets none."""

    in_fits_of_curves = False
    class_statement = "a side force and a yaw moment that depend on the speed alone"

    def coordinates(self, ops: Ops, forces: Forces) -> tuple[Value, ...]:
        """The speed vx [m/s]."""
        return (forces.vx,)

    def base_curve(self, values: Mapping[str, float], *coordinates: FloatArray) -> FloatArray:
        """Zero."""
        return np.zeros_like(coordinates[0])

    def per_mass(self, ops: Ops, forces: Forces, values: Parameters) -> Value:
        """Force or moment over the mass of the car, in ``unit``."""
        return self.deviation(ops, self.coordinates(ops, forces), values)


class SideForceOverSpeed(_OverSpeed):
    """``F_y += m a(vx)``, in the body frame, at the centre of mass."""

    id = "side_force_over_speed"
    quantity = "side force over mass"
    summary = "A side force is a measured curve over the speed."
    unit, typical, bound = "m/s2", 0.2, 20.0
    axes = _FORCE_AXES

    def on_body(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Push to the left."""
        forces.force_y = forces.force_y + forces.mass * self.per_mass(ops, forces, values)


class YawMomentOverSpeed(_OverSpeed):
    """``M += m a(vx)``."""

    id = "yaw_moment_over_speed"
    quantity = "yaw moment over mass"
    summary = "A yaw moment is a measured curve over the speed."
    unit, typical, bound = "m2/s2", 0.02, 2.0
    axes = _FORCE_AXES

    def on_body(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Turn to the left."""
        forces.moment = forces.moment + forces.mass * self.per_mass(ops, forces, values)
