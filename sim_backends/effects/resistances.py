"""Forces against the direction of travel."""

from __future__ import annotations

from sim_backends.array_ops import Ops
from sim_backends.effects.base import DynamicsEffect, EffectParameter, Forces, Parameters

ROLLING_SPEED_MPS = 0.05
"""Speed over which rolling resistance builds up, so that it is smooth at rest [m/s]."""


class RollingResistance(DynamicsEffect):
    """``F_x -= force tanh(vx / 0.05 m/s)``."""

    id = "rolling_resistance"
    sentence = "Rolling resistance: a force against the motion that does not depend on speed."
    parameters = (EffectParameter("force", "N", 0.0, 0.0, 50.0, 0.8),)
    look_alikes = ("throttle_deadband",)

    def on_body(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Brake."""
        forces.force_x = ops.fms(values["force"], ops.tanh(forces.vx * (1.0 / ROLLING_SPEED_MPS)), forces.force_x)


class AerodynamicDrag(DynamicsEffect):
    """``F_x -= coefficient vx |vx|``."""

    id = "aerodynamic_drag"
    sentence = "Aerodynamic drag: a force against the motion that grows with the square of speed."
    parameters = (EffectParameter("coefficient", "N s2/m2", 0.0, 0.0, 10.0, 0.1),)
    look_alikes = ("motor_saturation",)

    def on_body(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Brake."""
        forces.force_x = ops.fms(values["coefficient"], forces.vx * ops.abs(forces.vx), forces.force_x)


class CorneringDrag(DynamicsEffect):
    """``F_x -= coefficient |d| tanh(vx / 0.05 m/s)``."""

    id = "cornering_drag"
    sentence = "Steered wheels slow the car down more than their side force does."
    parameters = (EffectParameter("coefficient", "N/rad", 0.0, 0.0, 100.0, 3.0),)

    def on_body(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Brake."""
        size = values["coefficient"] * ops.abs(forces.wheel_angle)
        forces.force_x = ops.fms(size, ops.tanh(forces.vx * (1.0 / ROLLING_SPEED_MPS)), forces.force_x)
