"""The same policy on the same physics ends at the same state, in process and over the wire."""

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from carlab.cars import choose_car, default_car
from carlab.cars.emulated_car import EmulatedCar
from carlab.cars.latency import (
    ARRIVAL_TO_LOOP,
    COMMAND_TO_WIRE,
    EXPOSURE_TO_ARRIVAL,
    WIRE_TO_FIRMWARE,
    LatencyParts,
    measure_latency,
)
from carlab.core.angles import wrap
from carlab.core.car import Car
from carlab.core.episode_data import EpisodeData
from carlab.core.policy import Policy
from carlab.core.safety import SafetyEnvelope
from carlab.core.task import ParkingTask
from carlab.experiment.episodes.episode import run_episode
from carlab.experiment.episodes.scripted_policies import ReverseParkingPolicy
from sim_backends.simulated_car import SimulatedCar

SEEDS = range(5)
TASK = ParkingTask()
ENVELOPE = SafetyEnvelope(arena_m=TASK.arena_m)
PERIOD_S = default_car().simulator.control_period_s


@pytest.fixture(scope="module")
def emulated() -> Iterator[EmulatedCar]:
    with EmulatedCar(default_car()) as car:
        yield car


@pytest.fixture(scope="module")
def latency(emulated: EmulatedCar) -> LatencyParts:
    parts = measure_latency(emulated)
    for name, p50, p99, maximum, count in parts.rows():
        print(f"{name:20s} p50 {p50:6.2f} ms  p99 {p99:6.2f} ms  max {maximum:6.2f} ms  ({count})")
    return parts


def drive(car: Car, policy: Policy, seed: int) -> EpisodeData:
    assert car.place(TASK.sample_start(np.random.default_rng(seed)))
    return run_episode(car, policy, TASK, ENVELOPE, period_s=PERIOD_S)


@pytest.mark.realtime
@pytest.mark.timeout(240)
def test_same_policy_ends_at_the_same_state(emulated: EmulatedCar, latency: LatencyParts) -> None:
    policy = ReverseParkingPolicy.for_car(default_car().simulator)
    # The median: one pause of a busy machine delays a third of the samples, and would shift the mean by 0.1 s.
    typical_s = {name: float(np.median(samples)) for name, samples in latency.parts.items()}
    nominal = default_car().simulator
    wire_s = typical_s[COMMAND_TO_WIRE] + typical_s[WIRE_TO_FIRMWARE]
    mocap = replace(nominal.mocap, latency_s=max(typical_s[EXPOSURE_TO_ARRIVAL], nominal.mocap.latency_s))
    with_measured_latencies = replace(nominal, command_delay_s=nominal.command_delay_s + wire_s, mocap=mocap)
    distances_m, yaw_differences_rad = [], []
    for seed in SEEDS:
        emulated_episode = drive(emulated, policy, seed)
        with SimulatedCar(with_measured_latencies, seed=seed) as simulated:
            simulated_episode = drive(simulated, policy, seed)
        assert emulated_episode.ticks == simulated_episode.ticks == 100, emulated_episode.metadata
        end, expected = emulated_episode.states[-1], simulated_episode.states[-1]
        distances_m.append(math.hypot(*(end[:2] - expected[:2])))
        yaw_differences_rad.append(abs(wrap(end[2] - expected[2])))
    print("difference [m]", np.round(distances_m, 4), "[rad]", np.round(yaw_differences_rad, 4))
    assert np.median(distances_m) <= 0.05
    assert np.median(yaw_differences_rad) <= 0.05


@pytest.mark.realtime
def test_latency_parts_match_the_known_delays(latency: LatencyParts) -> None:
    assert set(latency.parts) == {COMMAND_TO_WIRE, WIRE_TO_FIRMWARE, EXPOSURE_TO_ARRIVAL, ARRIVAL_TO_LOOP}
    for name, samples in latency.parts.items():
        assert (samples > 0).all(), (name, samples)
    # Frames of 8 and 10 bytes at 115200 baud take 1.56 ms on the wire; the servo frame is the last.
    assert np.median(latency.parts[WIRE_TO_FIRMWARE]) > 0.6e-3
    # The world delivers each exposure after the latency of the car file, never earlier.
    assert np.median(latency.parts[EXPOSURE_TO_ARRIVAL]) > default_car().simulator.mocap.latency_s - 1e-3


def test_equal_seeds_give_identical_simulated_episodes() -> None:
    policy = ReverseParkingPolicy.for_car(default_car().simulator)
    runs = []
    for _ in range(2):
        with choose_car("sim", seed=3).car as car:
            runs.append(drive(car, policy, 3))
    assert runs[0].states.tobytes() == runs[1].states.tobytes()
    with choose_car("sim", seed=4).car as car:
        assert drive(car, policy, 3).states.tobytes() != runs[0].states.tobytes()
