"""Test single dynamics effects by closed forms, balances and conserved quantities."""

import math

import numpy as np
import pytest

from carlab.core.quantities import Action, CarState
from sim_backends.array_ops import ARRAYS, FLOATS
from sim_backends.car_parameters import CarParameters, SimulatorConfig
from sim_backends.dynamics.single_track import SingleTrack
from sim_backends.effects.wheel_slip import _root
from sim_backends.plant import Plant

P = CarParameters()
G = 9.81
# With almost no grip the car goes straight on, while forces relative to the grip are unchanged.
STRAIGHT_ON = {"tyre__front__mu": 1e-7, "tyre__rear__mu": 1e-7, "motor__damping": 0.0}


def config(effects, **values):
    plain = SimulatorConfig(command_delay_s=0.0, effects=effects)
    return plain.with_values({name.replace("__", "."): v for name, v in values.items()})


def drive(cfg, start, action=(0.0, 0.0), duration_s=1.0):
    plant = Plant(cfg)
    plant.reset(CarState(*start), 0.0)
    plant.command(0.0, Action(*action))
    plant.advance(duration_s)
    return plant


def forces_at(effects, state, steering=0.0, throttle=0.0, t_s=0.0):
    """Return all forces of a model in steady state of its hidden states."""
    cfg = config(effects)
    model = SingleTrack(FLOATS, "dynamic", cfg.values(), cfg.effects)
    actuation = model.actuation(P.max_angle_rad * steering, throttle)
    full = (*state, *model.settled(t_s, state, actuation))
    return model.evaluate(t_s, full, actuation)


def test_cornering_drag_slows_a_coasting_car_evenly():
    """Without side forces the car goes straight on, and the drag of the steered wheels is the only force."""
    cfg = config({"cornering_drag": {"coefficient": 3.0}}, motor__damping=0.0, tyre__front__mu=0.0, tyre__rear__mu=0.0)
    state = drive(cfg, (0, 0, 0, 2.0, 0, 0), (0.5, 0.0)).state
    assert state.vx_mps == pytest.approx(2.0 - 3.0 * 0.3 / P.mass_kg, abs=1e-6)
    assert drive(cfg, (0, 0, 0, 2.0, 0, 0), (-0.5, 0.0)).state.vx_mps == pytest.approx(state.vx_mps, abs=1e-12)


def test_battery_sag_gives_the_speed_of_a_falling_force():
    """m dv/dt = gain u (1 - rate t) without damping: a parabola in time."""
    rate = 0.2
    state = drive(config({"battery_sag": {"rate": rate}}, motor__damping=0.0), (0,) * 6, (0.0, 0.5), 2.0).state
    assert state.vx_mps == pytest.approx(0.5 * P.drive_gain_n / P.mass_kg * (2.0 - rate * 2.0), rel=1e-9)


def test_motor_saturation_and_traction_limit_bound_the_acceleration():
    for effects, force in (
        ({"motor_saturation": {"force": 2.5}}, 2.5),
        ({"traction_limit": {"share": 0.8}}, 0.8 * P.rear_mu * P.mass_kg * G * 0.13 / 0.3),
        (
            {"traction_limit": {"share": 0.8, "axle": "all"}},
            0.8 * P.mass_kg * G * (P.rear_mu * 0.13 + P.front_mu * 0.17) / 0.3,
        ),
    ):
        for sign in (1.0, -1.0):
            state = drive(config(effects, motor__damping=0.0), (0,) * 6, (0.0, sign)).state
            assert state.vx_mps == pytest.approx(sign * force / P.mass_kg, rel=1e-9)


