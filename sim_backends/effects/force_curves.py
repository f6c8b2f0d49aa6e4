"""Measured curves of a side force and a yaw moment over the speed or the slip angle of the front wheels.

They are rivals of effects that turn the car to one side.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from carlab.core.quantities import FloatArray
from sim_backends.array_ops import Ops, Value
from sim_backends.effects.base import DynamicsEffect, Forces, Parameters
from sim_backends.effects.curves import Axis, MeasuredCurve, front_slip_rad
from sim_backends.effects.uncatalogued import REST_SPEED_MPS

_SPEED_AXES = (Axis("speed", "m/s", (-3.0, -1.5, -0.5, 0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0), anchor=0.0),)
_SLIP_AXES = (Axis("front slip angle", "rad", (-0.5, -0.3, -0.18, -0.1, -0.04, 0.0, 0.04, 0.1, 0.18, 0.3, 0.5)),)


class _ForceCurve(MeasuredCurve, DynamicsEffect):
    """A force or moment on the body; the base model has none."""

    in_fits_of_curves = False

    def base_curve(self, values: Mapping[str, float], *coordinates: FloatArray) -> FloatArray:
        """Zero."""
        return np.zeros_like(coordinates[0])

    def per_mass(self, ops: Ops, forces: Forces, values: Parameters) -> Value:
        """Force or moment over the mass of the car, in ``unit``."""
        return self.deviation(ops, self.coordinates(ops, forces), values)


class _SideForce(_ForceCurve):
    """``F_y += m a``, in the body frame, at the centre of mass."""

    unit, typical, bound = "m/s2", 0.2, 20.0
    quantity = "side force over mass"

    def on_body(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Push to the left."""
        forces.force_y = forces.force_y + forces.mass * self.per_mass(ops, forces, values)


class _YawMoment(_ForceCurve):
    """``M += m a``."""

    unit, typical, bound = "m2/s2", 0.02, 2.0
    quantity = "yaw moment over mass"

    def on_body(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Turn to the left."""
        forces.moment = forces.moment + forces.mass * self.per_mass(ops, forces, values)


class _OverSpeed(_ForceCurve):
    """``a(vx)``; a standing car gets no force."""

    class_statement = "a side force and a yaw moment that depend on the speed alone"

    def coordinates(self, ops: Ops, forces: Forces) -> tuple[Value, ...]:
        """The speed vx [m/s]."""
        return (forces.vx,)


class _OverSlip(_ForceCurve):
    """``a(slip) tanh(|vx| / 0.2 m/s)``, slip being that of the front wheels in the base model; zero at rest."""

    base_models = ("dynamic", "linear_tyre", "blend")
    class_statement = "a side force and a yaw moment that depend on the slip angle of the front wheels alone"

    def coordinates(self, ops: Ops, forces: Forces) -> tuple[Value, ...]:
        """The slip angle of the front wheels [rad], positive where the tyres push to the right."""
        return (front_slip_rad(ops, forces),)

    def per_mass(self, ops: Ops, forces: Forces, values: Parameters) -> Value:
        """Force or moment over the mass of the car, in ``unit``."""
        return ops.tanh(ops.abs(forces.vx) * (1.0 / REST_SPEED_MPS)) * super().per_mass(ops, forces, values)


class SideForceOverSpeed(_OverSpeed, _SideForce):
    """``F_y += m a(vx)``, in the body frame, at the centre of mass."""

    id = "side_force_over_speed"
    summary = "A side force is a measured curve over the speed."
    axes = _SPEED_AXES


class YawMomentOverSpeed(_OverSpeed, _YawMoment):
    """``M += m a(vx)``."""

    id = "yaw_moment_over_speed"
    summary = "A yaw moment is a measured curve over the speed."
    axes = _SPEED_AXES


class SideForceOverSlip(_OverSlip, _SideForce):
    """``F_y += m a(slip) tanh(|vx| / 0.2 m/s)``, in the body frame, at the centre of mass."""

    id = "side_force_over_slip"
    summary = "A side force is a measured curve over the slip angle of the front wheels."
    axes = _SLIP_AXES


class YawMomentOverSlip(_OverSlip, _YawMoment):
    """``M += m a(slip) tanh(|vx| / 0.2 m/s)``."""

    id = "yaw_moment_over_slip"
    summary = "A yaw moment is a measured curve over the slip angle of the front wheels."
    axes = _SLIP_AXES
