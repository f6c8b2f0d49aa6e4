"""Forces and moments on the body of the car. A kinematic car has no use for side forces and moments."""

from __future__ import annotations

import math

from sim_backends.array_ops import Ops
from sim_backends.effects.base import GRAVITY_MPS2, DynamicsEffect, EffectParameter, Forces, Parameters


class YawDamping(DynamicsEffect):
    """``M -= coefficient r``."""

    id = "yaw_damping"
    sentence = "A moment against turning that grows with the yaw rate, as of a locked axle."
    parameters = (EffectParameter("coefficient", "N m s/rad", 0.0, 0.0, 10.0, 0.05),)

    def on_body(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Damp."""
        forces.moment = forces.moment - values["coefficient"] * forces.yaw_rate


class TorqueSteer(DynamicsEffect):
    """``M += coefficient u``, u the throttle that acts."""

    id = "torque_steer"
    sentence = "Throttle turns the car: a moment in proportion to it."
    parameters = (EffectParameter("coefficient", "N m", 0.0, -10.0, 10.0, 0.1),)

    def on_body(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Turn."""
        forces.moment = forces.moment + values["coefficient"] * forces.throttle


class LateralBias(DynamicsEffect):
    """``F_y += force``, in the body frame, at the centre of mass."""

    id = "lateral_bias"
    sentence = "A constant side force pulls the car to one side."
    parameters = (EffectParameter("force", "N", 0.0, -50.0, 50.0, 0.5),)
    look_alikes = ("steering_offset",)

    def on_body(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Push to the left."""
        forces.force_y = forces.force_y + values["force"]


class RoadSlope(DynamicsEffect):
    """Force ``m g sin(angle)`` down the slope; ``direction`` is the world heading of steepest ascent.

    In the body frame ``F_x = -m g sin(angle) cos(direction - yaw)`` and ``F_y = -m g sin(angle) sin(direction - yaw)``.
    The wheels' load (a factor cos(angle)) stays as it is.
    """

    id = "road_slope"
    sentence = "The floor slopes."
    parameters = (
        EffectParameter("angle", "rad", 0.0, -0.5, 0.5, 0.03),
        EffectParameter("direction", "rad", 0.0, -2.0 * math.pi, 2.0 * math.pi, 1.0),
    )
    look_alikes = ("lateral_bias",)

    def on_body(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Weight along the floor."""
        down = forces.mass * GRAVITY_MPS2 * ops.sin(values["angle"])
        ascent = values["direction"] - forces.yaw
        forces.force_x = forces.force_x - down * ops.cos(ascent)
        forces.force_y = forces.force_y - down * ops.sin(ascent)
