"""Presence of each effect of the catalogue in the equations of the package commonroad-vehicle-models.

Source: vehicle_dynamics_mb.py, vehicle_dynamics_std.py, tire_model.py, steering_constraints.py and
acceleration_constraints.py of version 3.0.2. ``yes``: the equations contain the effect. ``similar``: they contain other
physics with a similar influence. ``no``: they contain neither. The table was written before any diagnosis, from the
equations and the interface alone. Only ``steering_lag`` was changed afterwards, from ``similar`` to ``yes``, because
the interface is exactly this lag.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from carlab.benchmark.public_simulators.commonroad import Model, PublicCar

Presence = Literal["yes", "similar", "no"]
BOTH: tuple[Model, ...] = ("multi_body", "drift")


@dataclass(frozen=True)
class Physics:
    """Whether an effect is in the equations of ``models``, and where."""

    presence: Presence
    why: str
    models: tuple[Model, ...] = BOTH


_NO_OBSERVATION = Physics("no", "pose and velocities are measured as the nominal car file states")
_NO_DRAG = Physics("no", "the package has no resistance to rolling or air; only slip and the front wheels' side force")

PHYSICS: dict[str, tuple[Physics, ...]] = {
    "command_delay": (Physics("no", "both commands act after the delay that the car file states"),),
    "steering_delay": (Physics("similar", "no delay beyond the file's; the limited steering rate delays the angle"),),
    "throttle_delay": (Physics("similar", "no delay beyond the file's; force builds up with wheel and tyre slip"),),
    "steering_lag": (Physics("yes", "in the interface: the requested rate is (command - angle) / (1/30 s)"),),
    "steering_rate_limit": (Physics("yes", "steering_constraints.py: abs(d delta/dt) <= v_max, 1.26 rad/s as scaled"),),
    "steering_deadband": (Physics("no", "the angle follows its input without play or threshold"),),
    "steering_backlash": (Physics("no", "the angle follows its input without play"),),
    "steering_offset": (
        Physics("no", "left and right alike", ("drift",)),
        Physics("similar", "p_vy1, p_hy1: side forces with the sign of camber, equal on both sides", ("multi_body",)),
    ),
    "steering_asymmetry": (Physics("no", "left and right alike"),),
    "steering_nonlinearity": (Physics("similar", "the angle is linear; the front tyre's Magic Formula saturates"),),
    "throttle_deadband": (Physics("no", "the requested acceleration is proportional to the throttle"),),
    "throttle_nonlinearity": (Physics("similar", "the request is proportional; the tyre's force over slip is not"),),
    "throttle_asymmetry": (Physics("similar", "the request is symmetric; brake torque goes to the front wheels too"),),
    "motor_lag": (Physics("similar", "no motor state; force follows torque through wheel inertia and slip"),),
    "motor_saturation": (Physics("similar", "commands stay below a_max = 11.5 m/s2; the rear tyres limit the force"),),
    "traction_limit": (Physics("yes", "F_x saturates at p_dx1 F_z of the driven rear wheels (tire_model.py)"),),
    "speed_controller": (Physics("similar", "no controller; F_x of the rear wheels is limited in both directions"),),
    "drag_brake": (Physics("no", "without throttle the requested acceleration is zero"),),
    "all_wheel_drive": (Physics("similar", "66 % of the brake torque goes to the front, no engine torque (T_se = 0)"),),
    "brake_asymmetry": (Physics("yes", "engine torque goes to the rear (T_se = 0), brake torque 66 % to the front"),),
    "battery_sag": (Physics("no", "nothing depends on time"),),
    "rolling_resistance": (_NO_DRAG,),
    "aerodynamic_drag": (_NO_DRAG,),
    "cornering_drag": (Physics("similar", "slip (r_bx1, combined slip), camber and load transfer lower F_x"),),
    "wheelbase": (Physics("no", "the car file has the wheelbase of the simulator"),),
    "centre_of_mass": (Physics("no", "the car file has the axle distances of the simulator"),),
    "tyre_saturation": (Physics("yes", "Magic Formula; the nominal car file has one already"),),
    "front_wheel_play": (Physics("no", "the front tyres' slip follows from the steering angle without play"),),
    "friction_ellipse": (Physics("yes", "combined slip: formula_lateral_comb, formula_longitudinal_comb"),),
    "combined_slip": (Physics("similar", "combined slip of spinning wheels, but their speed is a state"),),
    "longitudinal_slip": (Physics("yes", "wheel-speed states, I_y_w d omega/dt = T - R_w F_x(slip)"),),
    "tyre_relaxation": (
        Physics("no", "tyre forces follow slip at once", ("drift",)),
        Physics("similar", "forces follow slip at once, but the compliant joint K_ras, K_rad and the roll delay them",
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
        Physics("no", "no moment against the yaw rate but the tyres'", ("drift",)),
        Physics("similar", "(F_x,left - F_x,right) T / 2: an axle's wheels slip differently in turns", ("multi_body",)),
    ),
    "torque_steer": (
        Physics("no", "single track", ("drift",)),
        Physics("similar", "(F_x,left - F_x,right) T / 2, but of the sign of the turn", ("multi_body",)),
    ),
    "lateral_bias": (
        Physics("no", "left and right alike", ("drift",)),
        Physics("similar", "p_vy1, p_hy1: side forces with the sign of camber, equal on both sides", ("multi_body",)),
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
