"""Forces and moments on the body of the car. A kinematic car ignores side forces and moments."""

from __future__ import annotations

import math

import numpy as np

from carlab.core.quantities import FloatArray
from sim_backends.array_ops import Ops
from sim_backends.effects.base import (
    GRAVITY_MPS2,
    Confusable,
    DynamicsEffect,
    EffectParameter,
    Forces,
    Parameters,
    ScreeningProbe,
)


class YawDamping(DynamicsEffect):
    """``M -= coefficient r``."""

    id = "yaw_damping"
    name = "a yaw damping moment"
    summary = "A yaw damping moment proportional to the yaw rate, as with a locked axle."
    sentence = "a moment of {coefficient} times the yaw rate opposes turning, as with a locked axle"
    refuted_if = "circles at full lock and walking pace have the radius of the steering geometry"
    parameters = (EffectParameter("coefficient", "N m s/rad", 0.0, 0.0, 10.0, 0.05),)

    def on_body(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Subtract the damping moment."""
        forces.moment = forces.moment - values["coefficient"] * forces.yaw_rate


class TorqueSteer(DynamicsEffect):
    """``M += coefficient u``, or ``M += coefficient F_x / F_full`` where ``source`` is "force".

    u is the throttle that acts, F_x the force of the driven axle (drive less damping, after a traction limit or wheel
    slip), F_full the motor's force at full throttle. A drive force that misses the centre of mass has the second form.
    """

    id = "torque_steer"
    name = "torque steer"
    summary = "Torque steer: a yaw moment proportional to the throttle or to the force of the driven axle."
    sentence = (
        "full throttle at a standstill turns the car to the {coefficient:left|right} with a moment of "
        "{coefficient:size}, in proportion to the {source:choice throttle|force of the driven axle}"
    )
    refuted_if = "the car also pulls to that side when it rolls without throttle"
    parameters = (
        EffectParameter("coefficient", "N m", 0.0, -10.0, 10.0, 0.1),
        EffectParameter("source", "1", 0.0, 0.0, 1.0, 0.0, choices=("throttle", "force")),
    )

    def screening_points(self, probe: ScreeningProbe) -> FloatArray:
        """Both sources with both signs."""
        directions = ({"coefficient": sign, "source": float(k)} for k in range(2) for sign in (1.0, -1.0))
        return probe.points(probe.sized(directions, held=("source",)))

    def on_tyre(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Add the moment; load transfer and traction do not change the axle force any more."""
        share = ops.where(
            values["source"] < 0.5, forces.throttle, forces.axle_force / ops.at_least(forces.full_drive, 1e-9)
        )
        forces.moment = forces.moment + values["coefficient"] * share


class LateralBias(DynamicsEffect):
    """``F_y += force``, in the body frame, at the centre of mass."""

    id = "lateral_bias"
    name = "a side force"
    summary = "A constant side force pulls the car to one side."
    sentence = "a constant force of {force:size} pushes the car to the {force:left|right}"
    refuted_if = (
        "the path's curvature does not fall as speed grows (then the steering has an offset), or the pull turns "
        "with the heading (then the floor slopes)"
    )
    parameters = (EffectParameter("force", "N", 0.0, -50.0, 50.0, 0.5),)

    def on_body(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Push to the left."""
        forces.force_y = forces.force_y + values["force"]


class RoadSlope(DynamicsEffect):
    """Force ``m g sin(angle)`` down the slope; ``direction`` is the world heading of steepest ascent.

    In the body frame ``F_x = -m g sin(angle) cos(direction - yaw)`` and ``F_y = -m g sin(angle) sin(direction - yaw)``.
    The change of the wheels' load (a factor cos(angle)) is neglected.
    """

    id = "road_slope"
    name = "a slope of the floor"
    summary = "The floor slopes."
    sentence = "the floor slopes by {angle}, upwards in the direction of a heading of {direction}"
    refuted_if = "the pull does not change sign when the car drives the other way"
    parameters = (
        EffectParameter("angle", "rad", 0.0, -0.5, 0.5, 0.03),
        EffectParameter("direction", "rad", 0.0, -2.0 * math.pi, 2.0 * math.pi, 1.0),
    )
    depends_on = frozenset({"heading"})

    def screening_points(self, probe: ScreeningProbe) -> FloatArray:
        """Eight directions of ascent, each with the screening angles of the first direction."""
        headings = np.linspace(-np.pi, np.pi, 8, endpoint=False)
        sized = probe.sized([{"angle": 1.0, "direction": float(headings[0])}], held=("direction",))
        angles = sorted({row["angle"] for row in sized})
        return probe.points({"angle": a, "direction": float(h)} for a in angles for h in headings)

    confusable = (
        Confusable(
            "lateral_bias",
            "figure_eight",
            "a slope pulls to the other side of the car after a half turn; a side force keeps its side",
        ),
    )

    def on_body(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Weight along the floor."""
        down = forces.mass * GRAVITY_MPS2 * ops.sin(values["angle"])
        ascent = values["direction"] - forces.yaw
        forces.force_x = forces.force_x - down * ops.cos(ascent)
        forces.force_y = forces.force_y - down * ops.sin(ascent)
