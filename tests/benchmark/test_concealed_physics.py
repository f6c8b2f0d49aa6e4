"""Test the physics of the generator against the independent simulator and closed forms of mechanics."""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any

import numpy as np
import pytest
import torch

from carlab.benchmark.effects.catalogue import Draw, Form
from carlab.benchmark.effects.forms import all_forms
from carlab.benchmark.world.base_car import BaseCar, Kind
from carlab.benchmark.world.measurement import Noise, record
from carlab.benchmark.world.physics import World
from carlab.benchmark.world.simulation import Drive, drive
from sim_backends import EFFECTS, SimulatorConfig
from tests.helpers.measured_rollout import measured_rollout

# Noise of motion capture (0.6 mm, 2 mrad) and of velocities differentiated from it.
NOISE_FLOOR = np.array([6e-4, 6e-4, 2e-3, 0.01, 0.01, 0.03])
FORMS = all_forms()
CAR = BaseCar()
# Sizes whose influence is many noise floors within a second.
STRONG = {
    "battery_sag": 0.3,
    "friction_drift": 0.4,
    "longitudinal_slip": 2.0,
    "tyre_saturation": 0.8,
    "wheelbase": 0.1,
}


def commands(seed: int = 1, count: int = 31, period_s: float = CAR.control_period) -> np.ndarray:
    """Piecewise constant commands with braking."""
    rng = np.random.default_rng(seed)
    hold = max(1, round(0.1 / period_s))
    steps = rng.uniform((-1.0, -0.3), (1.0, 1.0), (count // hold + 1, 2))
    return np.repeat(steps, hold, axis=0)[:count]


def scripted(table: np.ndarray, period_s: float) -> Any:
    return lambda t, state: tuple(table[round(t / period_s)])


def generator_drive(world: World, table: np.ndarray, start: tuple[float, ...]) -> Drive:
    period = world.car.control_period
    return drive(world, scripted(table, period), (len(table) - 1) * period, start=start)


def simulator_rollout(
    car: BaseCar, effects: dict[str, dict[str, float]], table: np.ndarray, start: tuple[float, ...]
) -> Any:
    tables = car.table() | {"effects": effects}
    config = SimulatorConfig.from_tables(tables)
    begin = torch.tensor([start], dtype=torch.float64)
    acting_commands = torch.tensor(table[None, :-1], dtype=torch.float64)
    return measured_rollout(config, begin, acting_commands, max_step_s=0.002)


def draw_of(car: BaseCar) -> Draw:
    return Draw(car, 1.0, (0.1, 0.6, 0.3), (1.0, 0.1))


@pytest.mark.parametrize("kind", ["dynamic", "linear_tyre", "kinematic", "blend"])
@pytest.mark.parametrize("start", [(0.0, 0.0, 0.3, 1.8, 0.0, 0.0), (0.0,) * 6])
def test_base_model_equals_the_simulator(kind: Kind, start: tuple[float, ...]) -> None:
    car = dataclasses.replace(CAR, kind=kind, latency=0.0)
    for seed in range(3):
        table = commands(seed)
        generated = generator_drive(World(car), table, start).rows
        simulated = simulator_rollout(car, {}, table, start).states[0].numpy()
        assert np.abs(generated[-1] - generated[0]).max() > 0.3
        assert (np.abs(generated - simulated).max(axis=0) < 0.1 * NOISE_FLOOR).all()


def comparable() -> list[Form]:
    observed = ("mocap_latency", "marker_offset", "mocap_yaw_misalignment", "velocity_filter_lag")
    return [f for f in FORMS.values() if f.form == "catalogue" and f.id in EFFECTS and f.id not in observed]


@pytest.mark.parametrize("form", comparable(), ids=lambda f: f.id)
def test_catalogue_forms_equal_the_effects_of_the_simulator(form: Form) -> None:
    car = dataclasses.replace(CAR, kind=form.nominal_kind, latency=0.0)
    # The initial speed of a slipping wheel is arbitrary for a moving car; at standstill it is 0.
    start = (0.0, 0.0, 0.3, 0.0 if form.id == "longitudinal_slip" else 1.8, 0.0, 0.0)
    parameters = form.sized(STRONG.get(form.id, min(4.0 * form.typical, form.largest)), draw_of(car))
    table = commands(5)
    world = World(car)
    form.attach(world, parameters)
    generated = generator_drive(world, table, start).rows
    simulated = simulator_rollout(car, {form.id: parameters}, table, start).states[0].numpy()
    null = generator_drive(World(car), table, start).rows
    influence = np.abs(generated - null).max(axis=0) / NOISE_FLOOR
    difference = np.abs(generated - simulated).max(axis=0) / NOISE_FLOOR
    assert influence.max() > 2.0, "the effect must have an influence, or the comparison is meaningless"
    # Fixed steps do not resolve the edge of a patch; adaptive steps do.
    share = 0.05 if form.id == "low_friction_patch" else 0.02
    assert difference.max() < max(0.2, share * influence.max())


@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        ("mocap_latency", {"latency": 0.05}),
        ("marker_offset", {"ahead": 0.05, "left": -0.03}),
        ("mocap_yaw_misalignment", {"angle": 0.04}),
    ],
)
def test_observation_effects_equal_those_of_the_simulator(name: str, parameters: dict[str, float]) -> None:
    start = (0.2, 0.1, 0.3, 1.8, 0.0, 0.0)
    table = commands(7)
    world = World(CAR)
    FORMS[(name, "catalogue")].attach(world, parameters)
    quiet = Noise(0.0, 0.0)
    generated = record(generator_drive(world, table, start), world, quiet, np.random.default_rng(0)).measured
    simulated = simulator_rollout(CAR, {name: parameters}, table, start).measured[0].numpy()
    assert (np.abs(generated - simulated).max(axis=0)[:3] < 0.1 * NOISE_FLOOR[:3]).all()


