"""Physics outside the catalogue, which a diagnosis does not name.

The simulator handles these effects like all others. A diagnosis uses them as rival physics, so that no effect of the
catalogue is named for physics that one of these explains better.
"""

from __future__ import annotations

import math

import numpy as np

from carlab.core.quantities import FloatArray
from sim_backends.array_ops import Ops, Value
from sim_backends.effects.base import (
    Confusable,
    DynamicsEffect,
    EffectParameter,
    Forces,
    ObservationEffect,
    Parameters,
    ScreeningProbe,
)

REST_SPEED_MPS = 0.2
"""Speed over which a force of rolling wheels builds up [m/s]."""
SCRUB_FLOOR_MPS = 0.3
SCRUB_CURVATURE = 1.0
"""Curvature of the path at which the wheels of a locked axle begin to slide [1/m]."""
STILL_AIR_M2PS2 = 1e-6
SCREENING_COEFFICIENT = 0.15
"""Drag coefficient at which a wind is screened [N s2/m2]."""
COAST_THROTTLE = 0.05
"""Throttle below which a speed controller brakes."""
HEADING_HARMONICS = 3
"""Waves of a heading error over a turn of the car."""


class Wind(DynamicsEffect):
    """A steady wind of ``speed`` that blows towards the world heading ``direction``.

    With w the wind in the body frame, ``F += -coefficient (|v - w| (v - w) - |v| v)``: drag in moving air less that in
    still air, so that a speed of zero does nothing.
    """

    id = "wind"
    catalogued = False
    summary = "A steady wind blows over the floor."
    class_statement = "depends on the heading, a direction of the world, and grows with speed, as a steady wind's force"
    parameters = (
        EffectParameter("speed", "m/s", 0.0, 0.0, 30.0, 1.0),
        EffectParameter("direction", "rad", 0.0, -2.0 * math.pi, 2.0 * math.pi, 1.0),
        EffectParameter("coefficient", "N s2/m2", 0.1, 0.0, 10.0, 0.15),
    )
    depends_on = frozenset({"heading"})
    screening_scaled = ("speed",)

    def screening_points(self, probe: ScreeningProbe) -> FloatArray:
        """Eight directions, each with the screening speeds of the first direction."""
        start = {"speed": 1.0, "direction": 0.0, "coefficient": SCREENING_COEFFICIENT}
        sized = probe.sized([start], held=("direction", "coefficient"))
        headings = np.linspace(-np.pi, np.pi, 8, endpoint=False)
        return probe.points({**row, "direction": float(h)} for row in sized for h in headings)

    confusable = (Confusable("road_slope"),)

    def on_body(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Add the force of the wind."""
        ahead = values["direction"] - forces.yaw
        air_x = forces.vx - values["speed"] * ops.cos(ahead)
        air_y = forces.vy - values["speed"] * ops.sin(ahead)
        moving = ops.sqrt(air_x * air_x + air_y * air_y + STILL_AIR_M2PS2)
        still = ops.sqrt(forces.vx * forces.vx + forces.vy * forces.vy + STILL_AIR_M2PS2)
        forces.force_x = forces.force_x - values["coefficient"] * (moving * air_x - still * forces.vx)
        forces.force_y = forces.force_y - values["coefficient"] * (moving * air_y - still * forces.vy)


class _SideForce(DynamicsEffect):
    """A constant side force of one axle's wheels while they roll, in their own frame."""

    catalogued = False
    order = 80
    parameters = (EffectParameter("force", "N", 0.0, -50.0, 50.0, 0.5),)
    confusable = (Confusable("steering_offset"), Confusable("lateral_bias"))

    @staticmethod
    def push(ops: Ops, forces: Forces, values: Parameters) -> Value:
        """To the left [N]."""
        return values["force"] * ops.tanh(ops.abs(forces.vx) * (1.0 / REST_SPEED_MPS))


class FrontSideForce(_SideForce):
    """``F_y,front += force tanh(|vx| / 0.2 m/s)`` in the front wheels' frame: toe or camber of the front wheels."""

    id = "front_side_force"
    summary = "Toe or camber of the front wheels pushes them to one side."
    class_statement = "constant: a bias of the front wheels' side force, even in steering, as by toe or camber"

    def on_tyre(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Push the front."""
        forces.side_front = forces.side_front + self.push(ops, forces, values)


class RearSideForce(_SideForce):
    """``F_y,rear += force tanh(|vx| / 0.2 m/s)``: toe or camber of the rear wheels."""

    id = "rear_side_force"
    summary = "Toe or camber of the rear wheels pushes them to one side."
    class_statement = "constant: a bias of the rear wheels' side force, even in steering, as by toe or camber"

    def on_tyre(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Push the rear."""
        forces.side_rear = forces.side_rear + self.push(ops, forces, values)


class LockedAxle(DynamicsEffect):
    """``M -= moment tanh(curvature / (1 /m))``, curvature ``r / max(|vx|, 0.3 m/s)``: two wheels that turn as one.

    The difference of the paths of both wheels makes them slide against each other, the more the tighter the turn is and
    whatever its speed, until both slide wholly.
    """

    id = "locked_axle"
    catalogued = False
    summary = "Two driven wheels that turn as one scrub in turns."
    class_statement = "odd in the yaw rate, by the path's curvature whatever the speed, as with a locked differential"
    parameters = (EffectParameter("moment", "N m", 0.0, 0.0, 20.0, 0.1),)
    confusable = (Confusable("yaw_damping"),)

    def on_body(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Subtract the scrub moment of the tyres."""
        speed = ops.at_least(ops.abs(forces.vx), SCRUB_FLOOR_MPS)
        scrub = ops.tanh(forces.yaw_rate / speed * (1.0 / SCRUB_CURVATURE))
        forces.moment = forces.moment - values["moment"] * scrub


class BrakingPull(DynamicsEffect):
    """``M += coefficient max(-u, 0)``: brakes that pull to one side."""

    id = "braking_pull"
    catalogued = False
    summary = "The brakes pull to one side."
    class_statement = "follows negative throttle only: braking turns the car to one side"
    parameters = (EffectParameter("coefficient", "N m", 0.0, -10.0, 10.0, 0.2),)
    confusable = (Confusable("torque_steer"),)

    def on_body(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Add the moment of the brakes."""
        forces.moment = forces.moment + values["coefficient"] * ops.at_least(-forces.throttle, 0.0)


class CoastBrake(DynamicsEffect):
    """``F_x -= coefficient vx exp(-(u / 0.05)^2)``: a speed controller that brakes while the throttle is released."""

    id = "coast_brake"
    represented_by = ("drive_map",)
    catalogued = False
    summary = "The motor brakes while the throttle is released."
    class_statement = "odd in speed where there is no throttle, as with a motor that brakes while the car coasts"
    parameters = (EffectParameter("coefficient", "N s/m", 0.0, 0.0, 50.0, 0.5),)
    confusable = (Confusable("rolling_resistance"), Confusable("throttle_deadband"))

    def on_body(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Subtract the braking force."""
        share = forces.throttle * (1.0 / COAST_THROTTLE)
        forces.force_x = ops.fms(values["coefficient"], forces.vx * ops.exp(-share * share), forces.force_x)


class HeadingError(ObservationEffect):
    """``yaw_meas = yaw + e(yaw)`` with ``e = mean + sum_k (cos_k cos(k yaw) + sin_k sin(k yaw))``, k from 1 to 3.

    The velocities are measured in the axes of the measured heading. The measured yaw rate is ``r (1 + de/dyaw)``.
    """

    id = "heading_error"
    catalogued = False
    is_general_rival = False
    summary = "The measured heading has an error that depends on the heading."
    class_statement = "an error of the measured heading that depends on the heading alone"
    depends_on = frozenset({"heading"})
    order = 61
    parameters = (
        EffectParameter("mean", "rad", 0.0, -0.5, 0.5, 0.02),
        *(
            EffectParameter(f"{wave}_{k}", "rad", 0.0, -0.2 / k, 0.2 / k, 0.01 / k)
            for k in range(1, HEADING_HARMONICS + 1)
            for wave in ("cos", "sin")
        ),
    )

    def observe(self, ops: Ops, state: tuple[Value, ...], values: Parameters) -> tuple[Value, ...]:
        """Turn the axes."""
        x, y, yaw, vx, vy, yaw_rate = state
        error, slope = values["mean"], 0.0 * yaw
        for k in range(1, HEADING_HARMONICS + 1):
            cos, sin = ops.cos(k * yaw), ops.sin(k * yaw)
            error = error + values[f"cos_{k}"] * cos + values[f"sin_{k}"] * sin
            slope = slope + k * (values[f"sin_{k}"] * cos - values[f"cos_{k}"] * sin)
        sin, cos = ops.sin(error), ops.cos(error)
        return x, y, yaw + error, vx * cos + vy * sin, vy * cos - vx * sin, yaw_rate * (1.0 + slope)


UNCATALOGUED = (
    Wind(),
    FrontSideForce(),
    RearSideForce(),
    LockedAxle(),
    BrakingPull(),
    CoastBrake(),
    HeadingError(),
)
