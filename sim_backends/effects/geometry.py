"""Positions of the axles that differ from the car file. They change the base model, and cost nothing in a step."""

from __future__ import annotations

from collections.abc import Mapping

from sim_backends.array_ops import Ops, Value
from sim_backends.effects.base import Confusable, DynamicsEffect, EffectParameter, Parameters

MIN_DISTANCE_SHARE = 0.02
"""Minimum distance of an axle from the centre of mass, as a share of the wheelbase."""


class Wheelbase(DynamicsEffect):
    """``l_f = (1 + change) l_f,0`` and ``l_r = (1 + change) l_r,0`` with the axle distances of the car file.

    Motion capture that measures all distances too large by ``change`` has the same effect, because friction, yaw
    inertia and drive gain are fitted: axle distances, velocities and accelerations grow by this share; angles and yaw
    rates stay the same.
    """

    id = "wheelbase"
    order = 5
    base_models = ("dynamic", "linear_tyre", "blend")
    """Not identifiable on the kinematic car: its curvature ``tan(d) / L`` depends on both the steering angle and L."""
    name = "a wheelbase that differs from the car file"
    summary = (
        "The wheelbase differs from the car file, or motion capture measures all distances too large or too small."
    )
    sentence = (
        "the wheelbase is {change:size percent} {change:longer|shorter} than in the car file, or motion capture "
        "measures all distances too {change:large|small} by this share"
    )
    refuted_if = (
        "a tape measure confirms the wheelbase, and motion capture measures the right distance between two points of "
        "the floor"
    )
    parameters = (EffectParameter("change", "1", 0.0, -0.8, 4.0, 0.05),)

    def axle_distances_m(self, ops: Ops, front_m: Value, rear_m: Value, values: Parameters) -> tuple[Value, Value]:
        """Scale both."""
        scale = 1.0 + values["change"]
        return scale * front_m, scale * rear_m


class CentreOfMass(DynamicsEffect):
    """``l_f = l_f,0 - ahead`` and ``l_r = l_r,0 + ahead``: the tracked centre of mass is elsewhere between the axles.

    The axle loads change with it. A shift beyond an axle of the car file is refused. In a step an axle stays at least
    2 % of the wheelbase away from the centre of mass.
    """

    id = "centre_of_mass"
    order = 6
    base_models = ("dynamic", "linear_tyre", "blend")
    """On the kinematic car it is the same as ``marker_offset``."""
    name = "a centre of mass that differs from the car file"
    summary = "The centre of mass is further ahead or further behind than in the car file."
    sentence = "the centre of mass is {ahead:size} further {ahead:ahead|behind} than in the car file"
    refuted_if = "a scale under each axle shows the axle loads of the car file"
    parameters = (EffectParameter("ahead", "m", 0.0, -0.5, 0.5, 0.01),)
    confusable = (
        Confusable(
            "marker_offset",
            "steering_chirp",
            "at walking pace a shift of the tracked point and one of the centre of mass look alike; in fast steering "
            "only the centre of mass changes how strongly each axle turns the car",
        ),
    )

    def ranges(self, values: Mapping[str, float]) -> Mapping[str, tuple[float, float]]:
        """The centre of mass is between the axles of the car file."""
        return {"ahead": (-values["vehicle.rear_axle"], values["vehicle.front_axle"])}

    def axle_distances_m(self, ops: Ops, front_m: Value, rear_m: Value, values: Parameters) -> tuple[Value, Value]:
        """Move the point between the axles."""
        wheelbase_m = front_m + rear_m
        nearest_m = MIN_DISTANCE_SHARE * wheelbase_m
        front_m = ops.clip(front_m - values["ahead"], nearest_m, wheelbase_m - nearest_m)
        return front_m, wheelbase_m - front_m
