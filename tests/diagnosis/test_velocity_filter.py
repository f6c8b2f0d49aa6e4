"""Filters of recorded velocities are measured against the poses, whatever the simulator lacks."""

from dataclasses import replace

import foreign_drive as foreign
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import carlab
from carlab.core.episode_data import EpisodeData
from carlab.diagnosis.identification.velocity_filter import velocity_filter
from carlab.diagnosis.measured_filter import FILTER, measured_filter
from carlab.prediction.windows import segments_of
from sim_backends import SimulatorConfig

PERIOD_S = 1.0 / 30.0
TIMES_S = np.arange(1800) * PERIOD_S
POSE_STD = np.array([0.0003, 0.0003, 0.002])
VELOCITY_STD = np.array([0.01, 0.01, 0.03])


def side_velocity(t):
    """Side velocity [m/s] of the drive at times [s]. A dead time and a gain equal a filter at a single frequency."""
    return 0.3 * np.sin(2.0 * t) + 0.1 * np.sin(6.0 * t)


def filtered_velocities(time_constant_s: float, dead_time_s: float = 0.0) -> np.ndarray:
    """Velocities (N, 3) of the drive in closed form behind a first-order filter, integrated by scipy."""

    def true(t):
        later = t - dead_time_s
        return np.array([foreign.speed(later), side_velocity(later), foreign.yaw_rate(later)])

    if time_constant_s == 0.0:
        return true(TIMES_S).T
    solution = solve_ivp(
        lambda t, v: (true(t) - v) / time_constant_s,
        (0.0, TIMES_S[-1]),
        true(0.0),
        t_eval=TIMES_S,
        rtol=1e-8,
        atol=1e-10,
    )
    return solution.y.T


def episode(velocities: np.ndarray, seed: int = 0) -> EpisodeData:
    """A recording of the drive with noise. Poses are integrated from the true velocities."""
    rng = np.random.default_rng(seed)
    fine = np.arange(TIMES_S[-1] / 1e-3 + 1) * 1e-3
    vx, vy = foreign.speed(fine), side_velocity(fine)
    yaw = foreign.yaw(fine)
    rates = np.stack([vx * np.cos(yaw) - vy * np.sin(yaw), vx * np.sin(yaw) + vy * np.cos(yaw)])
    steps = 0.5e-3 * (rates[:, 1:] + rates[:, :-1])
    path = np.concatenate([np.zeros((2, 1)), np.cumsum(steps, axis=1)], axis=1)
    pose = np.stack(
        [np.interp(TIMES_S, fine, path[0]), np.interp(TIMES_S, fine, path[1]), foreign.yaw(TIMES_S)], axis=1
    )
    pose = pose + POSE_STD * rng.standard_normal(pose.shape)
    drive = foreign.drive(TIMES_S)
    commands = np.column_stack([drive["steering"], drive["throttle"]])[:-1]
    states = np.column_stack([pose, velocities + VELOCITY_STD * rng.standard_normal(velocities.shape)])
    return EpisodeData(
        times_s=TIMES_S,
        states=states,
        requested=commands,
        sent=commands,
        rewards=np.zeros(len(commands)),
        poses=np.column_stack([TIMES_S, pose]),
    )


@pytest.mark.parametrize("time_constant_s", [0.1, 0.15, 0.2])
def test_time_constant_is_measured(time_constant_s):
    found = velocity_filter(segments_of([episode(filtered_velocities(time_constant_s))]))
    assert found is not None
    assert found.time_constant_s == pytest.approx(time_constant_s, rel=0.03, abs=0.002)


@pytest.mark.parametrize("dead_time_s", [0.0, 0.5 * PERIOD_S, PERIOD_S, 2.0 * PERIOD_S, 0.17, 0.3, 0.5])
@pytest.mark.parametrize("seed", range(5))
def test_velocities_with_a_dead_time_alone_have_no_filter(dead_time_s, seed):
    assert velocity_filter(segments_of([episode(filtered_velocities(0.0, dead_time_s), seed)])) is None


def test_filter_of_one_velocity_is_no_filter_of_the_recording():
    velocities = filtered_velocities(0.0)
    velocities[:, 2] = filtered_velocities(0.1)[:, 2]
    assert velocity_filter(segments_of([episode(velocities)])) is None


def test_velocity_that_does_not_follow_the_poses_has_no_filter():
    velocities = filtered_velocities(0.1)
    velocities[:, 1] += 0.3 * np.sin(5.0 * TIMES_S)
    assert velocity_filter(segments_of([episode(velocities)])) is None