def test_speed_controller_drives_and_brakes_with_limited_force_and_holds_its_speed():
    """Far from its speed v_u = u gain / damping the force is constant; near v_u the error of the speed decays."""
    numbers = {"motor__damping": 6.0, "motor__drive_gain": 18.0}
    cfg = config({"speed_controller": {"forward_force": 3.0, "backward_force": 5.0}}, **numbers)
    for start, throttle, force in ((0.0, 1.0, 3.0), (4.0, 0.0, -5.0), (0.0, -1.0, -5.0), (-4.0, 0.0, 3.0)):
        state = drive(cfg, (0, 0, 0, start, 0, 0), (0.0, throttle), 0.2).state
        assert state.vx_mps == pytest.approx(start + 0.2 * force / P.mass_kg, rel=1e-9)
    near = drive(cfg, (0, 0, 0, 1.2, 0, 0), (0.0, 0.5), 0.4).state
    assert near.vx_mps == pytest.approx(1.5 - 0.3 * math.exp(-6.0 / P.mass_kg * 0.4), rel=1e-6)


CONTROLLER = {"speed_controller": {"forward_force": P.drive_gain_n, "backward_force": 2.0, "roundness": 1.0}}


@pytest.mark.parametrize(
    ("effects", "throttle", "limit"),
    [
        (CONTROLLER, 1.0, P.drive_gain_n),
        (CONTROLLER, -1.0, 2.0),
        ({"motor_saturation": {"force": P.drive_gain_n, "roundness": 1.0}}, -1.0, P.drive_gain_n),
        ({"traction_limit": {"share": 0.8, "roundness": 1.0}}, 1.0, 0.8 * P.rear_mu * P.mass_kg * G * 0.13 / 0.3),
    ],
)
def test_round_limit_of_the_force_is_harmonic_at_roundness_one(effects, throttle, limit):
    """``1 / m = 1 / a + 1 / b``: at full throttle half of the force if the limit is the motor's gain."""
    state = drive(config(effects, motor__damping=0.0), (0,) * 6, (0.0, throttle)).state
    force = 1.0 / (1.0 / P.drive_gain_n + 1.0 / limit)
    assert state.vx_mps == pytest.approx(throttle * force / P.mass_kg, rel=1e-9)


def test_drag_brake_stops_a_coasting_car_in_both_directions_and_ends_with_the_first_throttle():
    """m dv/dt = -F tanh(v / v0), thus sinh(v / v0) = sinh(v_start / v0) exp(-F t / (m v0))."""
    force, scale, duration_s = 2.0, 0.05, 0.3
    cfg = config({"drag_brake": {"force": force}}, motor__damping=0.0)
    for sign in (1.0, -1.0):
        state = drive(cfg, (0, 0, 0, 0.5 * sign, 0, 0), duration_s=duration_s).state
        left = math.sinh(0.5 / scale) * math.exp(-force * duration_s / P.mass_kg / scale)
        assert state.vx_mps == pytest.approx(sign * scale * math.asinh(left), abs=1e-4)
    for throttle in (0.05, -0.05):
        plain = drive(config({}, motor__damping=0.0), (0, 0, 0, 2.0, 0, 0), (0.0, throttle)).state
        assert drive(cfg, (0, 0, 0, 2.0, 0, 0), (0.0, throttle)).state.vx_mps == pytest.approx(plain.vx_mps, rel=1e-9)
    half = drive(cfg, (0, 0, 0, 2.0, 0, 0), (0.0, 0.025)).state
    assert half.vx_mps == pytest.approx(2.0 + (0.025 * P.drive_gain_n - 0.5 * force) / P.mass_kg, rel=1e-6)


def test_brake_gain_applies_while_braking_only():
    cfg = config({"brake_asymmetry": {"gain_ratio": 2.0}}, motor__damping=0.0)
    assert drive(cfg, (0, 0, 0, 3.0, 0, 0), (0.0, -0.2), 0.5).state.vx_mps == pytest.approx(
        3.0 - 2.0 * 0.2 * P.drive_gain_n / P.mass_kg * 0.5
    )
    assert drive(cfg, (0, 0, 0, 3.0, 0, 0), (0.0, 0.2), 0.5).state.vx_mps == pytest.approx(
        3.0 + 0.2 * P.drive_gain_n / P.mass_kg * 0.5
    )
    assert drive(cfg, (0, 0, 0, -3.0, 0, 0), (0.0, 0.2), 0.5).state.vx_mps == pytest.approx(
        -3.0 + 2.0 * 0.2 * P.drive_gain_n / P.mass_kg * 0.5
    )


