"""Test the quick check on drives with known physics: verdict, location and causes."""

from __future__ import annotations

import functools
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import parking_drives as drives
import pytest

from carlab.core.episode_data import EpisodeData
from carlab.core.state_estimator import fit_velocity
from carlab.diagnosis.quick.conditions import ErrorCondition, find_conditions
from carlab.diagnosis.quick.quick_check import ChannelScore, QuickCheck, quick_check
from carlab.diagnosis.quick.sentences import sentences, short
from carlab.diagnosis.settings import QUICK
from carlab.diagnosis.state_alignment import align_states, window_variance_s2
from carlab.prediction.windows import PredictionWindows, cut_windows, segments_of
from carlab.recording.mcap.source import read_episode
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.effects import EFFECTS

SIMULATOR = SimulatorConfig.from_preset()


def recorded(folder: Path, true: SimulatorConfig, seed: int, episodes: int = 5) -> list[EpisodeData]:
    run = drives.drive_like_learning(true, folder, episodes, seed)
    return [read_episode(path) for path in run.recordings()]


def test_condition_of_the_largest_error_is_a_clause() -> None:
    channel = ChannelScore("x", 0.08, 0.001, "m")
    clauses = {
        "share of braking < 0.36": "mostly where share of braking < 0.36 (",
        "lateral acceleration > 2 m/s2": "mostly where lateral acceleration > 2 m/s² (",
        "driving backwards": "mostly driving backwards (",
    }
    for condition, clause in clauses.items():
        found = ErrorCondition(condition, 77.0, 48.0, 10)
        check = QuickCheck("left", score=35.0, channels=(channel,), conditions=(found,))
        assert clause in sentences(check)[0]


@pytest.mark.parametrize("seed", [20, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (21, 22))])
def test_true_simulator_explains_its_recordings(tmp_path: Path, seed: int) -> None:
    episodes = recorded(tmp_path, SIMULATOR, seed)
    for count in (1, 3, 5):
        check = quick_check(episodes[:count], SIMULATOR)
        assert check.verdict == "explains", check
        assert check.causes == ()
        assert 0.5 < check.score < QUICK.score_max
    assert "explains" in sentences(check)[0]


@functools.cache
def checked(effect: str, size: float) -> tuple[drives.Concealed, QuickCheck]:
    """Return drives with a concealed effect and their check."""
    case = drives.concealed_drives(effect, size, seed=23)
    return case, quick_check(case.episodes, case.simulator)


@pytest.mark.parametrize(
    ("effect", "size"),
    [
        ("motor_lag", 1.0),
        pytest.param("marker_offset", 1.0, marks=pytest.mark.slow),
        pytest.param("road_slope", 2.0, marks=pytest.mark.slow),
    ],
)
def test_concealed_effect_of_an_independent_generator_is_located_and_named(effect: str, size: float) -> None:
    case, check = checked(effect, size)
    assert check.verdict == "left"
    assert check.channels[0].channel in case.main_channels
    first = check.causes[0]
    assert first.id == effect
    for name, value in case.parameters.items():
        found = first.parameters[f"effects.{effect}.{name}"]
        assert found.value == pytest.approx(value, rel=0.15, abs=0.002)
    assert first.share > 0.9
    assert not first.with_refit
    assert f"Most likely cause: {EFFECTS[effect].name} ({effect}: " in sentences(check)[1]
    assert short(check).endswith(f"likely cause: {EFFECTS[effect].name}")


@pytest.mark.slow
def test_effect_is_named_with_wrong_base_parameters() -> None:
    case = drives.concealed_drives("motor_lag", 3.0, seed=24, share=0.1)
    check = quick_check(case.episodes, case.simulator)
    assert check.verdict == "left"
    found = {c.id: c for c in check.causes}["motor_lag"]
    assert found.with_refit
    truth = case.parameters["time_constant"]
    assert found.parameters["effects.motor_lag.time_constant"].value == pytest.approx(truth, rel=0.15)


def test_wrong_parameter_is_distinguished_from_new_effects(tmp_path: Path) -> None:
    weaker = SIMULATOR.with_values({"motor.drive_gain": 7.4})
    check = quick_check(recorded(tmp_path, weaker, 25), SIMULATOR)
    assert (check.verdict, check.causes[0].id) == ("left", "motor.drive_gain")
    change = check.causes[0].parameters["motor.drive_gain"]
    assert change.value == pytest.approx(7.4, rel=0.01)
    assert change.before == SIMULATOR.values()["motor.drive_gain"]


