"""Test the integration of the generator against closed forms and against SciPy with a tight tolerance."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from scipy.integrate import ode

from carlab.benchmark.effects.catalogue import Draw
from carlab.benchmark.effects.forms import all_forms
from carlab.benchmark.world.base_car import BaseCar
from carlab.benchmark.world.driver import HumanDriver, Track
from carlab.benchmark.world.integration import LONGEST_STEP_S, DormandPrince
from carlab.benchmark.world.physics import World
from carlab.benchmark.world.simulation import Drive, drive

CAR = BaseCar()
TRACK = Track(np.random.default_rng(2))
FORMS = all_forms()


def world_with(name: str) -> World:
    world, form = World(CAR), FORMS[(name, "catalogue")]
    x, y = TRACK.points[100].tolist()
    form.attach(world, form.sized(2.0 * form.typical, Draw(CAR, 1.0, (0.1, 0.6, 0.3), (x, y))))
    return world


def states_by_scipy(world: World, driven: Drive) -> np.ndarray:
    """States at the captures after time 0 under the commands of a drive."""
    rates = world.derivative()
    solver = ode(lambda t, y: rates(t, y.tolist())).set_integrator("dop853", rtol=1e-10, atol=1e-12, nsteps=10000)
    state, t, found = [*driven.captures[0], *world.hidden(float(driven.captures[0, 3]))], 0.0, []
    acts_s = driven.row_s + CAR.command_delay
    captures_s = driven.capture_s[driven.capture_s > 0.0]
    for end in np.union1d(acts_s[acts_s <= captures_s[-1]], captures_s):
        state, t = solver.set_initial_value(state, t).integrate(end), end
        assert solver.successful()
        if end in captures_s:
            found.append(state[:6])
        if end in acts_s:
            steering, throttle = driven.commands[np.searchsorted(acts_s, end)]
            rates.angle, rates.throttle = CAR.max_angle * float(steering), float(throttle)
    return np.array(found)


@pytest.mark.parametrize(
    ("name", "duration_s"), [("low_friction_patch", 60.0), ("tyre_relaxation", 20.0), ("longitudinal_slip", 20.0)]
)
def test_a_minute_has_an_error_far_below_the_noise_of_measurement(name: str, duration_s: float) -> None:
    """Bounds: 1 um and 1 urad; the noise is 600 um and 2000 urad."""
    human = HumanDriver(CAR, TRACK, np.random.default_rng(3))
    driven = drive(world_with(name), human, duration_s, start=human.start())
    expected = states_by_scipy(world_with(name), driven)
    captured = driven.captures[driven.capture_s > 0.0]
    assert np.ptp(captured, axis=0).min() > 0.4
    errors = np.abs(captured - expected).max(axis=0)
    assert errors[:3].max() < 1e-6
    assert errors[3:].max() < 1e-5


def oscillation(t: float) -> list[float]:
    return [math.cos(20.0 * t), -20.0 * math.sin(20.0 * t)]


def test_an_oscillation_equals_its_closed_form_also_within_a_step() -> None:
    solution = DormandPrince(lambda t, y: [y[1], -400.0 * y[0]], oscillation(0.0), 1e-9)
    while solution.t < 2.0:
        begin_s = solution.t
        solution.extend(2.0)
        assert solution.t - begin_s <= LONGEST_STEP_S
        for share in (0.0, 0.3, 0.7, 1.0):
            t = begin_s + share * (solution.t - begin_s)
            np.testing.assert_allclose(solution.at(t), oscillation(t), atol=2e-6)
    assert solution.t == 2.0
    np.testing.assert_allclose(solution.state, oscillation(2.0), atol=1e-6)


def solved(rates: Callable[[float, list[float]], list[float]]) -> float:
    """y(1) for y(0) = 0."""
    solution = DormandPrince(rates, [0.0], 1e-8)
    while solution.t < 1.0:
        solution.extend(1.0)
    return solution.state[0]


def test_a_force_that_starts_within_a_step_acts_from_its_start() -> None:
    assert solved(lambda t, y: [1.0 if t > 0.5123 else 0.0]) == pytest.approx(1.0 - 0.5123, abs=1e-7)


def test_an_infinite_right_hand_side_is_an_error() -> None:
    with pytest.raises(ArithmeticError, match="error"):
        solved(lambda t, y: [math.inf if t > 0.1 else 0.0])