def identities() -> list[Form]:
    return [form for form in FORMS.values() if form.smallest == 0.0]


def measured_from_rest(world: World) -> np.ndarray:
    driven = generator_drive(world, commands(3, 46), (0.0,) * 6)
    return record(driven, world, Noise(0.0, 0.0), np.random.default_rng(0)).measured


@functools.cache
def base_model_from_rest(kind: Kind) -> np.ndarray:
    return measured_from_rest(World(dataclasses.replace(CAR, kind=kind)))


@pytest.mark.parametrize("form", identities(), ids=lambda f: f"{f.id}-{f.form}")
def test_each_form_at_size_zero_equals_the_base_model(form: Form) -> None:
    world = World(dataclasses.replace(CAR, kind=form.nominal_kind))
    form.attach(world, form.sized(0.0, draw_of(world.car)))
    difference = np.abs(measured_from_rest(world) - base_model_from_rest(form.nominal_kind)).max(axis=0)
    assert (difference < 0.02 * NOISE_FLOOR).all()


def test_steering_signs_and_energy_dissipation() -> None:
    held = np.tile([0.5, 0.4], (60, 1))
    rows = generator_drive(World(CAR), held, (0.0,) * 6).rows
    assert rows[-1, 2] > 0.5  # positive steering turns left
    assert (np.diff(np.hypot(rows[:, 3], rows[:, 4])) > -0.05).all()
    back = generator_drive(World(CAR), held * [1.0, -1.0], (0.0,) * 6).rows
    assert back[-1, 2] < -0.3  # opposite in reverse
    rolling = generator_drive(World(CAR), np.zeros((60, 2)), (0.0, 0.0, 0.0, 2.0, 0.6, 3.0)).rows
    energy = 0.5 * CAR.mass * (rolling[:, 3] ** 2 + rolling[:, 4] ** 2) + 0.5 * CAR.yaw_inertia * rolling[:, 5] ** 2
    assert (np.diff(energy) <= 1e-9).all()


def test_straight_coasting_is_exponential() -> None:
    rows = generator_drive(World(CAR), np.zeros((61, 2)), (0.0, 0.0, 0.0, 2.0, 0.0, 0.0)).rows
    t = np.maximum(np.arange(61) * CAR.control_period - CAR.latency, 0.0)
    np.testing.assert_allclose(rows[1:, 3], 2.0 * np.exp(-CAR.damping / CAR.mass * t[1:]), rtol=1e-7)


def test_each_resistance_dissipates_energy() -> None:
    names = ("rolling_resistance", "aerodynamic_drag", "cornering_drag")
    for form in (f for f in FORMS.values() if f.id in names):
        world = World(CAR)
        form.attach(world, form.sized(form.largest / 4, draw_of(CAR)))
        table = np.tile([0.1, 0.0], (31, 1))
        slowed, free = (generator_drive(w, table, (0.0, 0.0, 0.0, 2.0, 0.0, 0.0)).rows[20] for w in (world, World(CAR)))
        energies = [CAR.mass * (r[3] ** 2 + r[4] ** 2) + CAR.yaw_inertia * r[5] ** 2 for r in (slowed, free)]
        assert energies[0] < energies[1]


def test_slope_accelerates_downhill_in_the_world_frame() -> None:
    world = World(CAR)
    FORMS[("road_slope", "catalogue")].attach(world, {"angle": 0.05, "direction": math.pi / 2})
    rows = generator_drive(world, np.zeros((31, 2)), (0.0, 0.0, math.pi / 2, 0.0, 0.0, 0.0)).rows
    assert rows[-1, 1] < -0.05  # the floor rises towards +y, so the car rolls back
    assert abs(rows[-1, 0]) < 1e-6


def test_packets_keep_their_order_and_mean_delay() -> None:
    world = World(CAR)
    FORMS[("command_delay", "other")].attach(world, {"extra_delay": 0.05, "seed": 3.0})
    ticks = np.arange(600) * CAR.control_period
    acts = np.array([world.arrival[1](world.arrival[0](t) * 0.0 + t) for t in ticks])
    assert (np.diff(acts) > 0.0).all()
    assert np.mean(acts - ticks) == pytest.approx(CAR.command_delay + 0.05, abs=0.004)