def test_slope_conserves_energy_without_drive_and_resistance():
    """Sliding on ice in all directions: kinetic energy plus m g height is constant."""
    slope, heading = 0.1, 0.8
    ice = {"motor__damping": 0.0, "tyre__front__mu": 0.0, "tyre__rear__mu": 0.0}
    start = (0, 0, 0.3, 1.5, -0.4, 2.0)
    state = drive(config({"road_slope": {"angle": slope, "direction": heading}}, **ice), start, duration_s=2.0).state
    climbed = (state.x_m * math.cos(heading) + state.y_m * math.sin(heading)) * math.sin(slope)
    before, after = (0.5 * (vx**2 + vy**2) for vx, vy in ((1.5, -0.4), (state.vx_mps, state.vy_mps)))
    assert after + G * climbed == pytest.approx(before, abs=1e-6)
    assert abs(after - before) > 0.1


def test_car_facing_up_the_slope_rolls_back():
    state = drive(config({"road_slope": {"angle": 0.1, "direction": 0.7}}), (0, 0, 0.7, 0, 0, 0)).state
    assert state.vx_mps < -0.3
    assert abs(state.vy_mps) < 1e-9


def test_crossing_a_patch_loses_grip_between_its_rims_only():
    disc = {"x": 2.0, "y": 0.0, "radius": 0.5, "loss": 0.6}
    for x, factor in ((1.0, 1.0), (1.47, 1.0), (1.5, 0.7), (1.53, 0.4), (2.2, 0.4), (2.6, 1.0)):
        _, forces = forces_at({"low_friction_patch": disc}, (x, 0.0, 0.0, 2.0, 0.5, 0.0))
        _, plain = forces_at({"rolling_resistance": {}}, (x, 0.0, 0.0, 2.0, 0.5, 0.0))
        assert forces.side_rear / plain.side_rear == pytest.approx(factor, abs=1e-12)
        assert forces.grip_front == pytest.approx(P.front_mu * factor)
    inside, outside = (drive(config({"low_friction_patch": disc}), (1.2, y, 0, 2.0, 0.3, 0)).state for y in (0.0, 5.0))
    assert abs(inside.yaw_rad - outside.yaw_rad) > 5e-3


def test_friction_drift_scales_the_largest_side_force_with_time():
    sliding = (0.0, 0.0, 0.0, 0.0, 3.0, 0.0)
    for t_s in (0.0, 10.0, 50.0):
        _, forces = forces_at({"friction_drift": {"rate": -0.01}}, sliding, t_s=t_s)
        _, plain = forces_at({"rolling_resistance": {}}, sliding)
        assert forces.side_front == pytest.approx(plain.side_front * (1 - 0.01 * t_s))


def test_load_transfer_balances_the_moments_about_the_axles():
    """Moments about the lateral axis: m ax h = (F_z,rear - static) L, with the model's ax."""
    height, state = 0.08, (0.0, 0.0, 0.0, 2.0, 0.1, 0.5)
    for throttle, steering in ((1.0, 0.0), (-1.0, 0.0), (0.7, 0.8), (0.0, -0.9)):
        rates, forces = forces_at({"load_transfer": {"height": height}}, state, steering, throttle)
        ax = rates[3] - state[4] * state[5]
        transferred_load = P.mass_kg * ax * height / P.wheelbase_m
        assert forces.load_rear == pytest.approx(P.mass_kg * G * 0.13 / 0.3 + transferred_load, rel=1e-12)
        assert forces.load_front == pytest.approx(P.mass_kg * G * 0.17 / 0.3 - transferred_load, rel=1e-12)
        assert (transferred_load > 0) == (ax > 0)


def test_downforce_adds_grip_with_the_square_of_speed():
    _, forces = forces_at({"aerodynamic_downforce": {"coefficient": 0.5}}, (0, 0, 0, 3.0, 0, 0))
    assert forces.load_front + forces.load_rear == pytest.approx(P.mass_kg * G + 0.5 * 9.0)
    assert forces.load_front / forces.load_rear == pytest.approx(0.17 / 0.13)


