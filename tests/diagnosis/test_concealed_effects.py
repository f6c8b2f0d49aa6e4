"""Test that a diagnosis names what an independent generator conceals: motor settings, play, and axle distances."""

from pathlib import Path

import numpy as np
import pytest

from carlab.benchmark.effects.forms import all_forms
from carlab.benchmark.world.base_car import BaseCar
from carlab.benchmark.world.measurement import Noise, record
from carlab.benchmark.world.physics import World
from carlab.benchmark.world.simulation import drive
from carlab.core.episode_data import EpisodeData
from carlab.diagnosis.diagnose import diagnose
from tests.helpers.case_files import car_in

pytestmark = pytest.mark.timeout(900)
CAR = BaseCar()
MOTOR_EFFECTS = (
    "motor_saturation",
    "traction_limit",
    "speed_controller",
    "drag_brake",
    "rolling_resistance",
    "throttle_deadband",
    "throttle_asymmetry",
    "brake_asymmetry",
)
STEERING_EFFECTS = (
    "steering_deadband",
    "steering_backlash",
    "steering_lag",
    "steering_nonlinearity",
    "tyre_relaxation",
    "front_wheel_play",
)
AXLE_EFFECTS = ("wheelbase", "centre_of_mass", "marker_offset", "yaw_damping")
CONCEALED = {
    "speed_controller": {"forward_force": 0.5 * CAR.drive_gain, "backward_force": 0.3 * CAR.drive_gain},
    "drag_brake": {"force": 0.3 * CAR.drive_gain},
    "throttle_asymmetry": {"gain_ratio": 0.6},
    "front_wheel_play": {"angle": 0.03},
    "wheelbase": {"change": 0.25},
    "centre_of_mass": {"ahead": 0.06},
}


def recorded(effect: str, seed: int, duration_s: float) -> EpisodeData:
    """A drive with steps of both commands: hard braking, reversing, and a released throttle in a third of them."""
    rng = np.random.default_rng(seed)
    ticks = round(duration_s / CAR.control_period)
    steps = rng.uniform((-0.6, -1.0), (0.6, 1.0), (ticks // 10 + 2, 2))
    steps[rng.random(len(steps)) < 1 / 3, 1] = 0.0
    table = np.repeat(steps, 10, axis=0)
    world = World(CAR)
    all_forms()[effect, "catalogue"].attach(world, CONCEALED[effect])
    driven = drive(world, lambda t, state: tuple(table[round(t / CAR.control_period)]), ticks * CAR.control_period)
    measured = record(driven, world, Noise(0.0006, 0.002), rng)
    sent = measured.commands[:-1]
    return EpisodeData(measured.t_s, measured.measured, sent, sent, np.zeros(len(sent)))


@pytest.mark.parametrize("effect", CONCEALED)
def test_concealed_effect_is_named_with_its_numbers(effect: str, tmp_path: Path) -> None:
    CAR.write(tmp_path / "car.toml")
    fit, held_out = recorded(effect, 1, 30.0), recorded(effect, 2, 12.0)
    candidates = MOTOR_EFFECTS + STEERING_EFFECTS + AXLE_EFFECTS
    found = diagnose([fit], [held_out], car_in(tmp_path), effects=candidates).diagnosis
    assert [e.id for e in found.effects] == [effect]
    for name, value in CONCEALED[effect].items():
        assert found.effects[0].parameters[name].value == pytest.approx(value, rel=0.1), name
    assert found.held_out["with_effects"].score < 0.5 * found.held_out["refit"].score
