"""Bounds of fitted parameters: a simulator accepts the values that a fit may reach, and a fit reaches its minimum."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import least_squares, lsq_linear

from carlab.diagnosis.evidence import ScoredSearch, estimate
from carlab.diagnosis.identification.bounded_step import bounded_step, coordinate_bounds, inward_steps
from carlab.diagnosis.identification.error_scale import Scale, huber
from carlab.diagnosis.identification.fit import Fit, Fitter
from carlab.diagnosis.identification.fit_parameters import (
    FitParameter,
    base_parameters,
    effect_parameters,
    with_effect,
)
from carlab.diagnosis.settings import IDENTIFICATION
from carlab.prediction.windows import cut_windows, segments_of
from sim_backends import SimulatorConfig
from sim_backends.effects import EFFECTS
from tests.helpers.recorded_drives import drive

PROBLEM = SimpleNamespace(windows=SimpleNamespace(block=np.arange(20)))
EVERY_CASE = [(kind, effect) for kind in ("dynamic", "linear_tyre", "kinematic") for effect in sorted(EFFECTS)]


@pytest.mark.parametrize(("kind", "effect"), [case for case in EVERY_CASE if case[0] in EFFECTS[case[1]].base_models])
@pytest.mark.parametrize("z", [-1e3, 1e3])
def test_simulator_accepts_the_bounds_of_every_effect(kind, effect, z):
    car = SimulatorConfig(kind=kind)
    free = effect_parameters(effect, car)
    values = {f.name: float(f.value(np.array(z))) for f in free}
    reached = with_effect(car, effect).with_values(values).values()
    assert {name: reached[name] for name in values} == values


@pytest.mark.parametrize("z", [-1e3, 1e3])
def test_centre_of_mass_of_a_fit_stays_between_axles_that_are_fitted_too(z):
    car = SimulatorConfig(priors={"vehicle.front_axle": (0.1, 0.2), "vehicle.rear_axle": (0.12, 0.2)})
    (free,) = effect_parameters("centre_of_mass", car)
    value = float(free.value(np.array(z)))
    assert value == (-0.12 if z < 0.0 else 0.1)
    lowest = {"vehicle.front_axle": 0.1, "vehicle.rear_axle": 0.12, free.name: value}
    assert car.with_values(lowest).values()[free.name] == value


@pytest.mark.parametrize("z", [-1e3, 1e3])
def test_range_of_the_car_file_bounds_the_parameter_of_an_effect(z):
    """The car file f1tenth states a range of the force; a fit beyond it ended the diagnosis with an error."""
    car = SimulatorConfig.from_preset("f1tenth")
    free = effect_parameters("speed_controller", car)
    values = {f.name: float(f.value(np.array(z))) for f in free}
    assert car.with_values(values).values()["effects.speed_controller.forward_force"] == (10.0 if z < 0.0 else 80.0)


@pytest.mark.parametrize(("z", "at_limit"), [(0.5, False), (-1e3, True), (1e3, True)])
def test_estimate_states_that_a_fit_ended_at_a_bound(z, at_limit):
    free = effect_parameters("steering_rate_limit", SimulatorConfig())
    fit = Fit(SimulatorConfig(), free, np.array([z]), 0.0, np.zeros(1), np.array([[0.01]]))
    scored = ScoredSearch(PROBLEM, None, None, fit, {})
    found = estimate(scored, "effects.steering_rate_limit.rate")
    assert found.at_limit is at_limit
    assert found.value == pytest.approx(np.clip(free[0].origin * np.exp(free[0].size * z), free[0].low, free[0].high))


@pytest.mark.parametrize(
    ("effect", "stated", "z"),
    [
        ("steering_lag", {}, 2.0),
        ("steering_lag", {"time_constant": 0.06}, 0.5),
        ("steering_rate_limit", {}, 0.7),  # infinite identity
    ],
)
def test_interval_of_an_effect_contains_the_error_of_the_model(effect, stated, z):
    """A tenth of the distance from the identity, or from the car file; of the whole value if the identity is inf."""
    car = SimulatorConfig(effects={effect: stated} if stated else {})
    free = effect_parameters(effect, car)
    fit = Fit(car, free, np.array([z]), 0.0, np.zeros(1), np.array([[1e-12]]))
    typical = EFFECTS[effect].parameters[0].typical
    if effect == "steering_rate_limit":
        value = distance = typical * np.exp(0.3 * z)
    else:
        distance = typical * z
        value = stated.get("time_constant", 0.0) + distance
    for excess in (0.0, 0.6, 1.0):
        found = estimate(ScoredSearch(PROBLEM, None, None, fit, {}, False, excess), free[0].name)
        assert found.value == pytest.approx(value)
        assert found.std == pytest.approx(np.hypot(0.01 * value, 0.1 * distance * excess), rel=1e-3)


def test_interval_of_a_base_parameter_has_no_error_of_the_model():
    free = base_parameters(SimulatorConfig())
    fit = Fit(SimulatorConfig(), free, np.full(len(free), 0.5), 0.0, np.zeros(1), 1e-12 * np.eye(len(free)))
    without, with_excess = (
        estimate(ScoredSearch(PROBLEM, None, None, fit, {}, False, excess), free[0].name) for excess in (0.0, 1.0)
    )
    assert with_excess.std == pytest.approx(without.std, rel=1e-3)


def random_problem(rng, count):
    """A positive definite matrix, a gradient, and bounds around 0, some of them at 0."""
    root = rng.normal(size=(2 * count, count))
    low, high = -rng.uniform(0.0, 0.5, count), rng.uniform(0.0, 0.5, count)
    low[rng.uniform(size=count) < 0.3] = 0.0
    return root.T @ root / count, rng.normal(size=count), low, high


@pytest.mark.parametrize("count", [1, 6, 25])
def test_bounded_step_is_the_minimum_of_scipy(count):
    rng = np.random.default_rng(0)
    at_bounds = 0
    for _ in range(100):
        matrix, gradient, low, high = random_problem(rng, count)
        step = bounded_step(matrix, gradient, low, high)
        root = np.linalg.cholesky(matrix).T
        exact = lsq_linear(root, -np.linalg.solve(root.T, gradient), (low - 1e-12, high + 1e-12), method="bvls").x
        assert np.all((step >= low) & (step <= high))
        assert step == pytest.approx(exact, abs=1e-8)
        at_bounds += np.sum((step == low) | (step == high))
    assert at_bounds > 10 * count


def test_bounded_step_without_a_bound_in_its_way_solves_the_linear_equations():
    matrix, gradient, low, _ = random_problem(np.random.default_rng(1), 6)
    step = bounded_step(matrix, gradient, np.full_like(low, -1e3), np.full_like(low, 1e3))
    assert step == pytest.approx(-np.linalg.solve(matrix, gradient), rel=1e-12)


def test_differences_of_a_parameter_are_into_its_range():
    free = (
        FitParameter("a", 1.0, 1.0, 0.0, 2.0),
        FitParameter("b", 1.0, 1.0, 0.0, 2.0),
        FitParameter("c", 1.0, 1.0, 0.99, 1.02),
    )
    steps = np.array([0.1, 0.1, 0.1])
    assert inward_steps(free, np.array([0.0, 1.0, 0.02]), steps) == pytest.approx([0.1, -0.1, -0.03])
    assert inward_steps(free, np.array([0.95, -1.0, -0.01]), steps) == pytest.approx([-0.1, 0.1, 0.03])


def test_fit_with_parameters_at_their_bounds_reaches_the_minimum_of_scipy():
    """The true motor is stronger than the car file allows, and its true tyre curve is flatter.

    The priors of both pull back into the range, against the data.
    """
    car = SimulatorConfig(priors={"motor.drive_gain": (7.0, 9.0), "tyre.rear.C": (1.3, 2.0)})
    true = replace(car, priors={}).with_values({"motor.drive_gain": 12.0, "tyre.rear.C": 1.0, "motor.damping": 2.2})
    windows = cut_windows(segments_of([drive(true, 20.0, 1)]), 0.8, 0.4)
    free = tuple(f for f in base_parameters(car) if not f.name.startswith("tyre.front"))
    fitter = Fitter(windows, Scale(np.array([8, 16, 24]), np.tile([0.01, 0.01, 0.02, 0.05, 0.05, 0.1], (3, 1))))
    low, high = coordinate_bounds(free)
    precision = np.linalg.cholesky(fitter.precision(free)).T

    def residuals(z):
        """Huber's loss is half the square of these (both losses are equal within and beyond the threshold)."""
        return np.concatenate([fitter.white(car, free, z[None])[0].ravel(), precision @ z])

    def loss(z):
        return float(huber(fitter.white(car, free, z[None])).sum() + fitter.prior(free, z[None])[0])

    def jacobian(z):
        ends = [np.clip(z + sign * 0.01 * np.eye(len(z)), low, high) for sign in (1.0, -1.0)]
        changes = [residuals(a) - residuals(b) for a, b in zip(*ends, strict=True)]
        return np.stack(changes, axis=1) / np.diag(ends[0] - ends[1])

    by_scipy = least_squares(
        residuals, 0.0 * low, jacobian, (low, high), loss="huber", f_scale=IDENTIFICATION.huber_delta
    )
    at_bound = {"motor.drive_gain", "tyre.rear.C"}
    for start in (np.zeros(len(free)), np.full(len(free), 3.0), np.full(len(free), -3.0)):
        fit = fitter.fit(car, free, start)
        assert fit.cost == pytest.approx(loss(fit.z), rel=1e-4)
        assert fit.cost < loss(by_scipy.x) * 1.003
        reached = {f.name for f, z, a, b in zip(free, fit.z, low, high, strict=True) if z in (a, b)}
        assert at_bound <= reached
        covariance = fitter.with_covariance(fit).covariance
        for k, f in enumerate(free):
            assert covariance[k, k] > 0.0
            if f.name in at_bound:
                assert not np.delete(covariance[k], k).any()


def test_value_of_a_far_coordinate_is_its_bound():
    """A long step of a fit must not overflow."""
    limit = FitParameter("effects.combined_slip.grip_ratio", 1.0, 0.3, 0.06, 150.0, logarithmic=True)
    with np.errstate(all="raise"):
        assert limit.value(np.array([1e5, 1e-3])) == pytest.approx([150.0, math.exp(3e-4)])
