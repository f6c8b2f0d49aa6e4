"""The integration step of predictions: rates against eigenvalues by hand, slow windows against scipy."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from carlab.prediction.predict import simulate_windows
from carlab.prediction.step_length import MAX_STEP_S, MIN_STEP_S, fastest_rate, step_for
from carlab.prediction.windows import cut_windows, segments_of
from sim_backends import SimulatorConfig
from sim_backends.array_ops import FLOATS
from sim_backends.dynamics.single_track import SingleTrack
from sim_backends.effects.base import GRAVITY_MPS2
from tests.helpers.recorded_drives import drive

STIFF = SimulatorConfig.from_preset("dart_jetracer_linear").with_values(
    {"vehicle.yaw_inertia": 0.008, "timing.command_delay": 0.0}
)


@pytest.fixture(scope="module")
def windows():
    return cut_windows(segments_of([drive(SimulatorConfig(), 30.0, 3)]), 1.0, 0.5)


def of_cars(config, cars=1):
    return {name: np.full((cars, 1), value) for name, value in config.values().items()}


def linear_rates(config, speed_mps):
    """Eigenvalues of the linear single-track model [1/s] (Milliken and Milliken, "Race Car Vehicle Dynamics")."""
    v = config.values()
    front, rear, mass = v["vehicle.front_axle"], v["vehicle.rear_axle"], v["vehicle.mass"]
    inertia, wheelbase = v["vehicle.yaw_inertia"], front + rear
    load = {"front": mass * GRAVITY_MPS2 * rear / wheelbase, "rear": mass * GRAVITY_MPS2 * front / wheelbase}
    stiff = {a: load[a] * v[f"tyre.{a}.mu"] * v[f"tyre.{a}.B"] * v[f"tyre.{a}.C"] for a in load}
    moment = front * stiff["front"] - rear * stiff["rear"]
    side = [-(stiff["front"] + stiff["rear"]) / mass / speed_mps, -moment / mass / speed_mps - speed_mps]
    yaw = [-moment, -(front**2 * stiff["front"] + rear**2 * stiff["rear"])]
    return np.linalg.eigvals(np.array([side, np.array(yaw) / inertia / speed_mps]))


def test_rate_is_the_eigenvalue_of_the_linear_single_track_model():
    rates = {n: v[:, 0] for n, v in of_cars(STIFF).items()}
    exact = np.abs(linear_rates(STIFF, 0.3)).max()
    assert exact > 2.785 / MAX_STEP_S  # the usual step is unstable
    assert fastest_rate("linear_tyre", rates, ()) == pytest.approx(exact, rel=0.1)
    # Measured curves and Pacejka tyres are softer at larger slip, so the fastest rate is that near zero slip.
    assert fastest_rate("dynamic", rates, ()) == pytest.approx(exact, rel=0.1)
    assert fastest_rate("kinematic", rates, ()) == pytest.approx(20.0, rel=0.01)


def test_step_follows_the_fastest_car_where_a_window_is_slow(windows):
    slow = np.abs(windows.measured[:, :, 3]).min(axis=1) < 0.6
    assert 0 < slow.sum() < len(slow)
    assert step_for(windows.take(~slow), STIFF.kind, of_cars(STIFF), ()) == MAX_STEP_S
    needed = step_for(windows, STIFF.kind, of_cars(STIFF), ())
    assert MIN_STEP_S < needed < MAX_STEP_S
    both = of_cars(STIFF, 2)
    both["vehicle.yaw_inertia"][1] *= 4.0
    assert step_for(windows, STIFF.kind, both, ()) == pytest.approx(needed)
    assert step_for(windows, "blend", of_cars(STIFF), ()) == pytest.approx(needed, rel=0.1)
    assert step_for(windows, STIFF.kind, {**of_cars(STIFF), "tyre.rear.B": np.array([[np.nan]])}, ()) == MAX_STEP_S


def test_slow_stiff_car_is_predicted_as_by_scipy(windows):
    slowest = windows.take(np.array([int(np.abs(windows.measured[:, :, 3]).max(axis=1).argmin())]))
    model = SingleTrack(FLOATS, STIFF.kind, STIFF.values())
    state = slowest.initial_states[0]
    exact = [state]
    for steering, throttle in slowest.commands[0]:
        held = model.actuation(STIFF.values()["steering.max_angle"] * steering, throttle)
        flow = solve_ivp(
            lambda t, s, held=held: model.derivative(t, tuple(s), held), (0.0, slowest.period_s), state, method="Radau",
            rtol=1e-9, atol=1e-10,
        )  # fmt: skip
        state = flow.y[:, -1]
        exact.append(state)
    own = simulate_windows(slowest, STIFF, in_double=True)[0, 0]
    coarse = simulate_windows(slowest, STIFF, max_step_s=MAX_STEP_S, in_double=True)[0, 0]
    errors = [np.sqrt(np.mean((states - np.array(exact))[:, 5] ** 2)) for states in (own, coarse)]
    assert errors[0] < 0.002  # rad/s; right after a step of the command it is 0.01
    assert errors[1] > 0.02
    np.testing.assert_allclose(own[:, :5], np.array(exact)[:, :5], atol=1e-3)