def test_relaxation_is_first_order_in_distance_at_each_speed():
    """A held slip angle: the force has built up to 1 - 1/e after one relaxation length, whatever the speed."""
    length = 0.3
    cfg = config({"tyre_relaxation": {"length": length}}, **STRAIGHT_ON)
    for speed in (0.5, 2.0, 5.0):
        plant = Plant(cfg)
        plant.reset(CarState(0, 0, 0, speed, 0, 0), 0.0)
        plant.command(0.0, Action(0.2, 0.0))
        plant.advance(length / speed)
        front = plant._state[6 + index_of(plant, "tyre_relaxation.front")]
        slip = -0.12
        steady = -1e-7 * (P.mass_kg * G * 0.17 / 0.3) * math.sin(P.front_c * math.atan(P.front_b * slip))
        assert front / steady == pytest.approx(1 - math.exp(-1), rel=2e-3)


def index_of(plant, name):
    return plant._model.extra_states.index(name)


def test_roll_swings_at_its_damped_frequency():
    frequency, damping = 2.0, 0.1
    cfg = config({"roll_dynamics": {"frequency": frequency, "damping": damping, "sensitivity": 0.0}}, **STRAIGHT_ON)
    plant = Plant(cfg)
    plant.reset(CarState(0, 0, 0, 3.0, 0, 0), 0.0)
    plant.command(0.0, Action(0.2, 0.0))
    t, shift = np.arange(1, 1500) * 0.001, []
    for t_s in t:
        plant.advance(float(t_s))
        shift.append(plant._state[6 + index_of(plant, "roll_dynamics.shift")])
    w = 2 * math.pi * frequency
    damped = w * math.sqrt(1 - damping**2)
    slip = math.sin(P.front_c * math.atan(P.front_b * 0.12)) * math.cos(0.12)
    steady = slip * 0.17 / 0.3 / (0.17 / 0.3 + 0.13 / 0.3)  # front's share of the grip, the rear has no slip
    swing = 1 - np.exp(-damping * w * t) * (np.cos(damped * t) + damping * w / damped * np.sin(damped * t))
    assert np.allclose(shift, steady * swing, atol=1e-4)
    peak = t[int(np.argmax(shift))]
    assert peak == pytest.approx(math.pi / damped, abs=2e-3)  # half a period of the damped frequency


@pytest.mark.parametrize("sensitivity", [0.3, 4.0])
def test_roll_settles_where_loss_and_side_force_agree(sensitivity):
    """The side force F0 (1 - s rho^2) holds the roll rho = F / grip: a quadratic."""
    cfg = config({"roll_dynamics": {"frequency": 4.0, "damping": 1.0, "sensitivity": sensitivity}}, **STRAIGHT_ON)
    plant = Plant(cfg)
    plant.reset(CarState(0, 0, 0, 3.0, 0, 0), 0.0)
    plant.command(0.0, Action(0.2, 0.0))
    plant.advance(2.0)
    alone = math.sin(P.front_c * math.atan(P.front_b * 0.12)) * math.cos(0.12) * 0.17 / 0.3
    (steady,) = [r for r in np.roots([sensitivity * alone, 1.0, -alone]) if r > 0]
    assert plant._state[6 + index_of(plant, "roll_dynamics.shift")] == pytest.approx(steady, rel=1e-4)


