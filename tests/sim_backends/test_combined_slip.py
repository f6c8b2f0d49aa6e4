"""Combined slip of the driven tyres against closed forms and bisection."""

import math

import numpy as np
import pytest

from sim_backends.array_ops import ARRAYS, FLOATS
from sim_backends.car_parameters import CarParameters, SimulatorConfig
from sim_backends.dynamics.single_track import SingleTrack
from sim_backends.effects.combined_slip import solve_slip

P = CarParameters()
GRIP_N = P.rear_mu * P.mass_kg * 9.81 * P.front_axle_m / (P.front_axle_m + P.rear_axle_m)


def forces_at(state, throttle, ratio, effects=None, **values):
    """All forces of a car with combined slip, at a state of its body (6,)."""
    config = SimulatorConfig(effects={"combined_slip": {"grip_ratio": ratio}, **(effects or {})})
    config = config.with_values({name.replace("__", "."): v for name, v in values.items()})
    model = SingleTrack(FLOATS, "dynamic", config.values(), config.effects)
    return model.evaluate(0.0, state, model.actuation(0.0, throttle))[1]


@pytest.mark.parametrize("throttle", [-0.9, -0.2, 0.1, 0.4, 1.0])
@pytest.mark.parametrize("vy", [-0.3, 0.02, 0.25])
def test_force_of_isotropic_tyres_points_along_the_slip(throttle, vy):
    """With equal grip along and across and C = 1, the tyre has one curve over the size of its slip vector."""
    speed, slope = 4.0, P.rear_b
    forces = forces_at((0.0, 0.0, 0.0, speed, vy, 0.0), throttle, 1.0, tyre__rear__C=1.0)
    rims = (P.drive_gain_n * throttle - forces.axle_force) / P.damping_nspm - speed  # motor and tyres in equilibrium
    along, across = slope * rims / speed, slope * vy / speed
    size = math.hypot(along, across)
    expected = GRIP_N * size / math.hypot(1.0, size)
    found = np.array([forces.axle_force, forces.side_rear])
    assert found == pytest.approx(expected * np.array([along, -across]) / size, rel=3e-3)  # tan(angle) ~ angle


def test_a_stiff_motor_without_throttle_locks_the_wheels():
    """The rims stand still, so the slip is the car's own speed."""
    forces = forces_at((0.0, 0.0, 0.0, 2.0, 0.0, 0.0), 0.0, 0.8, motor__damping=1e6)
    slope = P.rear_b * P.rear_c
    assert forces.axle_force == pytest.approx(-0.8 * GRIP_N * slope / math.hypot(1.0, slope), rel=1e-5)


def test_wheels_without_drive_keep_their_side_force():
    state = (0.0, 0.0, 0.0, 2.0, 0.3, -0.5)
    rolling = forces_at(state, 2.0 * P.damping_nspm / P.drive_gain_n, 0.5)
    shape = math.sin(P.rear_c * math.atan(P.rear_b * math.atan2(0.3 + 0.5 * P.rear_axle_m, 2.0)))
    assert rolling.axle_force == pytest.approx(0.0, abs=1e-9)
    assert rolling.side_rear == pytest.approx(-GRIP_N * shape, rel=1e-9)


def test_a_limited_motor_does_not_spin_the_wheels():
    """The ellipse of the force that remains: F_x = 0.6 P leaves 0.8 of the side force."""
    state, limit = (0.0, 0.0, 0.0, 2.0, 0.1, 0.0), 0.6 * 0.7 * GRIP_N
    controller = {"speed_controller": {"forward_force": limit, "backward_force": limit}}
    limited = forces_at(state, 1.0, 0.7, controller)
    alone = forces_at(state, 2.0 * P.damping_nspm / P.drive_gain_n, 0.7).side_rear
    assert limited.axle_force == pytest.approx(limit, rel=1e-9)
    assert limited.side_rear == pytest.approx(0.8 * alone, rel=1e-9)


def test_slip_of_spinning_wheels_solves_the_equilibrium(rng):
    peak = 10.0 ** rng.uniform(-1.0, 2.0, 50_000)
    motor_slope = peak * 10.0 ** rng.uniform(-3.0, 1.0, len(peak))
    demand = peak * 10.0 ** rng.uniform(-3.0, 2.0, len(peak))
    low, high = np.zeros(len(peak)), demand / motor_slope
    for _ in range(100):
        middle = 0.5 * (low + high)
        is_above = motor_slope * middle + peak * middle / np.hypot(1.0, middle) > demand
        low, high = np.where(is_above, low, middle), np.where(is_above, middle, high)
    start = np.maximum(demand / (motor_slope + peak), (demand - peak) / motor_slope)
    u = solve_slip(ARRAYS, demand, peak, motor_slope, start, steps=3)
    error = np.abs(u / np.hypot(1.0, u) - high / np.hypot(1.0, high))
    assert error.max() < 1e-5
    assert error[motor_slope > 0.02 * peak].max() < 1e-11
