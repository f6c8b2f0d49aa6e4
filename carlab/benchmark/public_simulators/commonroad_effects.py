"""Presence of each effect of the catalogue in the equations of the package commonroad-vehicle-models.

Read off vehicle_dynamics_mb.py, vehicle_dynamics_std.py, tire_model.py, steering_constraints.py and
acceleration_constraints.py of version 3.0.2. ``yes``: the effect is in the equations. ``akin``: something else is
there that acts alike, so the name is a fair reading of it but not its own. ``no``: nothing there acts like it.
Written from the equations and the interface alone, before any diagnosis was looked at; only ``steering_lag`` was
raised from ``akin`` to ``yes`` afterwards, because the interface is that lag exactly.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from carlab.benchmark.public_simulators.commonroad import Model, PublicCar

Stance = Literal["yes", "akin", "no"]
BOTH: tuple[Model, ...] = ("multi_body", "drift")


@dataclass(frozen=True)
class Physics:
    """Whether an effect is in the equations of ``models``, and where."""

    stance: Stance
    why: str
    models: tuple[Model, ...] = BOTH


_NO_OBSERVATION = Physics("no", "pose and velocities are measured as the nominal car file has it")
_NO_DRAG = Physics("no", "the package has no resistance to rolling or air; only slip and the front wheels' side force")

PHYSICS: dict[str, tuple[Physics, ...]] = {
    "command_delay": (Physics("no", "both commands act after the delay that the car file has"),),
    "steering_delay": (Physics("akin", "no delay beyond the file's; the bounded steering rate comes late, too"),),
    "throttle_delay": (Physics("akin", "no delay beyond the file's; wheel and tyre slip take a while to build force"),),
    "steering_lag": (Physics("yes", "of the interface: the rate asked is (command - angle) / (1/30 s), a lag"),),
    "steering_rate_limit": (Physics("yes", "steering_constraints.py: abs(d delta/dt) <= v_max, 1.26 rad/s as scaled"),),
    "steering_deadband": (Physics("no", "the angle follows its input without play or threshold"),),
    "steering_backlash": (Physics("no", "the angle follows its input without play"),),
    "steering_offset": (
        Physics("no", "left and right alike", ("drift",)),
        Physics("akin", "p_vy1 and p_hy1 push sideways by the sign of camber, alike to both sides", ("multi_body",)),
    ),
    "steering_asymmetry": (Physics("no", "left and right alike"),),
    "steering_nonlinearity": (Physics("akin", "the angle is linear; the front tyre's Magic Formula saturates"),),
    "throttle_deadband": (Physics("no", "acceleration is asked in proportion to the throttle"),),
    "throttle_nonlinearity": (Physics("akin", "asked in proportion; the tyre's force over slip is no straight line"),),
    "motor_lag": (Physics("akin", "no motor state; force follows torque through wheel inertia and slip"),),
    "motor_saturation": (Physics("akin", "a_max = 11.5 m/s2 is beyond the commands; the rear tyres bound force"),),
    "traction_limit": (Physics("yes", "F_x saturates at p_dx1 F_z of the driven rear wheels (tire_model.py)"),),
    "brake_asymmetry": (Physics("yes", "engine torque goes to the rear (T_se = 0), brake torque 66 % to the front"),),
    "battery_sag": (Physics("no", "nothing depends on time"),),
    "rolling_resistance": (_NO_DRAG,),
    "aerodynamic_drag": (_NO_DRAG,),
    "cornering_drag": (Physics("akin", "slip lowers F_x (r_bx1, combined slip) and camber and load shift add to it"),),
    "tyre_saturation": (Physics("yes", "Magic Formula; the nominal car file has one already"),),
    "friction_ellipse": (Physics("yes", "combined slip: formula_lateral_comb, formula_longitudinal_comb"),),
    "longitudinal_slip": (Physics("yes", "wheel-speed states, I_y_w d omega/dt = T - R_w F_x(slip)"),),
    "tyre_relaxation": (
        Physics("no", "tyre forces follow slip at once", ("drift",)),
        Physics("akin", "forces follow slip at once, but the compliant joint K_ras, K_rad and the roll delay them",
                ("multi_body",)),
    ),
    "load_transfer": (
        Physics("yes", "F_zf, F_zr shift by m h_s u2 / L", ("drift",)),
        Physics("yes", "pitch and wheel loads: K_zt z, sumM_s with F_x (h_s - z)", ("multi_body",)),
    ),
    "roll_dynamics": (
        Physics("no", "single track", ("drift",)),
        Physics("yes", "states x7, x8, x14, x15, x19, x20; camber by D_f, D_r", ("multi_body",)),
    ),
    "friction_drift": (Physics("no", "nothing depends on time"),),
    "low_friction_patch": (Physics("no", "nothing depends on place"),),
    "aerodynamic_downforce": (Physics("no", "no aerodynamics"),),
    "yaw_damping": (
        Physics("no", "no moment against the yaw rate beside the tyres'", ("drift",)),
        Physics("akin", "(F_x,left - F_x,right) T / 2: wheels of one axle slip unlike in a turn", ("multi_body",)),
    ),
    "torque_steer": (
        Physics("no", "single track", ("drift",)),
        Physics("akin", "(F_x,left - F_x,right) T / 2, but of the sign of the turn", ("multi_body",)),
    ),
    "lateral_bias": (
        Physics("no", "left and right alike", ("drift",)),
        Physics("akin", "p_vy1 and p_hy1 push sideways by the sign of camber, alike to both sides", ("multi_body",)),
    ),
    "road_slope": (Physics("no", "the ground is level"),),
    "mocap_latency": (_NO_OBSERVATION,),
    "marker_offset": (_NO_OBSERVATION,),
    "mocap_yaw_misalignment": (_NO_OBSERVATION,),
    "velocity_filter_lag": (_NO_OBSERVATION,),
}  # fmt: skip


def physics_of(effect: str, model: Model) -> Physics:
    """Presence of an effect in the equations of ``model``; ``no`` for an unknown id."""
    for physics in PHYSICS.get(effect, ()):
        if model in physics.models:
            return physics
    return Physics("no", "not a name of the catalogue")


def true_values(car: PublicCar) -> dict[tuple[str, str], float]:
    """True values of parameters with the same meaning in the package, by effect and name."""
    p = car.p
    return {
        ("steering_rate_limit", "rate"): p.steering.v_max,
        ("steering_lag", "time_constant"): car.car.control_period,
        ("load_transfer", "height"): p.h_cg if car.model == "multi_body" else p.h_s,
    }
