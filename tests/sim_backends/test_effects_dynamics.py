"""Test dynamics effects against independent equations integrated by scipy."""

import functools
import math

import numpy as np
import pytest

from sim_backends.car_parameters import SimulatorConfig
from sim_backends.effects import EFFECTS, DynamicsEffect
from tests.helpers.reference_dynamics import DRIVE, START, by_scipy
from tests.sim_backends.test_single_track import drive

TYPICAL = {
    name: {name: {p.name: p.typical for p in effect.parameters}}
    for name, effect in EFFECTS.items()
    if isinstance(effect, DynamicsEffect)
}


def curve_values(name, size):
    """Random deviations, up to ``size`` typical ones, at all knots of a measured curve."""
    curve = EFFECTS[name]
    drawn = np.random.default_rng(0).uniform(-size, size, len(curve.parameters)) * curve.typical
    return {name: {p.name: float(v) for p, v in zip(curve.parameters, drawn, strict=True)}}


CURVE_SIZES = {
    "side_force_over_speed": 1.0,
    "yaw_moment_over_speed": 1.0,
    "side_force_over_slip": 1.0,
    "yaw_moment_over_slip": 1.0,
    "drive_map": 1.0,
    "front_tyre_map": 0.3,
    "rear_tyre_map": 0.3,
}
CASES = {
    **TYPICAL,
    **{name: curve_values(name, size) for name, size in CURVE_SIZES.items()},
    "battery_sag": {"battery_sag": {"rate": 0.4}},
    "friction_drift": {"friction_drift": {"rate": -0.5}},
    "traction_limit_all": {"traction_limit": {"share": 0.5, "axle": "all"}},
    "low_friction_patch": {"low_friction_patch": {"x": 0.9, "y": 0.5, "radius": 0.4, "loss": 0.6}},
    "all_wheel_drive_with_ellipse": {"all_wheel_drive": {"share": 0.6}, "friction_ellipse": {"scale": 0.7}},
    "all_wheel_drive_with_transfer": {"all_wheel_drive": {"share": 0.5}, "load_transfer": {"height": 0.06}},
    "longer_car": {"wheelbase": {"change": 0.2}, "centre_of_mass": {"ahead": -0.03}, "load_transfer": {"height": 0.06}},
    "play": {"front_wheel_play": {"angle": 0.06}},
    "play_with_transfer": {"front_wheel_play": {"angle": 0.04}, "load_transfer": {"height": 0.06}},
    "spinning_wheels": {"combined_slip": {"grip_ratio": 0.5}},
    "spinning_wheels_with_transfer": {"combined_slip": {"grip_ratio": 0.6}, "load_transfer": {"height": 0.06}},
    "spinning_wheels_of_a_limited_motor": {
        "combined_slip": {"grip_ratio": 0.8},
        "speed_controller": {"forward_force": 2.4, "backward_force": 1.0},
    },
    "limited_ellipse": {"friction_ellipse": {"scale": 0.9, "action": "limits"}},
    "torque_with_traction": {
        "torque_steer": {"coefficient": -0.1, "source": "force"},
        "traction_limit": {"share": 0.6},
    },
    "torque_with_traction_and_transfer": {
        "torque_steer": {"coefficient": -0.1, "source": "force"},
        "traction_limit": {"share": 0.6},
        "load_transfer": {"height": 0.06},
    },
    "slow_roll": {"roll_dynamics": {"frequency": 1.2, "damping": 0.2}},
    "soft_roll": {"roll_dynamics": {"frequency": 2.0, "damping": 0.4, "sensitivity": 2.5}},
    "long_relaxation": {"tyre_relaxation": {"length": 0.6}},
    "heavy_wheels": {"longitudinal_slip": {"inertia": 2e-3, "stiffness": 25.0}},
    "ellipse_with_transfer": {"friction_ellipse": {"scale": 0.6}, "load_transfer": {"height": 0.08}},
    "relaxation_with_ellipse": {"friction_ellipse": {"scale": 0.5}, "tyre_relaxation": {"length": 0.2}},
    "changed_saturated_map": {
        "drive_change": {"share": 0.4},
        "motor_saturation": {"force": 2.0},
        "drive_map": curve_values("drive_map", 1.0)["drive_map"],
    },
    "changed_measured_tyres": {
        "grip_change": {"share": -0.3},
        "front_tyre_map": curve_values("front_tyre_map", 0.3)["front_tyre_map"],
        "rear_tyre_map": curve_values("rear_tyre_map", 0.3)["rear_tyre_map"],
    },
    "sag_with_brakes": {
        "battery_sag": {"rate": 0.3},
        "brake_asymmetry": {"gain_ratio": 1.6},
        "motor_saturation": {"force": 3.2},
    },
    "slope_with_patch_and_drag": {
        "road_slope": {"angle": 0.1, "direction": 2.0},
        "low_friction_patch": {"x": 0.9, "y": 0.5, "radius": 0.4, "loss": 0.6},
        "aerodynamic_drag": {"coefficient": 0.3},
    },
    "transfer_with_downforce": {"load_transfer": {"height": 0.1}, "aerodynamic_downforce": {"coefficient": 0.5}},
    "traction_with_transfer": {"traction_limit": {"share": 0.6}, "load_transfer": {"height": 0.06}},
    "limits_of_both_directions": {"speed_controller": {"forward_force": 1.2, "backward_force": 2.5}},
    "round_controller_with_traction_and_transfer": {
        "speed_controller": {"forward_force": 1.5, "backward_force": 3.0, "roundness": 0.3},
        "traction_limit": {"share": 0.5},
        "load_transfer": {"height": 0.06},
    },
    "saturated_drag_brake": {"drag_brake": {"force": 4.0}, "motor_saturation": {"force": 2.5}},
    "controller_with_drag_brake": {
        "drag_brake": {"force": 4.0},
        "speed_controller": {"forward_force": 1.2, "backward_force": 2.5},
    },
    "round_traction_with_transfer": {
        "traction_limit": {"share": 0.7, "roundness": 0.4},
        "load_transfer": {"height": 0.06},
    },
}


