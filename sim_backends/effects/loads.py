"""Axle loads, and the roll of the body that shifts them from side to side."""

from __future__ import annotations

import math

from sim_backends.array_ops import Ops, Value
from sim_backends.effects.base import GRAVITY_MPS2, Confusable, DynamicsEffect, EffectParameter, Forces, Parameters

ROLL_SENSITIVITY = 0.3
"""Default share of an axle's side force that is lost when its inner wheels carry no load."""
MAX_ROLL_HZ = 25.0
"""Highest roll frequency for steps of 10 ms; above, the loss is scaled by ``MAX_ROLL_HZ / frequency``."""


MIN_FORCE_SHARE = 0.1
"""Minimum share of the side force that remains with roll."""


class AerodynamicDownforce(DynamicsEffect):
    """``F_z += coefficient vx^2`` in all, split like the static loads."""

    id = "aerodynamic_downforce"
    name = "downforce"
    summary = "Aerodynamic downforce: tyre loads, and with them grip, grow with the square of speed."
    sentence = "the tyres carry {coefficient} times speed squared more than the car's weight"
    refuted_if = "the highest speed in a corner is not higher than grip without downforce allows"
    order = 10
    parameters = (EffectParameter("coefficient", "N s2/m2", 0.0, -10.0, 10.0, 0.3),)

    def on_load(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Scale both loads."""
        extra = values["coefficient"] * forces.vx * forces.vx
        factor = ops.at_least(1.0 + extra / (forces.mass * GRAVITY_MPS2), 0.0)
        forces.load_front, forces.load_rear = forces.load_front * factor, forces.load_rear * factor


class LoadTransfer(DynamicsEffect):
    """``F_z,front -= m ax h / L`` and ``F_z,rear += m ax h / L`` with ax = dvx/dt - vy r; loads not below zero.

    ax depends on the front's side force and so on the load. That force is proportional to the load,
    ``F_front = f F_z,front``, so the loop is closed exactly: with ``k = h / L`` and ``X`` all longitudinal forces but
    that one, ``m ax = X - f (F_z,front - k m ax) sin d`` gives ``m ax = (X - f F_z,front sin d) / (1 - k f sin d)``.
    Source of the transfer: Milliken and Milliken 1995, "Race Car Vehicle Dynamics", ch. 18. ``f`` is that of the steady
    force, before relaxation and roll. With a limit of the driven axle that itself depends
    on the load, both are repeated twice (the loop's gain is about ``mu h / L``).
    """

    id = "load_transfer"
    name = "load transfer between the axles"
    summary = "Acceleration moves load to the rear axle, and braking moves load to the front axle."
    sentence = "acceleration and braking move load between the axles, as with a centre of mass {height} above the floor"
    refuted_if = (
        "braking and acceleration change the handling balance in the same direction (then tyres share their grip)"
    )
    parameters = (EffectParameter("height", "m", 0.0, 0.0, 1.0, 0.04),)

    def on_transfer(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Move load."""
        lever = values["height"] / (forces.front_axle + forces.rear_axle)
        pull = forces.front_per_load * forces.wheel_sin
        moved = lever * (forces.force_x - pull * forces.load_front) / ops.at_least(1.0 - lever * pull, 0.1)
        forces.load_front = ops.at_least(forces.load_front - moved, 0.0)
        forces.load_rear = ops.at_least(forces.load_rear + moved, 0.0)


class RollDynamics(DynamicsEffect):
    """Second-order roll that shifts load between the sides, which costs grip, later than the side force changes.

    ``rho`` is the share of the load that has moved from the inner to the outer wheels, 1 where all of the grip is used:
    ``rho'' + 2 damping w rho' + w^2 rho = w^2 ay / (mu g)``, ``w = 2 pi frequency``, with ay of the side forces and
    ``mu g = (mu_f F_z,f + mu_r F_z,r) / m``. By the tyres' load sensitivity both axles keep ``1 - sensitivity rho^2``
    of their side force. Above 25 Hz the loss fades, so that an infinite frequency is the base model.
    Source: roll and load sensitivity of Milliken and Milliken 1995, "Race Car Vehicle Dynamics".
    """

    id = "roll_dynamics"
    name = "roll of the body"
    summary = (
        "The body rolls and oscillates: load moves between the left and right wheels later than the side force changes."
    )
    sentence = (
        "the body rolls at {frequency} with a damping ratio of {damping}, and load that changes sides costs grip, "
        "with a sensitivity of {sensitivity}"
    )
    refuted_if = "fast weaving shows no resonance near that frequency"
    order = 50
    states = ("shift", "shift_rate")
    base_models = ("dynamic", "kinematic", "blend")
    """With linear tyres the loss of grip by roll would replace the missing saturation."""
    parameters = (
        EffectParameter("frequency", "Hz", math.inf, 0.0, math.inf, 2.5, positive=True),
        EffectParameter("damping", "1", 0.5, 0.0, 5.0, 0.3),
        EffectParameter("sensitivity", "1", ROLL_SENSITIVITY, 0.0, 20.0, 0.5),
    )
    confusable = (
        Confusable(
            "load_transfer",
            "steering_chirp",
            "a rolling body responds late, and most near its natural frequency; load transfer acts at once",
        ),
    )

    def on_tyre(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Scale both side forces and set the rates of the roll."""
        shift, rate = forces.states["roll_dynamics.shift"], forces.states["roll_dynamics.shift_rate"]
        share = ops.at_least(1.0 - _loss(ops, values) * shift * shift, MIN_FORCE_SHARE)
        forces.side_front, forces.side_rear = forces.side_front * share, forces.side_rear * share
        omega = 2.0 * math.pi * ops.where(values["frequency"] < MAX_ROLL_HZ, values["frequency"], MAX_ROLL_HZ)
        forces.rates["roll_dynamics.shift"] = rate
        forces.rates["roll_dynamics.shift_rate"] = omega * (
            omega * (_used_grip(ops, forces) - shift) - 2.0 * values["damping"] * rate
        )

    def settled(self, ops: Ops, forces: Forces, values: Parameters) -> dict[str, Value]:
        """Rolled as in steady cornering: ``rho = (1 - loss rho^2) rho_0``, rho_0 being that of the unscaled forces."""
        alone = _used_grip(ops, forces)
        steady = 2.0 * alone / (1.0 + ops.sqrt(1.0 + 4.0 * _loss(ops, values) * alone * alone))
        return {"roll_dynamics.shift": steady, "roll_dynamics.shift_rate": 0.0 * steady}


def _loss(ops: Ops, values: Parameters) -> Value:
    slow = values["frequency"] < MAX_ROLL_HZ
    return values["sensitivity"] * ops.where(slow, 1.0, MAX_ROLL_HZ / values["frequency"])


def _used_grip(ops: Ops, forces: Forces) -> Value:
    side = forces.side_front * forces.wheel_cos + forces.side_rear
    grip = forces.grip_front * forces.load_front + forces.grip_rear * forces.load_rear
    return ops.clip(side / ops.at_least(grip, 1e-6), -1.0, 1.0)
