"""Motor force and force limit of the driven axle. Acting order: sag, brake asymmetry, saturation, traction."""

from __future__ import annotations

import math

from sim_backends.array_ops import Ops, Value
from sim_backends.effects.base import Confusable, DynamicsEffect, EffectParameter, Forces, Parameters

MAX_FORCE_N = 1e9
MAX_SHARE = 1e6
TINY = 1e-12
"""Keeps a root differentiable and a quotient finite."""


class BatterySag(DynamicsEffect):
    """``drive_gain (1 - rate t)``, t since the first row of the recording; not below zero."""

    id = "battery_sag"
    command = "throttle"
    name = "a drive that changes as the battery runs down"
    summary = "The drive weakens with time as the battery runs down."
    sentence = "the drive {rate:weakens|strengthens} by {rate:size each minute}"
    refuted_if = "cornering changes too (then grip changes), or the drive stays weak after the battery is charged"
    order = 10
    depends_on = frozenset({"time"})
    parameters = (EffectParameter("rate", "1/s", 0.0, -1.0, 1.0, 0.003),)
    confusable = (
        Confusable(
            "friction_drift",
            "figure_eight",
            "repeated for some minutes, a weak battery slows the car, while lost grip widens its turns",
        ),
    )

    def on_drive(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Multiply the drive force by the remaining share."""
        forces.drive = forces.drive * ops.at_least(1.0 - values["rate"] * forces.t_s, 0.0)


class BrakeAsymmetry(DynamicsEffect):
    """``drive force * gain_ratio`` where drive force and vx have opposite signs."""

    id = "brake_asymmetry"
    represented_by = "drive_map"
    command = "throttle"
    name = "a brake gain that differs from the drive gain"
    summary = "The motor's gain differs between braking and driving."
    sentence = "the motor brakes with {gain_ratio} times the force with which it drives at the same throttle"
    refuted_if = "braking from several speeds needs several such ratios"
    order = 20
    parameters = (EffectParameter("gain_ratio", "1", 1.0, 0.0, 10.0, 1.5),)

    def on_drive(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Scale while braking."""
        braking = forces.drive * forces.vx < 0.0
        forces.drive = ops.where(braking, forces.drive * values["gain_ratio"], forces.drive)


def limited_force(ops: Ops, force: Value, limit: Value, roundness: Value) -> Value:
    """Limit a force (cars,) [N]: ``2 a b / (a + b + sqrt((a - b)^2 + 4 roundness a b))`` for its size a, with limit b.

    This is the smaller root m of ``(1 - roundness) m^2 - (a + b) m + a b = 0``, a non-rectangular hyperbola: for small
    forces a, for large ones b, and without roundness the smaller of both.
    """
    size = ops.abs(force)
    root = ops.sqrt((size - limit) * (size - limit) + 4.0 * roundness * size * limit + TINY)
    return 2.0 * force * limit / (size + limit + root)


class MotorSaturation(DynamicsEffect):
    """``2 a b / (a + b + sqrt((a - b)^2 + 4 roundness a b))`` for the size a of the drive force, with b = ``force``.

    For small forces a, for large ones b, and without roundness the smaller of both. It acts before damping.
    """

    id = "motor_saturation"
    represented_by = "drive_map"
    command = "throttle"
    name = "a limit of the motor's force"
    summary = "The motor's drive force is limited."
    sentence = "the motor's drive force is limited to {force}, with roundness {roundness} (0: a sharp limit)"
    refuted_if = "the limit changes with the grip of the floor, or with the load on the wheels"
    order = 30
    parameters = (
        EffectParameter("force", "N", math.inf, 0.0, math.inf, 3.0),
        EffectParameter("roundness", "1", 0.0, 0.0, 1.0, 0.3),
    )
    confusable = (
        Confusable(
            "traction_limit",
            "throttle_ramp",
            "a limit of traction falls in turns, which need grip; a limit of the motor does not",
        ),
    )

    def on_drive(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Limit the force."""
        limit = ops.where(values["force"] < MAX_FORCE_N, values["force"], MAX_FORCE_N)
        forces.drive = limited_force(ops, forces.drive, limit, values["roundness"])


class TractionLimit(DynamicsEffect):
    """``|F_x at the driven axle| <= b`` with ``b = share mu F_z`` of the rear axle, or of both where ``axle`` is "all".

    With ``roundness`` the size is ``2 a b / (a + b + sqrt((a - b)^2 + 4 roundness a b))`` instead of the smaller of a
    and b, where a is the size without limit. F_x is the base model's, drive less damping; resistances act on the body
    and do not count.
    """

    id = "traction_limit"
    represented_by = "drive_map"
    command = "throttle"
    name = "a limit of traction"
    summary = "The force of the driven wheels is limited by their grip."
    sentence = (
        "the force of the driven wheels ({axle:choice rear|all}) is limited to {share} times their full grip, with "
        "roundness {roundness} (0: a sharp limit)"
    )
    refuted_if = "the same limit is reached on a floor with more grip (then it is the motor's)"
    order = 40
    parameters = (
        EffectParameter("share", "1", math.inf, 0.0, math.inf, 0.7),
        EffectParameter("axle", "1", 0.0, 0.0, 1.0, 0.0, choices=("rear", "all")),
        EffectParameter("roundness", "1", 0.0, 0.0, 1.0, 0.3),
    )
    confusable = (
        Confusable(
            "friction_ellipse",
            "throttle_ramp",
            "a limit of traction acts only at large drive force; shared grip lowers the side force at any drive force",
        ),
    )

    def on_traction(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Limit the drive force to a share of the grip of the driven wheels."""
        rear = forces.grip_rear * forces.load_rear
        grip = ops.where(values["axle"] < 0.5, rear, rear + forces.grip_front * forces.load_front)
        limited = values["share"] < MAX_SHARE
        limit = ops.where(limited, values["share"], 1.0) * grip
        rounded = limited_force(ops, forces.axle_force, limit, values["roundness"])
        forces.axle_force = ops.where(limited, rounded, forces.axle_force)
