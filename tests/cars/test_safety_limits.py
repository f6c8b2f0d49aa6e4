"""Safety limits of a car file that are infinite, not a number or in another unit are refused: they disable a guard."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest

import carlab
from carlab.cars import choose_car, load_car_file
from carlab.core.episode_data import EpisodeData
from carlab.core.errors import ConfigError, NotReadyError

ARENA = "[hardware.arena]\ncorners_m = [[-1, -1], [1, -1], [1, 1], [-1, 1]]\n"


def car_file(folder: Path, table: str, *lines: str) -> Path:
    path = folder / "car.toml"
    path.write_text("\n".join([f"[{table}]", *lines, ARENA]), encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("table", "lines", "message"),
    [
        ("hardware.limits", ["stale_pose_s = 2.1", "lost_pose_s = 2.1"], "stale_pose_s .* at most 2 s .is it in"),
        ("hardware.limits", ["lost_pose_s = 500"], "lost_pose_s .* is 500 s; it must be at most 2 s"),
        ("hardware.limits", ["frozen_pose_s = 400"], "frozen_pose_s .* at most 2 s"),
        ("hardware.limits", ["reaction_s = 150"], "reaction_s .* at most 2 s"),
        ("hardware.limits", ["reaction_s = -0.1"], "reaction_s .* below zero"),
        ("hardware.limits", ["deceleration_mps2 = inf"], "deceleration_mps2 .* is inf; give a finite number"),
        ("hardware.limits", ["deceleration_mps2 = 3000"], "deceleration_mps2 .* at most 20 m/s2"),
        ("hardware.limits", ["max_speed_mps = inf"], "max_speed_mps .* finite"),
        ("hardware.limits", ["max_speed_mps = 5000"], "max_speed_mps .* at most 30 m/s"),
        ("hardware.limits", ["max_yaw_rate_radps = 1146"], "max_yaw_rate_radps .* at most 100 rad/s"),
        ("hardware.limits", ["jump_margin_m = 100"], "jump_margin_m .* at most 2 m"),
        ("hardware.limits", ["jump_margin_rad = 28.6"], "jump_margin_rad .* at most 3.14159 rad"),
        ("hardware.limits", ["throttle_rate_per_s = inf"], "throttle_rate_per_s .* finite"),
        ("hardware.actuator", ["watchdog_s = 150"], "watchdog_s 150 must .* is one in another unit"),
        ("hardware.actuator", ["watchdog_s = 150", "latch_s = 500"], "watchdog_s .* is 150 s; it must be at most 2 s"),
        ("hardware.actuator", ["latch_s = 500"], "latch_s .* at most 2 s .is it in another unit"),
        ("hardware.actuator", ["latch_s = inf"], "latch_s .* is inf"),
        ("hardware.actuator", ["telemetry_stale_s = 250"], "telemetry_stale_s 250 must .* is one in another unit"),
        ("hardware.actuator", ["telemetry_stale_s = 250", "telemetry_lost_s = 1000"], "telemetry_stale_s .* most 2 s"),
        ("hardware.actuator", ["telemetry_lost_s = inf"], "telemetry_lost_s .* is inf"),
        ("hardware.actuator", ["open_timeout_s = inf"], "open_timeout_s"),
        ("hardware.actuator", ['port = " "'], "'port' in .hardware.actuator. is empty; name the link"),
        ("hardware.actuator", ['kind = "vesc_can"', 'channel = ""'], "'channel' in .hardware.actuator. is empty"),
        ("hardware.actuator", ["baud = 9600"], "baud .* is 9600; .* least 23000. Set a higher baud, also in the VESC"),
        ("hardware.actuator", ["baud = 43000", "rate_hz = 10", "telemetry_rate_hz = 200"], "at least 44000"),
        ("hardware", ["arm_max_erpm = nan"], "arm_max_erpm .* nan; give a finite number"),
        ("hardware", ["arm_max_erpm = inf"], "arm_max_erpm .* finite"),
        ("hardware", ["arm_max_erpm = -1"], "arm_max_erpm .* below zero"),
        ("hardware", ["arm_max_pose_age_s = inf"], "arm_max_pose_age_s .* finite"),
        ("hardware", ["arm_max_pose_age_s = nan"], "arm_max_pose_age_s .* nan; give a finite number"),
        ("hardware", ["arm_max_pose_age_s = 100"], "arm_max_pose_age_s .* at most 2 s"),
        ("hardware", ["arm_max_speed_mps = 100"], "arm_max_speed_mps .* at most 1 m/s"),
    ],
)  # fmt: skip
def test_limit_that_disables_a_guard_is_refused(tmp_path: Path, table: str, lines: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        load_car_file(car_file(tmp_path, table, *lines))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("table", "lines", "warning"),
    [
        ("hardware", [], "coasts: by its file 3.3 m from 2.9 m/s, but the geofence assumes 1.9 m. Set neutral_brake_a"),
        ("hardware.limits", ["deceleration_mps2 = 0.9", "max_speed_mps = 1"], "coasts: by its file 1.0 m from 0.9 m/s"),
        ("hardware.limits", ["reaction_s = 1.2"], ""),
        ("hardware.calibration", ["neutral_brake_a = 4.0"], ""),
        ("motor", ["damping = 1e99"], ""),
    ],
)
def test_real_car_that_coasts_further_than_the_geofence_assumes_gives_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, table: str, lines: list[str], warning: str
) -> None:
    path = car_file(tmp_path, table, *lines)
    with caplog.at_level(logging.WARNING):
        choose_car("sim", vehicle=path)
        choose_car(path, is_driven=False)
        assert caplog.text == ""
        choose_car(path)
    assert warning in caplog.text
    assert bool(warning) == bool(caplog.text)


def test_replay_on_a_real_car_that_coasts_warns_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = car_file(tmp_path, "hardware.actuator", f'port = "{tmp_path / "missing"}"')
    commands = np.zeros((3, 2))
    recording = EpisodeData(np.arange(4) * 0.1, np.zeros((4, 6)), commands, commands, np.zeros(3))
    with caplog.at_level(logging.WARNING), pytest.raises(NotReadyError):
        carlab.replay(recording, path, out=tmp_path)
    assert caplog.text.count("In neutral the car coasts") == 1


def test_limits_up_to_their_bounds_are_accepted(tmp_path: Path) -> None:
    limits = ["stale_pose_s = 2", "lost_pose_s = 2", "frozen_pose_s = 2", "reaction_s = 0", "deceleration_mps2 = 20"]
    real = load_car_file(car_file(tmp_path, "hardware.limits", *limits, "max_speed_mps = 30")).real
    assert real is not None
    assert (real.envelope.stale_pose_s, real.envelope.reaction_s, real.envelope.max_speed_mps) == (2.0, 0.0, 30.0)
    actuator = ["watchdog_s = 1.9", "latch_s = 2", "telemetry_stale_s = 1.9", "telemetry_lost_s = 2"]
    real = load_car_file(car_file(tmp_path, "hardware.actuator", *actuator)).real
    assert real is not None
    assert real.hardware.actuator.latch_s == 2.0
    arming = ["arm_max_speed_mps = 0", "arm_max_erpm = 0", "arm_max_pose_age_s = 2"]
    real = load_car_file(car_file(tmp_path, "hardware", *arming)).real
    assert real is not None
    assert (real.hardware.arm_max_speed_mps, real.hardware.arm_max_pose_age_s) == (0.0, 2.0)


@pytest.mark.parametrize(
    ("table", "line", "message"),
    [
        ("hardware.limits", "max_throttle = 40", "max_throttle is 40; it must lie in (0, 1]."),
        ("hardware.calibration", "max_current_a = 0", "max_current_a is 0; it must be positive."),
        (
            "hardware.actuator",
            'kind = "vesc_seriel"',
            "kind of the actuator is 'vesc_seriel'; it must be one of vesc_serial, vesc_can.",
        ),
    ],
)
def test_message_about_a_value_names_its_table_and_file(tmp_path: Path, table: str, line: str, message: str) -> None:
    path = car_file(tmp_path, table, line)
    with pytest.raises(ConfigError) as error:
        load_car_file(path)
    assert str(error.value) == f"[{table}] of {path}: {message}"