@functools.cache
def without_effects():
    """Return the final state of the nominal car by scipy."""
    return by_scipy(SimulatorConfig().parameters, {})


def difference(simulated, reference):
    error = simulated - reference[:6]
    error[2] = math.remainder(error[2], 2 * math.pi)
    return np.abs(error).max()


@pytest.mark.parametrize("case", CASES)
def test_agrees_with_scipy(case, monkeypatch):
    config = SimulatorConfig(command_delay_s=0.0, effects=CASES[case])
    reference = by_scipy(config.parameters, CASES[case])
    if case != "tyre_saturation":
        assert config.parameters == SimulatorConfig().parameters
        assert difference(without_effects()[:6], reference) > 3e-3  # the drive excites the effect
    coarse = difference(drive(config, START, DRIVE), reference)
    monkeypatch.setattr("sim_backends.plant.MAX_STEP_S", 0.001)
    fine = difference(drive(config, START, DRIVE), reference)
    assert coarse < 5e-3
    assert fine < 3e-4


@pytest.mark.parametrize("kind", ["kinematic", "linear_tyre"])
def test_tyre_saturation_is_the_pacejka_car(kind):
    numbers = {"mu_front": 0.5, "B_front": 3.0, "C_front": 1.3, "mu_rear": 0.45, "B_rear": 4.0, "C_rear": 1.4}
    config = SimulatorConfig(kind=kind, command_delay_s=0.0, effects={"tyre_saturation": numbers})
    names = {f"tyre.{k.split('_')[1]}.{k.split('_')[0]}": v for k, v in numbers.items()}
    same = SimulatorConfig(command_delay_s=0.0).with_values(names)
    assert difference(drive(config, START, DRIVE), by_scipy(same.parameters, {})) < 5e-4
    own = SimulatorConfig(kind=kind, effects={"tyre_saturation": {}}).with_values({"tyre.front.mu": 0.3})
    assert own.effects["tyre_saturation"]["mu_front"] == 0.43
    assert (
        SimulatorConfig(kind=kind)
        .with_values({"tyre.front.mu": 0.3, "effects.tyre_saturation.B_rear": 4.0})
        .effects["tyre_saturation"]["mu_front"]
        == 0.3
    )
