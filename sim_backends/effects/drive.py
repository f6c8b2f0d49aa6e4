"""The motor's force and what the driven axle can pass on. Acting order: sag, brake asymmetry, saturation, traction."""

from __future__ import annotations

import math

from sim_backends.array_ops import Ops
from sim_backends.effects.base import DynamicsEffect, EffectParameter, Forces, Parameters

LARGEST_FORCE_N = 1e9
LARGEST_SHARE = 1e6


class BatterySag(DynamicsEffect):
    """``drive_gain (1 - rate t)``, t since the first row of the recording; not below zero."""

    id = "battery_sag"
    sentence = "The drive weakens with time as the battery runs down."
    order = 10
    parameters = (EffectParameter("rate", "1/s", 0.0, -1.0, 1.0, 0.003),)
    look_alikes = ("friction_drift",)

    def on_drive(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Weaken."""
        forces.drive = forces.drive * ops.floor(1.0 - values["rate"] * forces.t_s, 0.0)


class BrakeAsymmetry(DynamicsEffect):
    """``drive force * gain_ratio`` where drive force and vx have opposite signs."""

    id = "brake_asymmetry"
    sentence = "The motor brakes with another gain than it drives."
    order = 20
    parameters = (EffectParameter("gain_ratio", "1", 1.0, 0.0, 10.0, 1.5),)

    def on_drive(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Scale while braking."""
        braking = forces.drive * forces.vx < 0.0
        forces.drive = ops.where(braking, forces.drive * values["gain_ratio"], forces.drive)


class MotorSaturation(DynamicsEffect):
    """Drive force clipped to ``+-force``, before damping."""

    id = "motor_saturation"
    sentence = "The motor gives no more than a certain force."
    order = 30
    parameters = (EffectParameter("force", "N", math.inf, 0.0, math.inf, 3.0),)
    look_alikes = ("throttle_nonlinearity", "traction_limit")

    def on_drive(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Clip."""
        limit = ops.where(values["force"] < LARGEST_FORCE_N, values["force"], LARGEST_FORCE_N)
        forces.drive = ops.clip(forces.drive, -limit, limit)


class TractionLimit(DynamicsEffect):
    """``|F_x at the driven axle| <= share mu F_z`` of the rear axle, or of both where ``axle`` is "all".

    F_x is the base model's, drive less damping; resistances act on the body and do not count.
    """

    id = "traction_limit"
    sentence = "The driven wheels pass on no more force than their grip allows."
    order = 40
    parameters = (
        EffectParameter("share", "1", math.inf, 0.0, math.inf, 0.7),
        EffectParameter("axle", "1", 0.0, 0.0, 1.0, 0.0, choices=("rear", "all")),
    )
    look_alikes = ("motor_saturation", "friction_ellipse")

    def on_traction(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Clip."""
        rear = forces.grip_rear * forces.load_rear
        grip = ops.where(values["axle"] < 0.5, rear, rear + forces.grip_front * forces.load_front)
        limited = values["share"] < LARGEST_SHARE
        limit = ops.where(limited, values["share"], 1.0) * grip
        forces.axle_force = ops.where(limited, ops.clip(forces.axle_force, -limit, limit), forces.axle_force)
