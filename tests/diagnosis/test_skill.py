"""The comparison with constant velocity against closed forms, and the noise floor of a recording."""

import numpy as np
import pytest

from carlab.core.episode_data import EpisodeData
from carlab.diagnosis.diagnose import diagnose
from carlab.diagnosis.report.sentences import worse_than_constant_velocity
from carlab.diagnosis.settings import EVIDENCE
from carlab.diagnosis.skill import skill_of
from carlab.prediction.errors import final_errors
from carlab.prediction.predict import ConstantVelocity, NoChange
from carlab.prediction.windows import cut_windows, segments_of
from sim_backends import SimulatorConfig
from tests.helpers.recorded_drives import PERIOD_S, drive

RADIUS_M, YAW_RATE = 1.5, 0.8


def circle(seconds: float) -> EpisodeData:
    """Recording of a car on a circle; its commands change in the second half."""
    times_s = PERIOD_S * np.arange(int(seconds / PERIOD_S) + 1)
    yaw = YAW_RATE * times_s
    speed, zero = np.full_like(times_s, RADIUS_M * YAW_RATE), np.zeros_like(times_s)
    pose = (RADIUS_M * np.sin(yaw), RADIUS_M * (1.0 - np.cos(yaw)), yaw)
    states = np.column_stack([*pose, speed, zero, np.full_like(times_s, YAW_RATE)])
    commands = np.full((len(times_s) - 1, 2), 0.2)
    half = len(commands) // 2
    commands[half:, 0] += 0.3 * np.sin(20.0 * times_s[half:-1])
    return EpisodeData(times_s, states, commands, commands, np.zeros(len(commands)))


def test_a_standing_prediction_errs_by_the_chord_of_a_circle() -> None:
    windows = cut_windows(segments_of([circle(30.0), circle(30.0)]), 1.0, 0.25)
    standing, constant = (final_errors(model, windows) for model in (NoChange(), ConstantVelocity()))
    rows = skill_of(windows, standing, constant)
    chord_m = 2.0 * RADIUS_M * np.sin(0.5 * YAW_RATE * windows.horizon_s)
    assert {(r.recording, r.regime) for r in rows} >= {(1, "all"), (2, "steady commands"), (2, "changing commands")}
    for row in rows:
        assert row.model_m == pytest.approx(chord_m, rel=1e-3)
        assert row.constant_velocity_m == pytest.approx(0.0, abs=1e-3)
        assert row.travelled_m == pytest.approx(RADIUS_M * YAW_RATE * windows.horizon_s, rel=1e-3)
        assert row.standard_errors < -EVIDENCE.skill_z_min
    swapped = skill_of(windows, constant, standing)
    assert all(row.standard_errors > EVIDENCE.skill_z_min for row in swapped)
    few = np.arange(EVIDENCE.skill_windows_min - 1)
    assert skill_of(windows.take(few), standing[few], constant[few]) == ()


def test_the_floor_depends_on_recording_and_car_file_alone() -> None:
    """The same recording has one floor and one nominal score, whatever effects a diagnosis may accept."""
    car = SimulatorConfig(control_period_s=PERIOD_S)
    weak = car.with_values({"motor.drive_gain": 0.8 * car.values()["motor.drive_gain"]})
    episode = drive(weak, 40.0, 5)
    found = [diagnose([episode], [], car, effects=names) for names in ([], ["motor_lag", "steering_offset"])]
    first, second = (each.diagnosis.held_out for each in found)
    for name in ("noise_floor", "nominal", "refit", "constant_velocity"):
        assert first[name] == second[name]
    assert first["refit"].score < 0.7 * first["nominal"].score
    skill = found[0].diagnosis.skill
    assert skill[0].model_m < skill[0].constant_velocity_m
    assert worse_than_constant_velocity(found[0].diagnosis) == ""