@pytest.mark.slow
def test_changed_effect_is_distinguished_from_new_effects(tmp_path: Path) -> None:
    diagnosed, slower = (replace(SIMULATOR, effects={"steering_lag": {"time_constant": t}}) for t in (0.05, 0.09))
    episodes = recorded(tmp_path, slower, 21)
    assert quick_check(episodes, slower).verdict == "explains", "a simulator must be checked with its effects"
    check = quick_check(episodes, diagnosed)
    assert (check.verdict, check.causes[0].id) == ("left", "effects.steering_lag")
    assert check.causes[0].parameters["effects.steering_lag.time_constant"].value == pytest.approx(0.09, rel=0.1)


def test_check_is_deterministic() -> None:
    case, first = checked("motor_lag", 1.0)
    assert quick_check(case.episodes, case.simulator).to_dict() == first.to_dict()


def test_insufficient_recordings_are_undecided_with_a_reason() -> None:
    case = drives.concealed_drives(None, 0.0, seed=28, episodes=1)
    (episode,) = case.episodes
    standing = np.zeros_like(episode.states)
    short_one = replace(
        episode, times_s=episode.times_s[:20], states=episode.states[:20], sent=episode.sent[:19],
        requested=episode.requested[:19], rewards=episode.rewards[:19],
    )  # fmt: skip
    with_nan = episode.states.copy()
    with_nan[::4, 0] = np.nan
    for episodes in ([], [replace(episode, states=standing)], [short_one], [replace(episode, states=with_nan)]):
        check = quick_check(episodes, case.simulator)
        assert check.verdict == "undecided"
        assert check.why
        (sentence,) = sentences(check)
        assert check.why in sentence


def test_outlier_in_one_episode_is_undecided(tmp_path: Path) -> None:
    """A person pushes the car aside in one episode."""
    episodes = recorded(tmp_path, SIMULATOR, 21)
    index = next(k for k, e in enumerate(episodes) if e.ticks > 80)
    pushed = episodes[index]
    moved, poses = pushed.states.copy(), pushed.poses.copy()
    ramp = np.clip((pushed.times_s - pushed.times_s[40]) / 0.4, 0.0, 1.0)
    moved[:, 1] += 0.1 * ramp
    poses[:, 2] += 0.1 * np.clip((poses[:, 0] - pushed.times_s[40]) / 0.4, 0.0, 1.0)
    episodes[index] = replace(pushed, states=moved, poses=poses)
    check = quick_check(episodes, SIMULATOR)
    assert check.score > QUICK.score_max
    assert check.verdict == "undecided"
    assert "outlier" in check.why


# -- conditions -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def windows() -> PredictionWindows:
    return cut_windows(segments_of(drives.concealed_drives(None, 0.0, seed=30).episodes), 0.8, 0.2)


def test_errors_on_one_side_at_one_place_or_while_braking_are_located(windows: PredictionWindows) -> None:
    noise = 1.0 + 0.2 * np.random.default_rng(1).random(len(windows))
    assert find_conditions(windows, noise) == ()
    left = windows.commands[:, :, 0].mean(axis=1) > 0.0
    first = find_conditions(windows, np.where(left, 5.0, 1.0) * noise)[0]
    assert first.text == "steering to the left"
    assert first.inside == pytest.approx(5.0 * first.outside, rel=0.15)
    assert first.windows == left.sum()
    x, y = np.median(windows.measured[:, :, :2].reshape(-1, 2), axis=0).round(1)
    near = (np.hypot(windows.measured[:, :, 0] - x, windows.measured[:, :, 1] - y) < 0.4).any(axis=1)
    assert 5 < near.sum() < len(windows) - 5
    texts = [c.text for c in find_conditions(windows, np.where(near, 6.0, 1.0) * noise)]
    assert any(text.startswith("within 0.5 m of") for text in texts)


# -- alignment of states ----------------------------------------------------------------------------------------------

RADIUS_M, RATE = 0.8, 1.5


