"""Test the random commands of the policy ``excitation``."""

from pathlib import Path

import numpy as np
import pytest
from episodes import PERIOD_S, drive_episode

import carlab
from carlab.core.episode_data import EpisodeData
from carlab.core.errors import ConfigError
from carlab.core.geofence import rectangle
from carlab.core.policy import PolicyInput
from carlab.core.quantities import Action, CarState, Observation
from carlab.core.safety import SafetyEnvelope
from carlab.core.task import RecordedTask
from carlab.experiment.episodes.excitation_policy import ExcitationPolicy
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.simulated_car import SimulatedCar

HALF_M = 1.5
ENVELOPE = SafetyEnvelope(arena_m=rectangle(-HALF_M, HALF_M, -HALF_M, HALF_M))
REALITIES = {
    "as in the car file": {},
    "strong motor": {"motor.drive_gain": 11.0},
    "low grip": {"tyre.front.mu": 0.25, "tyre.rear.mu": 0.24},
    "steering lag": {"effects.steering_lag.time_constant": 0.12},
    "long delay": {"timing.command_delay": 0.16},
}


def drive(
    reality: SimulatorConfig, ticks: int, envelope: SafetyEnvelope = ENVELOPE, policy: ExcitationPolicy | None = None
) -> EpisodeData:
    policy = policy or ExcitationPolicy(SimulatorConfig(), envelope)
    with SimulatedCar(reality, seed=0) as car:
        car.place(CarState())
        return drive_episode(car, policy, RecordedTask(CarState(), ticks), envelope, max_ticks=ticks)


@pytest.mark.parametrize("name", REALITIES)
def test_a_car_that_differs_from_its_file_stays_in_a_small_arena(name: str) -> None:
    data = drive(SimulatorConfig().with_values(REALITIES[name]), 900)
    assert data.metadata["end_reason"] == "COMPLETED"
    assert np.abs(data.states[:, :2]).max() < HALF_M


def test_commands_and_motions_vary() -> None:
    data = drive(SimulatorConfig(), 1800)
    steering, throttle = data.sent.T
    # A uniform variable in [-1, 1] has a standard deviation of 0.58.
    assert steering.std() == pytest.approx(0.58, abs=0.15)
    assert abs(steering.mean()) < 0.25
    assert throttle.min() < -0.4
    assert throttle.max() > 0.8
    changes = np.count_nonzero(np.abs(np.diff(data.sent, axis=0)).max(axis=1) > 0.05)
    assert changes > 60.0 / 1.2
    vx, yaw_rate = data.states[:, 3], data.states[:, 5]
    assert vx.max() > 1.2
    assert vx.min() < -0.5
    assert yaw_rate.max() > 1.5
    assert yaw_rate.min() < -1.5


def test_the_seed_determines_the_commands_and_episodes_differ() -> None:
    policies = [ExcitationPolicy(SimulatorConfig(), ENVELOPE, seed) for seed in (3, 3, 4)]
    first, second, other = (drive(SimulatorConfig(), 90, policy=policy).sent for policy in policies)
    np.testing.assert_array_equal(first, second)
    assert not np.array_equal(first, other)
    assert not np.array_equal(first, drive(SimulatorConfig(), 90, policy=policies[0]).sent)


def test_commands_stay_within_the_limits() -> None:
    envelope = SafetyEnvelope(max_steering=0.5, max_throttle=0.3, arena_m=ENVELOPE.arena_m)
    policy = ExcitationPolicy(SimulatorConfig(), envelope)
    actions = [act(policy, CarState(), k * PERIOD_S) for k in range(300)]
    steering, throttle = np.array([a.to_array() for a in actions]).T
    assert 0.45 < np.abs(steering).max() <= 0.5
    assert 0.25 < np.abs(throttle).max() <= 0.3


def test_a_car_that_drives_fast_at_the_edge_brakes_straight_ahead() -> None:
    for vx, x in ((1.5, 1.2), (-1.5, -1.2)):
        action = act(ExcitationPolicy(SimulatorConfig(), ENVELOPE), CarState(x_m=x, vx_mps=vx), 0.0)
        assert action.steering == 0.0
        assert action.throttle * vx < -0.4


def test_a_car_that_rests_at_the_edge_drives_away_from_it() -> None:
    policy = ExcitationPolicy(SimulatorConfig(), ENVELOPE)
    for _ in range(20):
        policy.reset()
        assert act(policy, CarState(x_m=HALF_M - 0.22), 0.0).throttle <= 0.0


def test_excitation_without_an_arena_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="needs an arena"):
        carlab.drive("sim", policy="excitation", task=RecordedTask(CarState(), 10), out=tmp_path)


def test_an_episode_takes_a_minute_by_default(tmp_path: Path) -> None:
    run = carlab.drive("sim", policy="excitation", out=tmp_path, rerun=False, picture=False)
    (episode,) = (carlab.load(path).episode for path in run.recordings)
    assert episode.times_s[-1] - episode.times_s[0] == pytest.approx(60.0, abs=0.1)
    assert run.end is not None
    assert run.end.name == "COMPLETED"


def act(policy: ExcitationPolicy, state: CarState, elapsed_s: float) -> Action:
    observation = Observation(state, elapsed_s, elapsed_s, 0)
    action = policy.act(PolicyInput(np.zeros(7), observation, 0, elapsed_s))
    assert action is not None
    return action
