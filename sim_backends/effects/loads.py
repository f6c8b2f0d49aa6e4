"""Axle loads, and the roll of the body that shifts them from side to side."""

from __future__ import annotations

import math

from sim_backends.array_ops import Ops, Value
from sim_backends.effects.base import GRAVITY_MPS2, DynamicsEffect, EffectParameter, Forces, Parameters

ROLL_SENSITIVITY = 0.3
"""Share of an axle's side force that is lost when its inner wheels carry nothing (tyre load sensitivity)."""
FASTEST_ROLL_HZ = 25.0
"""Above it the roll is too quick for steps of 10 ms: its deviation is scaled by ``FASTEST_ROLL_HZ / frequency``."""


class AerodynamicDownforce(DynamicsEffect):
    """``F_z += coefficient vx^2`` in all, split like the static loads."""

    id = "aerodynamic_downforce"
    sentence = "Aerodynamic downforce: the faster, the more grip."
    order = 10
    parameters = (EffectParameter("coefficient", "N s2/m2", 0.0, -10.0, 10.0, 0.3),)

    def on_load(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Scale both loads."""
        extra = values["coefficient"] * forces.vx * forces.vx
        factor = ops.floor(1.0 + extra / (forces.mass * GRAVITY_MPS2), 0.0)
        forces.load_front, forces.load_rear = forces.load_front * factor, forces.load_rear * factor


class LoadTransfer(DynamicsEffect):
    """``F_z,front -= m ax h / L`` and ``F_z,rear += m ax h / L`` with ax = dvx/dt - vy r; loads not below zero.

    ax depends on the front's side force and so on the load. That force is proportional to the load,
    ``F_front = f F_z,front``, so the loop is closed exactly: with ``k = h / L`` and ``X`` all longitudinal forces but
    that one, ``m ax = X - f (F_z,front - k m ax) sin d`` gives ``m ax = (X - f F_z,front sin d) / (1 - k f sin d)``.
    ``f`` is that of the steady force, before relaxation and roll. With a limit of the driven axle that itself depends
    on the load, both are repeated twice (the loop's gain is about ``mu h / L``).
    """

    id = "load_transfer"
    sentence = "Speeding up presses the rear wheels to the ground and braking the front wheels."
    parameters = (EffectParameter("height", "m", 0.0, 0.0, 1.0, 0.04),)
    look_alikes = ("friction_ellipse",)

    def on_transfer(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Move load."""
        lever = values["height"] / (forces.front_axle + forces.rear_axle)
        pull = forces.front_per_load * forces.wheel_sin
        moved = lever * (forces.force_x - pull * forces.load_front) / ops.floor(1.0 - lever * pull, 0.1)
        forces.load_front = ops.floor(forces.load_front - moved, 0.0)
        forces.load_rear = ops.floor(forces.load_rear + moved, 0.0)


class RollDynamics(DynamicsEffect):
    """Second-order roll that shifts load, and so grip, between the sides, later than the base model has it.

    ``rho`` is the share of the load that has moved from the inner to the outer wheels. It is 1 in steady cornering at
    the limit of grip: ``rho_steady = ay / (mu g)`` with ``mu g = (mu_f F_z,f + mu_r F_z,r) / m`` and ay of the steady
    side forces; ``rho'' + 2 damping w rho' + w^2 rho = w^2 rho_steady``, ``w = 2 pi frequency``. By the tyres' load
    sensitivity an axle's side force is scaled by ``1 - 0.3 (rho^2 - rho_steady^2)``: the base model's tyres are those
    of steady cornering, and an infinite frequency is the base model. Source: the second-order roll of Milliken and
    Milliken 1995, "Race Car Vehicle Dynamics"; the size of the load sensitivity is our choice.
    """

    id = "roll_dynamics"
    sentence = "The body rolls and swings, which shifts grip between the sides later than the side force changes."
    order = 50
    states = ("shift", "shift_rate")
    parameters = (
        EffectParameter("frequency", "Hz", math.inf, 0.0, math.inf, 2.5, positive=True),
        EffectParameter("damping", "1", 0.5, 0.0, 5.0, 0.3),
    )
    look_alikes = ("load_transfer",)

    def on_tyre(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Scale both side forces and set the rates of the roll."""
        steady = _steady_shift(ops, forces)
        shift, rate = forces.states["roll_dynamics.shift"], forces.states["roll_dynamics.shift_rate"]
        slow = values["frequency"] < FASTEST_ROLL_HZ
        frequency = ops.where(slow, values["frequency"], FASTEST_ROLL_HZ)
        omega = 2.0 * math.pi * frequency
        forces.rates["roll_dynamics.shift"] = rate
        forces.rates["roll_dynamics.shift_rate"] = omega * (omega * (steady - shift) - 2.0 * values["damping"] * rate)
        size = ROLL_SENSITIVITY * (frequency / values["frequency"])
        factor = 1.0 - size * (shift * shift - steady * steady)
        forces.side_front, forces.side_rear = forces.side_front * factor, forces.side_rear * factor

    def settled(self, ops: Ops, forces: Forces, values: Parameters) -> dict[str, Value]:
        """Rolled as in steady cornering."""
        steady = _steady_shift(ops, forces)
        return {"roll_dynamics.shift": steady, "roll_dynamics.shift_rate": 0.0 * steady}


def _steady_shift(ops: Ops, forces: Forces) -> Value:
    side = forces.side_front * forces.wheel_cos + forces.side_rear
    grip = forces.grip_front * forces.load_front + forces.grip_rear * forces.load_rear
    return ops.clip(side / ops.floor(grip, 1e-6), -1.0, 1.0)
