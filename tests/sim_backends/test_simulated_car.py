"""Test that the simulated car implements the car interface."""

import math
from dataclasses import replace

import numpy as np
import pytest

from carlab.core.clock import MonotonicClock, Pacer
from carlab.core.errors import (
    ActionOutOfRangeError,
    ActuatorFaultError,
    ConfigError,
    NotArmedError,
    NotOpenError,
    PoseLostError,
)
from carlab.core.quantities import NEUTRAL, Action, ActionLimits, CarState, Reality
from sim_backends.car_parameters import MocapParameters, SimulatorConfig
from sim_backends.simulated_car import MAX_SPEED_MPS, MAX_YAW_RATE_RADPS, SimulatedCar, is_physical

QUIET = MocapParameters(position_std_m=0.0, yaw_std_rad=0.0)
PERIOD_S = 1 / 30


def drive(car, actions):
    rows = []
    for action in actions:
        car.command(action)
        car.clock.sleep_until(car.clock.now_s() + PERIOD_S)
        rows.append(car.observe())
    return rows


def test_observations_match_the_true_states():
    with SimulatedCar(SimulatorConfig(mocap=QUIET)) as car:
        assert car.reality is Reality.SIMULATED
        car.arm()
        observations = drive(car, [Action(0.3, 0.4)] * 60)
        last, true = observations[-1], car.true_state
        now_s = car.clock.now_s()
        assert last.t_receive_s <= now_s
        assert 0.0 <= now_s - last.t_capture_s - 0.008 < 1 / 120
        assert last.velocity_delay_s == pytest.approx(0.025, abs=1e-6)
        age_s = now_s - last.t_capture_s
        moved = math.hypot(last.state.x_m - true.x_m, last.state.y_m - true.y_m)
        assert moved == pytest.approx(age_s * true.speed_mps, rel=0.05)
        assert last.state.vx_mps == pytest.approx(true.vx_mps, abs=0.05)
        assert last.state.yaw_rate_radps == pytest.approx(true.yaw_rate_radps, abs=0.1)
        sequences = [p.sequence for o in observations for p in o.poses]
        assert sequences == list(range(sequences[0], sequences[-1] + 1))


@pytest.mark.parametrize("period_s", [1 / 30, 0.0333333333, 0.033333])
def test_the_age_of_the_pose_is_the_same_at_each_tick(period_s):
    config = SimulatorConfig(control_period_s=period_s)
    with SimulatedCar(config) as car:
        pacer = Pacer(car.clock, period_s)
        pacer.start()
        ages_s = []
        for _ in range(3000):
            pacer.wait()
            ages_s.append(car.clock.now_s() - car.observe().t_capture_s)
    assert ages_s == pytest.approx([config.mocap.latency_s] * 3000, abs=1e-9)


def test_equal_seeds_give_equal_bytes():
    def run(seed):
        with SimulatedCar(SimulatorConfig(mocap=MocapParameters(dropout=0.1)), seed=seed) as car:
            car.arm()
            observations = drive(car, [Action(math.sin(0.3 * k), 0.4) for k in range(50)])
            return np.array([o.state.to_array() for o in observations]).tobytes(), repr(observations)

    assert run(3) == run(3)
    assert run(3)[0] != run(4)[0]


def test_no_motion_before_arming_and_documented_errors():
    car = SimulatedCar(limits=ActionLimits(1.0, 0.5))
    car.stop(planned=True)
    car.close()
    for call in (car.observe, car.arm, lambda: car.command(NEUTRAL), lambda: car.place(CarState())):
        with pytest.raises(NotOpenError, match="open"):
            call()
    assert not car.health().ready
    with car:
        assert car.command(NEUTRAL) == NEUTRAL
        with pytest.raises(NotArmedError, match="arm"):
            car.command(Action(0.1, 0.0))
        car.arm()
        assert car.command(Action(0.1, 0.2)) == Action(0.1, 0.2)
        for wrong in (Action(0.0, 0.6), Action(1.1, 0.0), Action(math.nan, 0.0)):
            with pytest.raises(ActionOutOfRangeError):
                car.command(wrong)
        car.stop(planned=True)
        with pytest.raises(NotArmedError):
            car.command(Action(0.1, 0.2))
        car.arm()
        car.stop(planned=False)
        assert not car.health().ready
        for call in (car.arm, lambda: car.command(NEUTRAL)):
            with pytest.raises(ActuatorFaultError, match="reset_fault"):
                call()
        car.reset_fault()
        assert car.health().ready
        with pytest.raises(NotArmedError):
            car.command(Action(0.1, 0.2))
        car.arm()
    car.close()
    with pytest.raises(NotOpenError):
        car.observe()


def test_open_and_close_are_idempotent():
    car = SimulatedCar()
    car.open()
    opened_s = car.clock.now_s()
    car.open()
    assert car.clock.now_s() == opened_s
    car.close()
    car.close()
    car.open()
    assert car.observe().tracked
    car.close()