def part(whole: EpisodeData, first: int, last: int) -> EpisodeData:
    """Rows ``first`` to ``last`` of a recording."""
    return replace(
        whole,
        times_s=whole.times_s[first:last],
        states=whole.states[first:last],
        requested=whole.requested[first : last - 1],
        sent=whole.sent[first : last - 1],
        rewards=whole.rewards[first : last - 1],
        poses=whole.poses[first:last],
    )


def test_short_recording_has_no_measured_filter():
    assert velocity_filter(segments_of([part(episode(filtered_velocities(0.1)), 0, 150)])) is None


def test_unknown_start_of_the_filter_does_not_bias_short_segments():
    whole = episode(filtered_velocities(0.1))
    found = velocity_filter(segments_of([part(whole, first, first + 45) for first in range(0, 1755, 45)]))
    assert found is not None
    assert found.time_constant_s == pytest.approx(0.1, rel=0.03)
    assert found.unexplained_ratio > 2.0


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_constant_velocity_column_has_no_filter(value):
    recording = episode(filtered_velocities(0.1))
    recording.states[:, 4] = value
    assert velocity_filter(segments_of([recording])) is None


def test_filter_of_the_car_file_is_not_measured_again():
    segments = segments_of([episode(filtered_velocities(0.1))])
    nominal = SimulatorConfig()
    assert measured_filter(segments, nominal) is not None
    assert measured_filter(segments, replace(nominal, effects={FILTER: {"time_constant": 0.1}})) is None
    assert measured_filter(segments, replace(nominal, effects={FILTER: {"time_constant": 0.05}})) is not None


def test_filter_is_named_although_the_simulator_is_wrong():
    """The motion of this drive is kinematic and not that of the simulator, whose error is far above the noise."""
    report = carlab.diagnose(
        episode(filtered_velocities(0.1)), carlab.load_car("rc_car"), effects=[FILTER, "command_delay"], budget_s=30.0
    )
    assert next(iter(report.effects)) == FILTER
    assert FILTER not in {decision.effect for decision in report.figure_data.decisions}  # no decision of the search
    estimate = report.effects[FILTER].parameters["time_constant"]
    assert estimate.low90 < 0.1 < estimate.high90
    assert report.diagnosis.held_out["with_effects"].score > 3.0
    assert report.effects[FILTER].indistinguishable_from == ()
    assert report.model.simulator.effects[FILTER]["time_constant"] == pytest.approx(estimate.value)


def test_filter_has_no_influence_if_it_was_not_requested(monkeypatch):
    def held_out_errors():
        report = carlab.diagnose(
            episode(filtered_velocities(0.1)), carlab.load_car("rc_car"), effects=["command_delay"], budget_s=30.0
        )
        assert FILTER not in report.effects
        return report.diagnosis.held_out

    with_measurement = held_out_errors()
    monkeypatch.setattr("carlab.diagnosis.diagnose.measured_filter", lambda *given: None)
    assert with_measurement == held_out_errors()


def test_search_without_other_candidates_or_time_names_the_filter():
    report = carlab.diagnose(
        episode(filtered_velocities(0.1)), carlab.load_car("rc_car"), effects=[FILTER], budget_s=30.0, stop=lambda: True
    )
    assert list(report.effects) == [FILTER]


def test_no_filter_is_measured_against_slow_poses():
    """Velocities of poses at 10 Hz attenuate the motion themselves, as a filter does."""
    rows = slice(None, None, 3)
    slow = episode(filtered_velocities(0.15))
    commands = slow.sent[::3][: len(slow.times_s[rows]) - 1]
    changed = {"times_s": slow.times_s[rows], "states": slow.states[rows], "poses": slow.poses[rows]}
    slow = replace(slow, requested=commands, sent=commands, rewards=np.zeros(len(commands)), **changed)
    assert velocity_filter(segments_of([slow])) is None


def test_velocities_of_poses_have_no_measured_filter() -> None:
    """At 20 Hz the derivative of noisy poses resembled a filter, which was named with a time constant of 0 s."""
    filtered = episode(filtered_velocities(0.06))
    assert measured_filter(segments_of([filtered]), SimulatorConfig()) is not None
    of_poses = replace(filtered, metadata={"velocity_source": "vx, vy: local quadratic; yaw_rate: local quadratic"})
    assert measured_filter(segments_of([of_poses]), SimulatorConfig()) is None