def circle(t_s: np.ndarray) -> np.ndarray:
    """States on a circle with growing speed: pose and body velocities in closed form."""
    angle, rate = RATE * t_s + 0.3 * t_s**2, RATE + 0.6 * t_s
    x, y = RADIUS_M * np.sin(angle), RADIUS_M * (1.0 - np.cos(angle))
    yaw = (angle + math.pi) % (2.0 * math.pi) - math.pi
    return np.stack([x, y, yaw, RADIUS_M * rate, np.zeros_like(t_s), rate], axis=1)


def circle_episode(velocity_offset: float = 0.0) -> EpisodeData:
    """Return forty ticks with the newest of 120 Hz poses and velocities of line fits through six poses."""
    captures = np.arange(-30, 180) / 120.0 + 0.0021
    poses = np.column_stack([captures, circle(captures)[:, :3]])
    unwrapped = np.column_stack([poses[:, :3], np.unwrap(poses[:, 3])])
    times = np.arange(41) / 30.0
    states, age, delay = [], [], []
    for t in times:
        newest = int(np.searchsorted(captures, t - 0.009)) - 1
        line = fit_velocity(unwrapped[newest - 5 : newest + 1])
        states.append([*poses[newest, 1:], line.vx_mps - velocity_offset, line.vy_mps, line.yaw_rate_radps])
        age.append(t - captures[newest])
        delay.append(captures[newest] - line.t_s)
    zero_commands = np.zeros((40, 2))
    extra = {"pose_age_s": np.array(age), "velocity_delay_s": np.array(delay)}
    return EpisodeData(times, np.array(states), zero_commands, zero_commands, np.zeros(40), poses, extra=extra)


def test_aligned_states_have_the_stated_latency() -> None:
    episode, latency_s = circle_episode(), 0.008
    truth = circle(episode.times_s - latency_s)
    assert np.abs(episode.states - truth)[:, 3:].max() > 0.01, "the recorded velocities must be delayed"
    aligned = align_states(episode, latency_s)
    rows = np.searchsorted(episode.times_s, aligned.times_s)
    assert aligned.ticks >= 38
    error = aligned.states - truth[rows]
    error[:, 2] = (error[:, 2] + np.pi) % (2.0 * np.pi) - np.pi
    assert np.abs(error[:, :3]).max() < 1e-4
    assert np.abs(error[:, 3:]).max() < 2e-3
    np.testing.assert_array_equal(aligned.sent, episode.sent[rows[:-1]])


def test_alignment_keeps_the_influence_of_a_velocity_filter() -> None:
    aligned, filtered = (align_states(circle_episode(offset), 0.008) for offset in (0.0, 0.07))
    np.testing.assert_allclose(aligned.states[:, 3] - filtered.states[:, 3], 0.07, atol=1e-9)


def test_missing_poses_give_missing_states_and_foreign_recordings_are_unchanged() -> None:
    episode = circle_episode()
    missing_poses = (episode.poses[:, 0] > 0.6) & (episode.poses[:, 0] < 0.75)
    broken = align_states(replace(episode, poses=episode.poses[~missing_poses]), 0.008)
    missing = np.isnan(broken.states).any(axis=1)
    assert missing[np.argmin(np.abs(broken.times_s - 0.68))]
    assert not missing[broken.times_s < 0.55].any()
    assert not missing[broken.times_s > 0.82].any()
    foreign = replace(episode, extra={})
    assert align_states(foreign, 0.008) is foreign
    assert window_variance_s2([foreign]) is None


def test_velocity_error_of_a_cubic_equals_the_window_variance() -> None:
    """For x = t^3 a symmetric window of variance s2 gives the velocity 3 t^2 + 3 s2."""
    t = np.arange(-60, 61) / 120.0
    poses = np.column_stack([t, t**3, np.zeros_like(t), np.zeros_like(t)])
    times = np.array([-0.2, 0.0, 0.2])
    ages = {"pose_age_s": np.full(3, 0.01), "velocity_delay_s": np.full(3, np.nan)}
    zero_commands = np.zeros((2, 2))
    episode = EpisodeData(times, np.zeros((3, 6)), zero_commands, zero_commands, np.zeros(2), poses, extra=ages)
    error = align_states(episode, 0.0).states[:, 3] - 3.0 * times**2
    variance = window_variance_s2([episode])
    assert variance is not None
    np.testing.assert_allclose(error, 3.0 * variance, rtol=1e-6)
