"""Forces against the direction of travel."""

from __future__ import annotations

from sim_backends.array_ops import Ops
from sim_backends.effects.base import Confusable, DynamicsEffect, EffectParameter, Forces, Parameters

ROLLING_SPEED_MPS = 0.05
"""Speed over which rolling resistance builds up, so that it is smooth at rest [m/s]."""


class RollingResistance(DynamicsEffect):
    """``F_x -= force tanh(vx / 0.05 m/s)``."""

    id = "rolling_resistance"
    represented_by = ("drive_map",)
    command = "throttle"
    name = "rolling resistance"
    summary = "Rolling resistance: a force against the motion that does not depend on speed."
    sentence = "a rolling resistance of {force} holds the car back at any speed"
    refuted_if = "without throttle, the deceleration falls as the car becomes slower"
    parameters = (EffectParameter("force", "N", 0.0, 0.0, 50.0, 0.8),)

    def on_body(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Subtract the resistance."""
        forces.force_x = ops.fms(values["force"], ops.tanh(forces.vx * (1.0 / ROLLING_SPEED_MPS)), forces.force_x)


class AerodynamicDrag(DynamicsEffect):
    """``F_x -= coefficient vx |vx|``."""

    id = "aerodynamic_drag"
    represented_by = ("drive_map",)
    command = "throttle"
    name = "a drag that grows with the square of speed"
    summary = "Aerodynamic drag: a force against the motion that grows with the square of speed."
    sentence = "a drag of {coefficient} times speed squared holds the car back"
    refuted_if = "without throttle, the car shows no such drag at high speed (then the motor is at its limit)"
    parameters = (EffectParameter("coefficient", "N s2/m2", 0.0, 0.0, 10.0, 0.1),)
    confusable = (
        Confusable(
            "motor_saturation",
            "coast_down",
            "without throttle the motor's limit has no effect, while drag still slows the car",
        ),
    )

    def on_body(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Subtract the drag."""
        forces.force_x = ops.fms(values["coefficient"], forces.vx * ops.abs(forces.vx), forces.force_x)


class CorneringDrag(DynamicsEffect):
    """``F_x -= coefficient |d| tanh(vx / 0.05 m/s)``."""

    id = "cornering_drag"
    command = "throttle"
    name = "a drag of the steered wheels"
    summary = "Steered wheels slow the car down more than their side force does."
    sentence = "steered wheels hold the car back by {coefficient} of wheel angle"
    refuted_if = "the loss of speed in corners depends on speed rather than on the wheel angle"
    parameters = (EffectParameter("coefficient", "N/rad", 0.0, 0.0, 100.0, 3.0),)

    def on_body(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Subtract the drag."""
        size = values["coefficient"] * ops.abs(forces.wheel_angle)
        forces.force_x = ops.fms(size, ops.tanh(forces.vx * (1.0 / ROLLING_SPEED_MPS)), forces.force_x)