@pytest.mark.parametrize("damping_nspm", [800.0, 1560.0, 1e150])
def test_diverging_simulation_is_an_error_of_the_car_file(damping_nspm):
    """A Runge-Kutta step of 10 ms is unstable for a rate above 279 1/s: damping above 460 N s/m at 1.65 kg."""
    config = SimulatorConfig().with_values({"motor.damping": damping_nspm})
    with SimulatedCar(config) as car:
        car.arm()
        with pytest.raises(ConfigError, match=r"diverged.* Check mass, yaw_inertia, damping"):
            drive(car, [Action(0.3, 0.4)] * 60)


def test_state_at_the_limits_of_speed_and_yaw_rate_is_physical():
    fast = CarState(vx_mps=MAX_SPEED_MPS, yaw_rate_radps=-MAX_YAW_RATE_RADPS)
    assert is_physical(fast)
    assert not is_physical(replace(fast, vy_mps=10.0))
    assert not is_physical(replace(fast, yaw_rate_radps=-MAX_YAW_RATE_RADPS - 1.0))
    assert not is_physical(CarState(x_m=math.inf))
    assert not is_physical(CarState(yaw_rad=math.nan))


def test_watchdog_replaces_an_old_command_by_neutral():
    p = SimulatorConfig().parameters
    with SimulatedCar(watchdog_s=0.15) as car:
        car.arm()
        t0 = car.clock.now_s()
        car.command(Action(0.0, 0.5))
        car.clock.sleep_until(t0 + 1.0)
        rate, top = p.damping_nspm / p.mass_kg, 0.5 * p.drive_gain_n / p.damping_nspm
        peak = top * (1 - math.exp(-rate * 0.15))
        assert car.true_state.vx_mps == pytest.approx(peak * math.exp(-rate * (1.0 - 0.08 - 0.15)), rel=1e-6)


@pytest.mark.parametrize("planned", [True, False])
def test_stop_is_neutral_from_then_on(planned):
    p = SimulatorConfig().parameters
    with SimulatedCar() as car:
        car.arm()
        drive(car, [Action(0.0, 0.5)] * 10)
        before = car.true_state.vx_mps
        t0 = car.clock.now_s()
        car.stop(planned=planned)
        car.clock.sleep_until(t0 + 0.08)
        at_stop = car.true_state.vx_mps
        assert at_stop > before  # delayed commands still act
        car.clock.sleep_until(t0 + 0.58)
        assert car.true_state.vx_mps == pytest.approx(at_stop * math.exp(-0.5 * p.damping_nspm / p.mass_kg), rel=1e-6)


def test_place_sets_the_state_with_a_valid_velocity_estimate():
    target = CarState(1.42, -1.04, 3.1, 0.8, 0.1, 1.5)
    with SimulatedCar(SimulatorConfig(mocap=QUIET)) as car:
        car.arm()
        drive(car, [Action(0.5, 0.5)] * 20)
        before_s = car.clock.now_s()
        assert car.place(target) is True
        assert 0.05 < car.clock.now_s() - before_s < 0.2
        assert car.true_state.to_array() == pytest.approx(target.to_array(), abs=1e-12)
        seen = car.observe()
        age_s = car.clock.now_s() - seen.t_capture_s
        assert seen.state.vx_mps == pytest.approx(0.8, abs=0.01)
        assert seen.state.yaw_rate_radps == pytest.approx(1.5, abs=0.01)
        assert math.hypot(seen.state.x_m - 1.42, seen.state.y_m + 1.04) == pytest.approx(0.806 * age_s, rel=0.05)
        assert all(p.t_capture_s >= before_s for p in seen.poses)


def test_place_at_rest_leaves_no_pending_command():
    with SimulatedCar(SimulatorConfig(mocap=QUIET)) as car:
        car.arm()
        drive(car, [Action(0.5, 0.5)] * 5)
        car.place(CarState(1.0, 2.0, -1.0))
        car.clock.sleep_until(car.clock.now_s() + 1.0)
        assert car.observe().state.to_array() == pytest.approx([1.0, 2.0, -1.0, 0, 0, 0], abs=1e-9)


def test_loss_of_all_frames_is_reported():
    with (
        SimulatedCar(SimulatorConfig(mocap=MocapParameters(dropout=1.0))) as car,
        pytest.raises(PoseLostError, match="dropout"),
    ):
        car.observe()


def test_velocity_filter_lag_slows_the_velocity_columns_only():
    lag = {"velocity_filter_lag": {"time_constant": 0.2}}
    seen = []
    for effects in ({}, lag):
        with SimulatedCar(SimulatorConfig(mocap=QUIET, effects=effects)) as car:
            car.arm()
            seen.append(drive(car, [Action(0.0, 0.5)] * 15)[-1].state)
    assert seen[0].x_m == seen[1].x_m
    # In steady state a lag trails a ramp by time constant times slope; the speed is nearly a ramp.
    p = SimulatorConfig().parameters
    slope = (0.5 * p.drive_gain_n - p.damping_nspm * seen[0].vx_mps) / p.mass_kg
    assert 0.1 * slope < seen[0].vx_mps - seen[1].vx_mps < 0.3 * slope


def test_simulated_car_runs_on_the_monotonic_clock():
    with SimulatedCar(clock=MonotonicClock()) as car:
        car.arm()
        car.command(Action(0.0, 0.2))
        first = car.observe()
        car.clock.sleep_until(car.clock.now_s() + 0.05)
        assert car.observe().t_capture_s > first.t_capture_s
