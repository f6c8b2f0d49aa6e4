"""Test the integration of the generator against another method with a tight tolerance."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import ode

from carlab.benchmark.effects.catalogue import Draw
from carlab.benchmark.effects.forms import all_forms
from carlab.benchmark.world.base_car import BaseCar
from carlab.benchmark.world.driver import HumanDriver, Track
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


def accurate_states(world: World, driven: Drive) -> np.ndarray:
    """States at the captures after time 0 under the commands of a drive, by a method of order 8."""
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
    expected = accurate_states(world_with(name), driven)
    captured = driven.captures[driven.capture_s > 0.0]
    assert np.ptp(captured, axis=0).min() > 0.4
    errors = np.abs(captured - expected).max(axis=0)
    assert errors[:3].max() < 1e-6
    assert errors[3:].max() < 1e-5