def test_wheel_slip_balances_the_drive_at_steady_slip():
    """At constant speed the tyre force equals the drive force, which determines the slip of the tanh curve."""
    stiffness, speed = 30.0, 2.0
    throttle = 0.5
    cfg = config({"longitudinal_slip": {"inertia": 3e-4, "stiffness": stiffness}})
    plant = drive(cfg, (0,) * 6, (0.0, throttle), 8.0)
    state = plant.state
    top = P.drive_gain_n * throttle / P.damping_nspm  # without net force there is no slip
    assert state.vx_mps == pytest.approx(top, rel=2e-3)
    # A constant drag requires a force, and so slip.
    held = config(
        {
            "longitudinal_slip": {"inertia": 3e-4, "stiffness": stiffness},
            "rolling_resistance": {"force": P.drive_gain_n * throttle - P.damping_nspm * speed},
        }
    )
    plant = drive(held, (0, 0, 0, speed, 0, 0), (0.0, throttle), 10.0)
    force = P.drive_gain_n * throttle - P.damping_nspm * speed
    limit = P.rear_mu * P.mass_kg * G * 0.13 / 0.3
    assert plant.state.vx_mps == pytest.approx(speed, abs=1e-3)
    slip = plant._state[6] / speed
    assert limit * math.tanh(stiffness * slip / limit) == pytest.approx(force, rel=1e-3)


@pytest.mark.parametrize("inertia", [1e-9, 1e-7, 1e-5, 1e-3, 0.1])
@pytest.mark.parametrize("stiffness", [1.0, 40.0, 5000.0, math.inf])
def test_wheel_slip_is_stable_and_keeps_momentum(inertia, stiffness):
    """From standstill with full throttle, brake and coast: never more force than grip, no chatter at rest."""
    cfg = config({"longitudinal_slip": {"inertia": inertia, "stiffness": stiffness}})
    plant = Plant(cfg)
    limit = P.rear_mu * G * 0.13 / 0.3
    speeds = [0.0]
    for k in range(300):
        plant.command(k * 0.01, Action(0.0, 1.0 if k < 100 else -1.0 if k < 150 else 0.0))
        plant.advance((k + 1) * 0.01)
        speeds.append(plant.state.vx_mps)
    steps = np.diff(speeds)
    assert np.isfinite(speeds).all()
    assert np.abs(steps).max() <= limit * 0.01 * 1.0001
    coasting = np.array(speeds[200:])
    assert (np.abs(np.diff(coasting)) < 0.05).all()
    assert abs(coasting[-1]) <= abs(coasting[0]) + 1e-9


def test_force_of_slipping_wheels_solves_the_implicit_step(rng):
    """Against bisection: ``z + q tanh z = c`` of ``wheel_slip._root``, of which the force is ``tanh z``."""
    q = 10.0 ** rng.uniform(-4.0, 7.0, 100_000)
    c = (1.0 + q) * rng.uniform(-1.5, 1.5, len(q))
    low, high = np.zeros(len(q)), np.abs(c)
    for _ in range(100):
        middle = 0.5 * (low + high)
        is_above = middle + q * np.tanh(middle) > np.abs(c)
        low, high = np.where(is_above, low, middle), np.where(is_above, middle, high)
    error = np.abs(np.tanh(_root(ARRAYS, q, c)) - np.copysign(np.tanh(high), c))
    assert error.max() < 4e-4
    assert error[q < 100.0].max() < 2e-8
    assert error[np.abs(np.abs(c) / (1.0 + q) - 1.0) > 0.1].max() < 1e-14


def test_effects_of_body_forces_have_the_documented_signs():
    still = (0.0, 0.0, 0.0, 2.0, 0.0, 0.0)
    plain, _ = forces_at({"rolling_resistance": {}}, still, throttle=0.5)
    for effects, index, change in (
        ({"lateral_bias": {"force": 0.5}}, 4, 0.5 / P.mass_kg),
        ({"torque_steer": {"coefficient": 0.1}}, 5, 0.1 * 0.5 / P.yaw_inertia_kgm2),
    ):
        rates, _ = forces_at(effects, still, throttle=0.5)
        assert rates[index] - plain[index] == pytest.approx(change)
    turning = (*still[:5], 1.5)
    plain, _ = forces_at({"rolling_resistance": {}}, turning)
    rates, _ = forces_at({"yaw_damping": {"coefficient": 0.05}}, turning)
    assert rates[5] - plain[5] == pytest.approx(-0.05 * 1.5 / P.yaw_inertia_kgm2)
