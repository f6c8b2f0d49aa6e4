"""Test random physics: closed forms of fields and maps, strength, and that it is unlike the catalogue."""

from __future__ import annotations

import math

import numpy as np
import pytest

from carlab.benchmark.cases.case import make_case
from carlab.benchmark.cases.proof_set import full_set
from carlab.benchmark.cases.resemblance import CatalogueInfluence
from carlab.benchmark.cases.scene import MAX_RESEMBLANCE
from carlab.benchmark.effects.catalogue import Draw
from carlab.benchmark.effects.forms import all_forms
from carlab.benchmark.effects.random_physics import (
    FEATURES,
    PLACE_SCALE_M,
    REST_MPS,
    SPEED_SCALE_MPS,
    MonotoneMap,
    RandomField,
)
from carlab.benchmark.world.base_car import BaseCar
from carlab.benchmark.world.driver import HumanDriver, Track
from carlab.benchmark.world.physics import World
from carlab.benchmark.world.simulation import Drive, drive, rates_along

FORMS = all_forms()
CAR = BaseCar()
KINDS = [name for name, form in FORMS if form == "random"]


def test_fields_have_the_covariance_of_their_kernel() -> None:
    """Over seeds: mean 0, and exp(-|z - z'|^2 / 2) between two points."""
    points = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 2.0]])
    values = np.array([RandomField(seed, 2)(points) for seed in range(3000)])
    distance_sq = ((points[:, None] - points[None]) ** 2).sum(axis=2)
    np.testing.assert_allclose(values.mean(axis=0), 0.0, atol=0.06)
    np.testing.assert_allclose(np.cov(values.T), np.exp(-0.5 * distance_sq), atol=0.08)


def test_field_equals_its_sum_of_cosines_and_its_seed_fixes_it() -> None:
    field, z = RandomField(8, 1), 0.7
    cosines = (
        a * math.cos(float(w[0]) * z + b)
        for a, w, b in zip(field.amplitudes, field.frequencies, field.phases, strict=True)
    )
    assert float(field(np.array([z]))) == pytest.approx(sum(cosines))
    assert len(field.phases) == FEATURES
    assert float(RandomField(8, 1)(np.array([z]))) == float(field(np.array([z])))
    assert float(RandomField(9, 1)(np.array([z]))) != float(field(np.array([z])))


def test_maps_increase_and_keep_rest_and_full_command() -> None:
    commands = np.linspace(-1.0, 1.0, 201)
    for seed in range(10):
        distort = MonotoneMap(seed, 1.0)
        values = np.array([distort(u) for u in commands])
        assert (np.diff(values) > 0.0).all()
        assert values[[0, 100, 200]] == pytest.approx([-1.0, 0.0, 1.0], abs=1e-12)
    identity = MonotoneMap(3, 0.0)
    assert [identity(u) for u in commands] == pytest.approx(commands)


@pytest.mark.parametrize("output", range(3))
def test_force_over_speed_accelerates_as_its_closed_form(output: int) -> None:
    size, seed, states = 0.8, 5, np.zeros((6, 6))
    states[:, 3] = np.linspace(0.0, 3.0, 6)
    still = np.zeros((6, 2))
    times = np.arange(6) * 0.01
    driven = Drive(times, still, times, states, 1)
    world = World(CAR)
    FORMS[("random_force_over_speed", "random")].attach(world, {"size": size, "seed": seed, "output": output})
    field = RandomField(seed, 1)(states[:, 3:4] / SPEED_SCALE_MPS)
    force = size * field * np.tanh(np.abs(states[:, 3]) / REST_MPS)
    gain = (1.0 / CAR.mass, 1.0 / CAR.mass, 0.5 * CAR.wheelbase / CAR.yaw_inertia)[output]
    expected = np.zeros((6, 3))
    expected[:, output] = gain * force
    added = rates_along(world, driven) - rates_along(World(CAR), driven)
    np.testing.assert_allclose(added, expected, atol=1e-12)


def test_pose_error_moves_the_measured_place_by_two_fields() -> None:
    world = World(CAR)
    FORMS[("random_pose_error", "random")].attach(world, {"size": 0.05, "seed": 4})
    pose = np.random.default_rng(1).normal(size=(10, 3))
    moved = world.pose_changes[0](np.arange(10.0), pose)
    np.testing.assert_allclose(moved[:, 0] - pose[:, 0], 0.05 * RandomField(4, 2)(pose[:, :2] / PLACE_SCALE_M))
    assert not np.allclose(moved[:, 1] - pose[:, 1], moved[:, 0] - pose[:, 0])
    np.testing.assert_array_equal(moved[:, 2], pose[:, 2])


@pytest.fixture(scope="module")
def catalogue() -> CatalogueInfluence:
    track = Track(np.random.default_rng(2))
    driver = HumanDriver(CAR, track, np.random.default_rng(3))
    driven = drive(World(CAR), driver, 8.0, start=driver.start())
    return CatalogueInfluence(CAR, driven, track.points, np.array([0.01, 0.01, 0.03]))


def draw(seed: int) -> Draw:
    return Draw.from_rng(np.random.default_rng(seed), CAR, np.array([[1.0, 0.0], [0.0, 1.0]]))


@pytest.mark.parametrize("name", ["steering_lag", "friction_drift", "marker_offset", "mocap_latency", "yaw_damping"])
def test_another_size_of_an_effect_resembles_it(name: str, catalogue: CatalogueInfluence) -> None:
    form = FORMS[(name, "catalogue")]
    closest = catalogue.closest(catalogue.of(form, form.sized(2.5 * form.typical, draw(4))))
    assert closest.effect == name
    assert closest.share > 0.98


def test_another_form_of_an_effect_resembles_the_catalogue_more_than_random_physics_may(
    catalogue: CatalogueInfluence,
) -> None:
    for name in ("steering_lag", "steering_delay", "steering_backlash", "throttle_nonlinearity"):
        form = FORMS[(name, "other")]
        assert catalogue.closest(catalogue.of(form, form.sized(2.0 * form.typical, draw(5)))).share > 0.8
    assert MAX_RESEMBLANCE < 0.8


def test_a_base_parameter_leaves_no_influence(catalogue: CatalogueInfluence) -> None:
    """A side force in proportion to that of the front tyre is a change of its friction coefficient."""
    form = FORMS[("lateral_bias", "catalogue")]
    influence = catalogue.of(form, {"force": 0.1})
    assert np.abs(catalogue._base.T @ influence).max() < 1e-9 * np.linalg.norm(influence)


@pytest.mark.slow
def test_random_physics_has_the_asked_strength_and_is_unlike_the_catalogue() -> None:
    case = make_case("outside", 905, effects=["random_throttle_map"], excess=2.0, fit_s=8.0, hold_s=5.0)
    assert case.excess == pytest.approx(2.0, rel=0.15)
    resemblance = case.answer()["effects"][0]["resemblance"]
    assert 0.0 < resemblance["share"] <= MAX_RESEMBLANCE


def test_full_set_has_each_kind_of_random_physics_at_every_strength() -> None:
    random = [spec for spec in full_set("test") if spec.effects and spec.effects[0] in KINDS]
    assert len(random) == 40
    assert {spec.effects[0] for spec in random} == set(KINDS)
    assert sorted({spec.excess for spec in random}) == [0.5, 1.0, 2.0, 4.0]
