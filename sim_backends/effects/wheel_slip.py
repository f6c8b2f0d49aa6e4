"""Spin of the driven wheels: a stiff state, integrated implicitly."""

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
    StepStart,
)

WHEEL_RADIUS_M = 0.033
"""Radius of a wheel of a 1:10 touring car; the catalogue has no parameter for it. Inertia scales with its square."""
MIN_INERTIA_KGM2 = 1e-9
"""Inertias below this value are inactive: the wheels transmit the drive force, as in the base model [kg m2]."""
SUBSTEPS = 4
_NEWTON_STEPS = 6
_HALLEY_STEPS = 3
MAX_STIFFNESS_N = 1e5
_MIN_GRIP_N = 1e-6
_SLIP_SPEED, _RIM_ACCELERATION = "longitudinal_slip.slip_speed", "longitudinal_slip.rim_acceleration"


class LongitudinalSlip(DynamicsEffect):
    """``J dw/dt = T - R F_x(slip)`` with ``slip = (R w - vx) / max(|vx|, 0.3 m/s)`` and ``T = R (drive - damping vx)``.

    ``F_x = mu F_z,rear tanh(stiffness slip / (mu F_z,rear))``: ``stiffness`` [N] is the slope at zero slip, the rear
    axle's friction the limit (slope and limit are those of the brush model, Pacejka 2012, "Tire and Vehicle Dynamics",
    ch. 3; the tanh between them is our choice). ``inertia`` [kg m2] is that of all driven wheels and what turns with
    them, with wheels of radius R = 0.033 m. Without inertia it is the base model: the force of the motor arrives whole
    and at once.

    The state is the slip speed ``s = R w - vx``. Its eigenvalue, ``(R^2/J + 1/m) stiffness / max(|vx|, 0.3)``, is
    thousands per second, so each Runge-Kutta step takes the pair (s, vx), all other forces held, by the implicit Euler
    rule in four substeps and drives the car with the mean force: stable for every inertia, and momentum is conserved.
    """

    id = "longitudinal_slip"
    represented_by = ("drive_map",)
    command = "throttle"
    name = "longitudinal slip of the driven wheels"
    summary = "The driven wheels slip: they accelerate before the car does, and transmit at most their grip."
    sentence = "the driven wheels slip: their inertia is {inertia}, their longitudinal tyre stiffness {stiffness}"
    refuted_if = "the drive force is late by the same time at low and at high throttle (then the motor lags)"
    order = 50
    states = ("slip_speed",)
    stiff = True
    parameters = (
        EffectParameter("inertia", "kg m2", 0.0, 0.0, 1.0, 1e-4),
        EffectParameter("stiffness", "N", math.inf, 0.0, math.inf, 40.0, positive=True),
    )
    confusable = (
        Confusable(
            "motor_lag",
            "throttle_steps",
            "a lag is equal for small and large steps; wheels spin at large steps only",
        ),
        Confusable(
            "traction_limit",
            "throttle_steps",
            "wheels that spin need time to accelerate and to grip again; a limit of traction acts at once",
        ),
    )

    def on_traction(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """The tyres' force instead of the motor's."""
        rolls = values["inertia"] >= MIN_INERTIA_KGM2
        if self.id in forces.stiff:
            forces.axle_force = ops.where(rolls, forces.stiff[self.id].axle_force, forces.axle_force)
            return
        force = _force(ops, forces, values, forces.states[_SLIP_SPEED])
        per_inertia = WHEEL_RADIUS_M**2 / ops.at_least(values["inertia"], MIN_INERTIA_KGM2)
        rate = per_inertia * (forces.axle_force - force)
        forces.rates[_RIM_ACCELERATION] = rate
        forces.axle_force = ops.where(rolls, force, forces.axle_force)

    def on_motion(self, ops: Ops, forces: Forces, acceleration_mps2: Value, values: Parameters) -> None:
        """Rate of the slip speed."""
        if self.id not in forces.stiff:
            forces.rates[_SLIP_SPEED] = forces.rates[_RIM_ACCELERATION] - acceleration_mps2

    def stiff_step(self, ops: Ops, start: StepStart, values: Parameters) -> SlipStep:
        """The implicit Euler rule for slip and forward speed, all other forces held."""
        return SlipStep(ops, start, values)

    def settled(self, ops: Ops, forces: Forces, values: Parameters) -> dict[str, Value]:
        """Slip speed [m/s] at which wheels and car have equal acceleration; at most 0.95 of the force limit."""
        _, peak = _limits(ops, forces, values)
        wheels = ops.at_least(values["inertia"], MIN_INERTIA_KGM2) / WHEEL_RADIUS_M**2
        share = ops.clip(forces.axle_force * forces.mass / ((forces.mass + wheels) * peak), -0.95, 0.95)
        return {_SLIP_SPEED: _atanh(ops, share) / _per_speed(ops, forces.vx, forces, values)}


def _limits(ops: Ops, forces: Forces, values: Parameters) -> tuple[Value, Value]:
    stiffness = ops.where(values["stiffness"] < MAX_STIFFNESS_N, values["stiffness"], MAX_STIFFNESS_N)
    return stiffness, ops.at_least(forces.grip_rear * forces.load_rear, _MIN_GRIP_N)


def _per_speed(ops: Ops, vx: Value, forces: Forces, values: Parameters) -> Value:
    """Slip of 1 in the argument of the tanh, for each m/s of slip speed."""
    stiffness, peak = _limits(ops, forces, values)
    return stiffness / (ops.at_least(ops.abs(vx), SLIP_FLOOR_MPS) * peak)


def _force(ops: Ops, forces: Forces, values: Parameters, slip_mps: Value) -> Value:
    _, peak = _limits(ops, forces, values)
    return peak * ops.tanh(slip_mps * _per_speed(ops, forces.vx, forces, values))


def _atanh(ops: Ops, x: Value) -> Value:
    """Newton's method from the series; for |x| <= 0.95."""
    y = x * (1.0 + x * x * (1.0 / 3.0 + x * x * 0.2))
    for _ in range(_NEWTON_STEPS):
        t = ops.tanh(y)
        y = y + (x - t) / (1.0 - t * t)
    return y


class SlipStep:
    """One Runge-Kutta step of the wheels: ``axle_force`` is the tyres' mean force over it [N]."""

    def __init__(self, ops: Ops, start: StepStart, values: Parameters) -> None:
        forces, acceleration_mps2 = start.forces()
        other = forces.mass * acceleration_mps2 - forces.axle_force
        self.axle_force, self._slip_mps = step_wheels(
            ops, forces, values, forces.demand, start.damping, other, start.step_s
        )

    def finish(self) -> dict[str, Value]:
        """The slip speed at the end of the step [m/s]."""
        return {_SLIP_SPEED: self._slip_mps}


def step_wheels(
    ops: Ops, forces: Forces, values: Parameters, demand: Value, damping: Value, rest: Value, step_s: Value
) -> tuple[Value, Value]:
    """Mean force of the tyres over a step [N] and the slip speed at its end [m/s].

    Args:
        ops: Functions of the array library.
        forces: All forces at the start of the step.
        values: ``inertia`` and ``stiffness``.
        demand: Motor force on the axle at the start, less damping [N].
        damping: Decrease of the motor force per speed [N s/m].
        rest: All other forces along x, ``m vy r`` included [N].
        step_s: Length of the step [s].
    """
    _, peak = _limits(ops, forces, values)
    per_mass = 1.0 / forces.mass
    per_inertia = WHEEL_RADIUS_M**2 / ops.at_least(values["inertia"], MIN_INERTIA_KGM2)
    both = per_inertia + per_mass
    short_s = step_s * (1.0 / SUBSTEPS)
    slip, vx = forces.states[_SLIP_SPEED], forces.vx
    force = _force(ops, forces, values, slip)
    total = 0.0 * force
    for _ in range(SUBSTEPS):
        vx_half = vx + 0.5 * short_s * per_mass * (force + rest)
        gain = _per_speed(ops, vx_half, forces, values)
        push = (demand + damping * (forces.vx - vx_half)) * per_inertia - rest * per_mass
        # z + q tanh z = c with z = gain * slip: monotone, one root.
        q = short_s * both * peak * gain
        c = gain * (slip + short_s * push)
        z = _root(ops, q, c)
        force = peak * ops.tanh(z)
        slip = z / gain
        vx = vx + short_s * per_mass * (force + rest)
        total = total + force
    return total * (1.0 / SUBSTEPS), slip


def _root(ops: Ops, q: Value, c: Value) -> Value:
    """Solve ``z + q tanh z = c`` for z by Halley's method, for q >= 0.

    It starts from the series of the solution to third order, or beyond its range from ``tanh z = 1``. The error of
    ``tanh z`` is below 4e-4, for q < 100 below 2e-8, and below 1e-14 if ``|c|`` differs from ``1 + q`` by 10 %.
    """
    linear, size = c / (1.0 + q), ops.abs(c)
    series = linear * (1.0 + linear * linear * q / (3.0 * (1.0 + q)))
    z = ops.where(size < 1.0 + q, series, c - ops.sign(c) * q)
    for _ in range(_HALLEY_STEPS):
        t = ops.tanh(z)
        slope = q * (1.0 - t * t)
        error = z + q * t - c
        z = z - error * (1.0 + slope) / ((1.0 + slope) * (1.0 + slope) + error * slope * t)
    return z
