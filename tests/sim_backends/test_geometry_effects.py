"""Test axle distances that differ from the car file against mechanics: similarity, statics and the rest of the car."""

import dataclasses

import numpy as np
import pytest

from carlab.core.errors import ConfigError
from carlab.core.quantities import Action, CarState
from sim_backends.car_parameters import CarParameters, SimulatorConfig
from sim_backends.plant import Plant

CAR = CarParameters()
DRIVE = ((0.3, 0.5), (-0.6, 0.7), (0.1, 0.4), (0.8, 0.6), (-0.2, 0.5))
HOLD_S = 0.2


def driven(config: SimulatorConfig, start: tuple[float, ...]) -> np.ndarray:
    """States (6, 6) at the start and after each command."""
    plant = Plant(config)
    plant.reset(CarState(*start), 0.0)
    states = [np.array(start)]
    for k, action in enumerate(DRIVE):
        plant.command(k * HOLD_S, Action(*action))
        plant.advance((k + 1) * HOLD_S)
        states.append(plant.state.to_array())
    return np.array(states)


def test_longer_wheelbase_is_the_same_as_a_wrong_scale_of_motion_capture():
    """Dynamic similarity: lengths and forces times s, yaw inertia times s^2, the same slip angles and times."""
    scale = 1.1
    larger = dataclasses.replace(
        CAR,
        yaw_inertia_kgm2=scale**2 * CAR.yaw_inertia_kgm2,
        front_mu=scale * CAR.front_mu,
        rear_mu=scale * CAR.rear_mu,
        drive_gain_n=scale * CAR.drive_gain_n,
    )
    lengths = np.array([scale, scale, 1.0, scale, scale, 1.0])
    start = np.array([0.2, -0.1, 0.7, 1.8, 0.1, -0.4])  # fast enough for slip angles without a floor of the speed
    true = driven(SimulatorConfig(CAR, command_delay_s=0.0), tuple(start))
    config = SimulatorConfig(larger, command_delay_s=0.0, effects={"wheelbase": {"change": scale - 1.0}})
    assert true[:, 3].min() > 1.0
    assert driven(config, tuple(lengths * start)) == pytest.approx(lengths * true, abs=1e-9)


def test_effects_equal_a_car_file_with_these_distances():
    effects = {"wheelbase": {"change": -0.1}, "centre_of_mass": {"ahead": 0.02}}
    distances = (0.9 * CAR.front_axle_m - 0.02, 0.9 * CAR.rear_axle_m + 0.02)
    config = SimulatorConfig(CAR, command_delay_s=0.0, effects=effects)
    assert config.axle_distances_m() == pytest.approx(distances)
    other = dataclasses.replace(CAR, front_axle_m=distances[0], rear_axle_m=distances[1])
    start = (0.0, 0.0, 0.0, 1.5, 0.0, 0.0)
    expected = driven(SimulatorConfig(other, command_delay_s=0.0), start)
    assert driven(config, start) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("change", [-0.7, -0.5])
@pytest.mark.parametrize("ahead_m", [0.12, -0.15])
def test_centre_of_mass_stays_between_the_axles_of_a_shorter_car(ahead_m, change):
    effects = {"centre_of_mass": {"ahead": ahead_m}, "wheelbase": {"change": change}}
    front_m, rear_m = SimulatorConfig(CAR, effects=effects).axle_distances_m()
    assert front_m + rear_m == pytest.approx((1.0 + change) * CAR.wheelbase_m)
    assert min(front_m, rear_m) == pytest.approx(0.02 * (1.0 + change) * CAR.wheelbase_m)


@pytest.mark.parametrize("ahead_m", [0.4, -0.4])
def test_centre_of_mass_beyond_an_axle_is_refused(ahead_m):
    message = rf"effects.centre_of_mass.ahead is {ahead_m:g} m; in this car it must be between -0.\d+ and 0.\d+."
    with pytest.raises(ConfigError, match=message):
        SimulatorConfig(CAR, effects={"centre_of_mass": {"ahead": ahead_m}})


def test_wheelbase_cannot_vanish():
    with pytest.raises(ConfigError, match="wheelbase"):
        SimulatorConfig(CAR, effects={"wheelbase": {"change": -1.0}})
