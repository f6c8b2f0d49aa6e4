"""Motor force and force limit of the driven axle.

Acting order: sag, brake asymmetry, drag brake, saturation, speed controller, traction.
"""

from __future__ import annotations

import math

from carlab.core.quantities import FloatArray
from sim_backends.array_ops import Ops, Value
from sim_backends.effects.base import (
    Confusable,
    DynamicsEffect,
    EffectParameter,
    Forces,
    Parameters,
    ScreeningProbe,
)
from sim_backends.effects.resistances import ROLLING_SPEED_MPS

MAX_FORCE_N = 1e9
MAX_SHARE = 1e6
TINY = 1e-12
"""Keeps a root differentiable and a quotient finite."""
RELEASED_THROTTLE = 0.05
"""Throttle at which a drag brake ends [1]."""
SCREENING_RATIOS = (0.15, 0.25, 0.4, 0.6, 0.9, 1.3, 2.0, 3.0, 5.0)
"""Sizes of the forces of a screened speed controller, over typical ones."""
SCREENING_ROUNDNESS = 0.1


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
    represented_by = ("drive_map",)
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


def drag_brake_share(ops: Ops, throttle: Value, vx: Value, width: Value) -> Value:
    """Force (cars,) of a drag brake along x, over its largest force: ``-max(1 - |u| / width, 0) tanh(vx / 0.05 m/s)``.

    Args:
        ops: Functions of the array library.
        throttle: [1].
        vx: Speed [m/s].
        width: Throttle at which the brake ends [1].
    """
    released = ops.at_least(1.0 - ops.abs(throttle) / width, 0.0)
    return -released * ops.tanh(vx * (1.0 / ROLLING_SPEED_MPS))


