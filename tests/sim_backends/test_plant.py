"""Test the single-car plant in continuous time."""

import subprocess
import sys

import numpy as np
import pytest

from carlab.core.quantities import Action, CarState
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.plant import Plant


def test_command_acts_exactly_after_its_delay():
    p = SimulatorConfig().parameters
    for delay_s in (0.0, 0.0733, 0.08):
        plant = Plant(SimulatorConfig(command_delay_s=delay_s))
        plant.reset(CarState(), 10.0)
        plant.command(10.05, Action(0.0, 0.5))
        plant.advance(10.05 + delay_s)
        assert plant.state == CarState()
        plant.advance(10.05 + delay_s + 0.3)
        rate = p.damping_nspm / p.mass_kg
        assert plant.state.vx_mps == pytest.approx(
            0.5 * p.drive_gain_n / p.damping_nspm * (1 - np.exp(-rate * 0.3)), rel=1e-9
        )


def test_longer_delay_shifts_the_plant_response_by_the_difference():
    states = []
    for delay_s in (0.05, 0.0573):
        plant = Plant(SimulatorConfig(command_delay_s=delay_s))
        plant.command(0.0, Action(0.5, 0.5))
        plant.command(0.1, Action(-0.5, 0.2))
        plant.advance(0.4 + delay_s)
        states.append(plant.state.to_array())
    assert states[1] == pytest.approx(states[0], abs=1e-12)


def test_result_does_not_depend_on_the_number_of_calls():
    ends = []
    for stops in ([1.0], np.linspace(0.001, 1.0, 1000), [0.013, 0.5, 0.501, 1.0]):
        plant = Plant(SimulatorConfig(effects={"steering_lag": {"time_constant": 0.05}}))
        plant.command(0.0, Action(0.6, 0.4))
        plant.command(0.3, Action(-0.6, 0.4))
        for t_s in stops:
            plant.advance(float(t_s))
        ends.append(plant.state.to_array())
    assert ends[1] == pytest.approx(ends[0], abs=2e-4)
    assert ends[2] == pytest.approx(ends[0], abs=2e-4)


def test_time_never_goes_back():
    plant = Plant(SimulatorConfig())
    plant.command(0.0, Action(0.0, 0.5))
    latest = plant.advance(0.5)
    assert plant.advance(0.2) == latest
    assert plant.t_s == 0.5


def test_poses_of_the_last_second_are_interpolated():
    truth, plant = Plant(SimulatorConfig()), Plant(SimulatorConfig())
    for one in (truth, plant):
        one.command(0.0, Action(0.8, 0.6))
        one.command(0.2, Action(-0.8, 0.6))
    plant.advance(0.7)
    for t_s in np.arange(0.0, 0.7, 0.0037):
        state = truth.advance(float(t_s))
        pose = plant.measured_pose(float(t_s))
        assert (pose.x_m, pose.y_m, pose.yaw_rad) == pytest.approx((state.x_m, state.y_m, state.yaw_rad), abs=2e-5)
    assert plant.t_s == 0.7
    plant.advance(5.0)
    assert plant.measured_pose(0.0) == plant.measured_pose(3.9)


def test_measured_pose_is_that_of_the_marker():
    plant = Plant(SimulatorConfig(effects={"marker_offset": {"ahead": 0.1, "left": 0.02}}))
    plant.reset(CarState(1.0, 2.0, np.pi / 2), 0.0)
    pose = plant.measured_pose(0.0)
    assert (pose.x_m, pose.y_m, pose.yaw_rad) == pytest.approx((0.98, 2.1, np.pi / 2))


def test_reset_discards_pending_commands():
    plant = Plant(SimulatorConfig())
    plant.command(0.0, Action(0.5, 1.0))
    plant.advance(0.05)
    plant.reset(CarState(), 0.05)
    assert plant.advance(1.0) == CarState()


def test_single_car_needs_no_torch():
    code = (
        "import sys; from sim_backends import SimulatedCar, Plant, MocapSensor, SimulatorConfig; "
        "car = SimulatedCar(); car.open(); car.observe(); car.close(); print('torch' in sys.modules)"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "False"
