"""Combined slip of the driven tyres: wheels that spin or lock transmit limited force and lose side force."""

from __future__ import annotations

import math

from sim_backends.array_ops import Ops, Value
from sim_backends.effects.base import (
    SLIP_FLOOR_MPS,
    Confusable,
    DynamicsEffect,
    EffectParameter,
    Forces,
    Parameters,
)

MAX_GRIP_RATIO = 1e6
"""Ratios above this value are inactive."""
MIN_GRIP_N, MIN_MOTOR_SLOPE_N = 1e-3, 1e-4
"""They keep quotients finite."""
_PEAK, _SIDE_SHARE2 = "combined_slip.peak", "combined_slip.side_share2"
_SLIP, _MOTOR_SLOPE = "combined_slip.slip", "combined_slip.motor_slope"


class CombinedSlip(DynamicsEffect):
    """``F_x = P k / sqrt(1 + z^2 + k^2)`` with ``P = grip_ratio mu F_z``, at the rear tyres, and less side force.

    k and z are the slip along and across the car, times the slope B C of the tyre curve: ``k = B C s / V``,
    ``z = B C (vy - l_r r) / V``, ``V = max(|vx|, 0.3 m/s)``, where s [m/s] is the speed of the rims relative to the
    car. The side force is ``F_y sqrt((1 + z^2) / (1 + z^2 + k^2))``, F_y being that without longitudinal slip. So both
    forces point along one slip vector; the shape is Pacejka's sin(C atan(x)) with C = 1 (combined slip: Pacejka 2012,
    "Tire and Vehicle Dynamics", ch. 3 and 4).

    The wheels have no inertia: s is in equilibrium with the motor, whose force falls as the wheels spin faster than the
    car, ``F_x = drive - damping (vx + s)``. With more drive force than grip, s grows until the motor is at its speed,
    and a braked wheel locks. A limit of the motor's force that is smaller than F_x ends the slip.

    With an infinite ratio the tyres transmit the motor's force without slip, as in the base model.
    """

    id = "combined_slip"
    represented_by = ("rear_tyre_map",)
    command = "throttle"
    name = "driven wheels that spin and lock, with less side force"
    summary = "Driven wheels spin or lock: their tyres transmit limited force, and lose side force while they slip."
    sentence = (
        "the driven wheels spin and lock: the longitudinal force of their tyres is at most {grip_ratio} times their "
        "lateral grip, and they lose side force while they slip"
    )
    refuted_if = "the wheels neither spin nor lock when full throttle is applied or released"
    order = 30
    base_models = ("dynamic", "linear_tyre", "blend")
    parameters = (EffectParameter("grip_ratio", "1", math.inf, 0.0, math.inf, 1.0),)
    confusable = (
        Confusable(
            "friction_ellipse",
            "throttle_ramp",
            "an ellipse lowers the side force and leaves the drive force as it is; spinning wheels limit the drive too",
        ),
        Confusable(
            "traction_limit",
            "throttle_ramp",
            "a limit of traction alone leaves the side force as it is; spinning wheels lose it",
        ),
        Confusable(
            "speed_controller",
            "throttle_steps",
            "a controller with limited force leaves the side force as it is; spinning and locked wheels lose it",
        ),
        Confusable(
            "longitudinal_slip",
            "throttle_steps",
            "wheels with inertia need time to accelerate; without inertia the force is limited at once",
        ),
    )

    def on_traction(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """The tyres' force instead of the motor's."""
        slips = values["grip_ratio"] < MAX_GRIP_RATIO
        ratio = ops.where(slips, values["grip_ratio"], 1.0)
        peak = ops.at_least(ratio * forces.grip_rear * forces.load_rear, MIN_GRIP_N)
        u = forces.rates[_SLIP] = _scaled_slip(ops, forces, peak)
        side_share2 = 1.0 / (1.0 + u * u)
        force = ops.sign(forces.axle_force) * peak * u * ops.sqrt(side_share2)
        forces.axle_force = ops.where(slips, force, forces.axle_force)
        forces.rates[_PEAK], forces.rates[_SIDE_SHARE2] = peak, ops.where(slips, side_share2, 1.0)

    def on_tyre(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Reduce the side force; a limit of the motor that has reduced F_x since then leaves more of it."""
        used, by_slip2 = forces.axle_force / forces.rates[_PEAK], forces.rates[_SIDE_SHARE2]
        by_force2 = 1.0 - used * used
        forces.side_rear = forces.side_rear * ops.sqrt(ops.where(by_force2 > by_slip2, by_force2, by_slip2))


def _scaled_slip(ops: Ops, forces: Forces, peak: Value) -> Value:
    """Size of ``u = k / sqrt(1 + z^2)`` at which tyres with the limit ``peak`` [N] and motor are in equilibrium.

    Load transfer repeats it with a slightly different limit; then it begins at the slip of the time before.
    """
    demand = ops.abs(forces.axle_force)
    if _SLIP in forces.rates:
        return solve_slip(ops, demand, peak, forces.rates[_MOTOR_SLOPE], forces.rates[_SLIP], steps=1)
    speed = ops.at_least(ops.abs(forces.vx), SLIP_FLOOR_MPS)
    per_speed = forces.rear_stiffness / speed
    across = per_speed * (forces.vy - forces.rear_axle * forces.yaw_rate)
    slope = forces.damping * ops.sqrt(1.0 + across * across) / per_speed
    slope = forces.rates[_MOTOR_SLOPE] = ops.at_least(slope, MIN_MOTOR_SLOPE_N)
    rolling, spinning = demand / (slope + peak), (demand - peak) / slope
    return solve_slip(ops, demand, peak, slope, ops.where(rolling > spinning, rolling, spinning), steps=3)


def solve_slip(ops: Ops, demand: Value, peak: Value, motor_slope: Value, start: Value, steps: int) -> Value:
    """Solve ``motor_slope u + peak u / sqrt(1 + u^2) = demand`` for u by Halley's method; it has one root.

    All arguments but ``start`` are in N and positive. Three steps from the lower bound
    ``max(demand / (motor_slope + peak), (demand - peak) / motor_slope)`` have an error of the force below 1e-11
    ``peak`` for ``motor_slope`` above 0.02 ``peak``, and below 1e-5 ``peak`` for ``motor_slope`` above 0.001 ``peak``.
    """
    u = start
    for _ in range(steps):
        cosine = 1.0 / ops.sqrt(1.0 + u * u)
        cubed = cosine * cosine * cosine
        error = motor_slope * u + peak * u * cosine - demand
        first = motor_slope + peak * cubed
        second = -3.0 * peak * u * cubed * cosine * cosine
        u = ops.at_least(u - 2.0 * error * first / (2.0 * first * first - error * second), 0.0)
    return u
