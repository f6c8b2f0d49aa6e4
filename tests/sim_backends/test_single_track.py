"""Test the base model against scipy, closed forms, symmetries and signs."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from carlab.core.quantities import Action, CarState
from sim_backends.array_ops import ARRAYS, FLOATS
from sim_backends.car_parameters import CarParameters, SimulatorConfig
from sim_backends.dynamics.plain_loop import derivative as plain_derivative
from sim_backends.dynamics.single_track import SingleTrack
from sim_backends.effects import EFFECTS
from sim_backends.plant import Plant

KINDS = ("dynamic", "linear_tyre", "kinematic", "blend")
MODERATE = [(0.3, 0.2), (-0.6, 0.4), (0.1, -0.3), (0.8, 0.5), (-0.2, 0.0)]


def config(kind="dynamic", **values):
    plain = SimulatorConfig(kind=kind, command_delay_s=values.pop("delay", 0.0))
    return plain.with_values({name.replace("__", "."): v for name, v in values.items()})


def drive(cfg, start, actions, hold_s=0.2):
    plant = Plant(cfg)
    plant.reset(CarState(*start), 0.0)
    for i, action in enumerate(actions):
        plant.command(i * hold_s, Action(*action))
        plant.advance((i + 1) * hold_s)
    return plant.state.to_array()


def reference_derivative(cfg, state, steering, throttle):
    """Evaluate an independent implementation of the four model kinds from the literature."""
    p = cfg.parameters
    vx, vy, r = state[3:]
    d = p.max_angle_rad * steering
    length = p.front_axle_m + p.rear_axle_m
    force = p.drive_gain_n * throttle - p.damping_nspm * vx
    out = plain_derivative(np.array(state), steering, throttle, p)
    slow = out.copy()
    slow[3:] = (
        force / p.mass_kg,
        (vx * p.rear_axle_m * math.tan(d) / length - vy) / 0.05,
        (vx * math.tan(d) / length - r) / 0.05,
    )
    if cfg.kind == "kinematic":
        return slow
    if cfg.kind == "linear_tyre":
        vf = np.array([[math.cos(d), math.sin(d)], [-math.sin(d), math.cos(d)]]) @ [vx, vy + p.front_axle_m * r]
        slips = math.atan2(vf[1], max(abs(vf[0]), 0.3)), math.atan2(vy - p.rear_axle_m * r, max(abs(vx), 0.3))
        ff = -p.front_mu * p.front_b * p.front_c * slips[0] * p.mass_kg * 9.81 * p.rear_axle_m / length
        fr = -p.rear_mu * p.rear_b * p.rear_c * slips[1] * p.mass_kg * 9.81 * p.front_axle_m / length
        out[3:] = (
            (force - ff * math.sin(d)) / p.mass_kg + vy * r,
            (fr + ff * math.cos(d)) / p.mass_kg - vx * r,
            (p.front_axle_m * ff * math.cos(d) - p.rear_axle_m * fr) / p.yaw_inertia_kgm2,
        )
    if cfg.kind == "blend":
        weight = min(max((math.hypot(vx, vy) - 0.3) / 0.2, 0.0), 1.0)
        return weight * out + (1 - weight) * slow
    return out


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("start", [(0, 0, 0, 0, 0, 0), (1, -2, 2.5, 2.0, 0.3, -1.0), (0, 0, 0, -1.0, 0.1, 0.5)])
def test_agrees_with_scipy(kind, start):
    cfg = config(kind)
    state = np.array(start, dtype=float)
    for steering, throttle in MODERATE:
        state = solve_ivp(
            lambda _, s, a=steering, b=throttle: reference_derivative(cfg, s, a, b),
            (0, 0.2),
            state,
            rtol=1e-9,
            atol=1e-11,
            method="DOP853",
            max_step=0.01,
        ).y[:, -1]
    simulated = drive(cfg, start, MODERATE)
    # The error is that of RK4 with 10 ms for eigenvalues up to 76 1/s, and of the kinks of the blend.
    tolerance = 2e-3 if kind in ("blend", "linear_tyre") else 5e-4
    error = np.abs(simulated - state)
    error[2] = abs(math.remainder(error[2], 2 * math.pi))
    assert error.max() < tolerance


def test_integration_error_falls_with_the_fourth_power_of_the_step(monkeypatch):
    cfg = config()
    start = (0, 0, 0, 2.0, 0.2, 1.0)
    results = []
    for step_s in (0.01, 0.005, 0.0005):
        monkeypatch.setattr("sim_backends.plant.MAX_STEP_S", step_s)
        results.append(drive(cfg, start, MODERATE[:2]))
    coarse, fine = np.abs(results[0] - results[2]).max(), np.abs(results[1] - results[2]).max()
    assert 10 < coarse / fine < 30


def test_derivative_is_the_same_for_floats_and_arrays_and_equals_the_plain_one():
    rng = np.random.default_rng(3)
    for kind in KINDS:
        cfg = config(kind)
        states = rng.uniform(-2, 2, (6, 50))
        angle, throttle = rng.uniform(-0.6, 0.6, 50), rng.uniform(-1, 1, 50)
        model = SingleTrack(ARRAYS, kind, cfg.values())
        batch = np.array(model.derivative(0.0, tuple(states), model.actuation(angle, throttle)))
        single = SingleTrack(FLOATS, kind, cfg.values())
        for i in range(50):
            one = single.derivative(
                0.0, tuple(states[:, i].tolist()), single.actuation(float(angle[i]), float(throttle[i]))
            )
            assert np.allclose(one, batch[:, i], rtol=1e-12, atol=1e-12)
            assert np.allclose(
                one, reference_derivative(cfg, states[:, i], angle[i] / 0.6, throttle[i]), rtol=1e-9, atol=1e-9
            )


def test_straight_line_is_the_exponential_of_the_damping():
    p = CarParameters()
    for throttle in (0.0, 0.5, -0.3):
        state = drive(config(), (0, 0, 0, 2.0, 0, 0), [(0.0, throttle)] * 5)
        top, rate = p.drive_gain_n * throttle / p.damping_nspm, p.damping_nspm / p.mass_kg
        assert state[3] == pytest.approx(top + (2.0 - top) * math.exp(-rate), rel=1e-8)
        assert state[0] == pytest.approx(top + (2.0 - top) * (1 - math.exp(-rate)) / rate, rel=1e-8)
        assert np.abs(state[[1, 2, 4, 5]]).max() == 0.0


def test_kinematic_car_drives_the_circle_of_its_geometry():
    p = CarParameters()
    angle = 0.5 * p.max_angle_rad
    state = drive(config("kinematic"), (0, 0, 0, 1.0, 0, 0), [(0.5, p.damping_nspm / p.drive_gain_n)] * 20)
    assert state[3] == pytest.approx(1.0, rel=1e-6)
    assert state[5] == pytest.approx(math.tan(angle) / p.wheelbase_m, rel=1e-6)
    assert state[4] == pytest.approx(p.rear_axle_m * math.tan(angle) / p.wheelbase_m, rel=1e-6)


def test_slow_dynamic_car_turns_like_the_kinematic_one():
    p = CarParameters()
    speed = 0.15
    state = drive(config(), (0, 0, 0, speed, 0, 0), [(0.3, speed * p.damping_nspm / p.drive_gain_n)] * 30)
    assert state[5] / state[3] == pytest.approx(math.tan(0.18) / p.wheelbase_m, rel=0.05)


@pytest.mark.parametrize("kind", KINDS)
def test_positive_steering_turns_left_and_in_reverse_right(kind):
    forward = drive(config(kind), (0, 0, 0, 0, 0, 0), [(0.3, 0.15)] * 4)
    assert forward[2] > 0.05
    assert forward[1] > 0.0
    backward = drive(config(kind), (0, 0, 0, 0, 0, 0), [(0.3, -0.15)] * 4)
    assert backward[2] < -0.05
    assert backward[0] < 0.0


@pytest.mark.parametrize("kind", KINDS)
def test_mirror_symmetry(kind):
    actions = [(a, b) for a, b in MODERATE]
    state = drive(config(kind), (0, 0, 0, 1.5, 0.2, -0.5), actions)
    mirrored = drive(config(kind), (0, 0, 0, 1.5, -0.2, 0.5), [(-a, b) for a, b in actions])
    assert mirrored * [1, -1, -1, 1, -1, -1] == pytest.approx(state, abs=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_rigid_motion_of_the_world_changes_nothing(kind):
    here = drive(config(kind), (0, 0, 0.3, 1.5, 0.2, -0.5), MODERATE)
    there = drive(config(kind), (5, -7, 0.3 + 2.0, 1.5, 0.2, -0.5), MODERATE)
    c, s = math.cos(2.0), math.sin(2.0)
    assert there[0] == pytest.approx(5 + c * here[0] - s * here[1], abs=1e-10)
    assert there[1] == pytest.approx(-7 + s * here[0] + c * here[1], abs=1e-10)
    assert math.remainder(there[2] - here[2] - 2.0, 2 * math.pi) == pytest.approx(0.0, abs=1e-10)
    assert there[3:] == pytest.approx(here[3:], abs=1e-10)


@pytest.mark.parametrize("kind", ["dynamic", "linear_tyre"])
def test_no_power_is_added_without_throttle(kind):
    p = CarParameters()
    model = SingleTrack(ARRAYS, kind, config(kind).values())
    rng = np.random.default_rng(0)
    state = rng.uniform(-4, 4, (6, 4000))
    angle = rng.uniform(-0.6, 0.6, 4000)
    rates = model.derivative(0.0, tuple(state), model.actuation(angle, np.zeros(4000)))
    power = p.mass_kg * (state[3] * rates[3] + state[4] * rates[4]) + p.yaw_inertia_kgm2 * state[5] * rates[5]
    assert power.max() <= 1e-9


def test_kinematic_car_without_throttle_slows_down_in_a_curve_too():
    speeds = [drive(config("kinematic"), (0, 0, 0, 2.0, 0, 0), [(1.0, 0.0)] * n)[3] for n in (1, 2, 3)]
    assert 2.0 > speeds[0] > speeds[1] > speeds[2]


def test_side_force_never_exceeds_grip_and_cornering_is_bounded():
    state = drive(config(), (0, 0, 0, 4.0, 0, 0), [(1.0, 0.6)] * 15)
    assert abs(state[3] * state[5]) < 1.1 * 0.43 * 9.81


def test_blend_is_dynamic_when_fast_and_kinematic_when_slow():
    for speed, other in ((2.0, "dynamic"), (0.1, "kinematic")):
        state = (0.0, 0.0, 0.4, speed, 0.05, 0.3)
        rates = []
        for kind in ("blend", other):
            model = SingleTrack(FLOATS, kind, config(kind).values())
            rates.append(model.derivative(0.0, state, model.actuation(0.2, 0.1)))
        assert rates[0] == pytest.approx(rates[1], abs=1e-12)
    sideways = (0.0, 0.0, 0.0, 0.0, 2.0, 0.0)
    model = SingleTrack(FLOATS, "blend", config("blend").values())
    pacejka = SingleTrack(FLOATS, "dynamic", config().values())
    actuation = model.actuation(0.0, 0.0)
    assert model.derivative(0.0, sideways, actuation) == pytest.approx(pacejka.derivative(0.0, sideways, actuation))


def test_rolling_resistance_coasts_down_in_a_straight_line():
    force, mass = 0.8, 1.65
    cfg = config(motor__damping=0.0, effects__rolling_resistance__force=force)
    state = drive(cfg, (0, 0, 0, 2.0, 0, 0), [(0.0, 0.0)] * 5)
    assert state[3] == pytest.approx(2.0 - force / mass * 1.0, abs=1e-6)  # tanh(vx / 0.05) is 1 above 0.5 m/s
    stopped = drive(cfg, (0, 0, 0, 0.5, 0, 0), [(0.0, 0.0)] * 20)
    assert abs(stopped[3]) < 1e-3


def test_aerodynamic_drag_has_its_closed_form():
    coefficient, mass = 0.4, 1.65
    cfg = config(motor__damping=0.0, effects__aerodynamic_drag__coefficient=coefficient)
    for speed in (3.0, -3.0):
        state = drive(cfg, (0, 0, 0, speed, 0, 0), [(0.0, 0.0)] * 5)
        assert state[3] == pytest.approx(speed / (1 + coefficient / mass * 3.0 * 1.0), rel=1e-8)


def test_each_effect_declares_what_the_catalogue_needs():
    for effect_id, effect in EFFECTS.items():
        assert effect.id == effect_id
        assert effect.kind in ("input", "dynamics", "observation")
        assert effect.summary.endswith(".")
        texts = (effect.name, effect.sentence, effect.refuted_if)
        assert all(texts) if effect.catalogued else effect.class_statement
        assert effect.parameters
        for p in effect.parameters:
            assert p.low <= p.typical <= p.high
            assert p.identity is None or p.low <= p.identity <= p.high
            assert p.typical != p.identity or p.choices
            assert (p.identity is None) == bool(p.same_as)