class DragBrake(DynamicsEffect):
    """``F_x -= force max(1 - |u| / 0.05, 0) tanh(vx / 0.05 m/s)``: the motor brakes while the throttle is released.

    Motor controllers of RC cars have such a brake as a setting. It is a part of the motor's force, so a limit of that
    force includes it.
    """

    id = "drag_brake"
    represented_by = ("drive_map",)
    command = "throttle"
    name = "a drag brake with the throttle released"
    summary = "The motor brakes while the throttle is released."
    sentence = "the motor brakes with {force} while the throttle is released"
    refuted_if = "the car slows down as much with a little throttle as with none (then it is a resistance)"
    order = 27
    parameters = (EffectParameter("force", "N", 0.0, 0.0, 50.0, 2.0),)
    confusable = (
        Confusable(
            "rolling_resistance",
            "throttle_ramp",
            "a drag brake ends with the first throttle, while a resistance slows the car at any throttle",
        ),
        Confusable(
            "throttle_deadband",
            "coast_down",
            "without throttle a dead band has no effect, while a drag brake stops the car",
        ),
    )

    def on_drive(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Brake."""
        share = drag_brake_share(ops, forces.throttle, forces.vx, RELEASED_THROTTLE)
        forces.drive = ops.fma(values["force"], share, forces.drive)


def limited_force(ops: Ops, force: Value, limit: Value, roundness: Value) -> Value:
    """Limit a force (cars,) [N]: ``2 a b / (a + b + sqrt((a - b)^2 + 4 roundness a b))`` for its size a, with limit b.

    This is the smaller root m of ``(1 - roundness) m^2 - (a + b) m + a b = 0``, a non-rectangular hyperbola: for small
    forces a, for large ones b, and without roundness the smaller of both.
    """
    size = ops.abs(force)
    root = ops.sqrt((size - limit) * (size - limit) + 4.0 * roundness * size * limit + TINY)
    return 2.0 * force * limit / (size + limit + root)


def _finite_limit(ops: Ops, force: Value) -> Value:
    """Replace an infinite limit (cars,) [N] by ``MAX_FORCE_N``, because ``limited_force`` needs a finite one."""
    return ops.where(force < MAX_FORCE_N, force, MAX_FORCE_N)


class MotorSaturation(DynamicsEffect):
    """``2 a b / (a + b + sqrt((a - b)^2 + 4 roundness a b))`` for the size a of the drive force, with b = ``force``.

    For small forces a, for large ones b, and without roundness the smaller of both. It acts before damping.
    """

    id = "motor_saturation"
    represented_by = ("drive_map", "throttle_curve")
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
        forces.drive = limited_force(ops, forces.drive, _finite_limit(ops, values["force"]), values["roundness"])


def limited_by_direction(ops: Ops, force: Value, forward: Value, backward: Value, roundness: Value) -> Value:
    """Limit a force (cars,) [N] to ``forward`` where it is positive, and to ``backward`` [N] where it is negative."""
    return limited_force(ops, force, ops.where(force < 0.0, backward, forward), roundness)


class SpeedController(DynamicsEffect):
    """``F_x = L(drive_gain u - damping vx)``: a controller that holds the speed ``u drive_gain / damping``.

    Its gain is ``damping``. L limits its force to ``forward_force`` and, in the other direction, to ``backward_force``:
    ``2 a b / (a + b + sqrt((a - b)^2 + 4 roundness a b))`` for the size a of a force with the limit b, without
    roundness the smaller of both.
    """

    id = "speed_controller"
    represented_by = ("drive_map",)
    command = "throttle"
    name = "a controller that holds a speed, with limited force"
    summary = "The motor controller holds the speed that the throttle demands, with limited force."
    sentence = (
        "the motor controller holds a speed, with a force of at most {forward_force} forwards and {backward_force} "
        "backwards, with roundness {roundness} (0: sharp limits)"
    )
    refuted_if = "without throttle, a faster car slows down more (then the braking force has no limit)"
    order = 35
    parameters = (
        EffectParameter("forward_force", "N", math.inf, 0.0, math.inf, 3.0),
        EffectParameter("backward_force", "N", math.inf, 0.0, math.inf, 2.5),
        EffectParameter("roundness", "1", 0.0, 0.0, 1.0, 0.3),
    )
    confusable = (
        Confusable(
            "motor_saturation",
            "coast_down",
            "a controller with limited force brakes a fast car no more than a slow one; damping brakes it more",
        ),
        Confusable(
            "traction_limit",
            "throttle_ramp",
            "a limit of traction falls in turns, which need grip; that of a motor controller does not",
        ),
    )

    def screening_points(self, probe: ScreeningProbe) -> FloatArray:
        """Limits of equal and of different size in both directions, slightly round."""
        forward, backward, _ = (p.typical for p in self.parameters)
        return probe.points(
            {"forward_force": forward * ahead, "backward_force": backward * back, "roundness": SCREENING_ROUNDNESS}
            for ratio in SCREENING_RATIOS
            for ahead, back in ((ratio, ratio), (ratio, 0.7 * ratio), (0.7 * ratio, ratio))
        )

    def on_traction(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Limit the motor's force, damping included."""
        forward, backward = (_finite_limit(ops, values[name]) for name in ("forward_force", "backward_force"))
        forces.axle_force = limited_by_direction(ops, forces.axle_force, forward, backward, values["roundness"])


class AllWheelDrive(DynamicsEffect):
    """``share`` times the F_x of the driven axles acts at the front wheels, along them.

    With F = share F_x and the wheel angle d, ``force_x += F (cos d - 1)``, ``F_y += F sin d``, ``M += l_f F sin d``.
    The other effects see one driven axle with all of F_x, except the friction ellipse (each axle has its own). Source:
    the single-track model with front and rear longitudinal forces, Rajamani 2012, "Vehicle Dynamics and Control",
    ch. 2.
    """

    id = "all_wheel_drive"
    command = "throttle"
    name = "drive of the front wheels"
    summary = "The motor drives the front wheels too, so driving and braking turn a steered car."
    sentence = "{share} of the drive force acts at the front wheels, in the direction of these wheels"
    refuted_if = "the front wheels stand still while the motor turns on a lifted car"
    order = 5
    base_models = ("dynamic", "linear_tyre", "blend")
    parameters = (EffectParameter("share", "1", 0.0, 0.0, 1.0, 0.3),)
    confusable = (
        Confusable(
            "load_transfer",
            "throttle_steps",
            (
                "driven front wheels turn the car in proportion to the wheel angle; load transfer changes the "
                "side force in proportion to that force"
            ),
        ),
    )

    def on_body(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Turn the front's force with its wheels."""
        forces.force_x = forces.force_x + values["share"] * forces.axle_force * (forces.wheel_cos - 1.0)

    def on_tyre(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Add the front's force across the car; load transfer and traction do not change the axle force any more."""
        forces.front_force = values["share"] * forces.axle_force
        across = forces.front_force * forces.wheel_sin
        forces.force_y = forces.force_y + across
        forces.moment = forces.moment + forces.front_axle * across


class TractionLimit(DynamicsEffect):
    """``|F_x at the driven axle| <= b`` with ``b = share mu F_z`` of the rear axle, or of both where ``axle`` is "all".

    With ``roundness`` the size is ``2 a b / (a + b + sqrt((a - b)^2 + 4 roundness a b))`` instead of the smaller of a
    and b, where a is the size without limit. F_x is the base model's, drive less damping; resistances act on the body
    and do not count.
    """

    id = "traction_limit"
    represented_by = ("drive_map",)
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
