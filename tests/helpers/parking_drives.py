"""Drives of a parking policy with random errors, on the simulated car and on cars of the independent generator.

The recordings have the format of ``carlab learn``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from carlab.benchmark.cases.refit import channel_scores, cut_windows
from carlab.benchmark.effects.catalogue import Draw
from carlab.benchmark.effects.forms import all_forms
from carlab.benchmark.world.base_car import BaseCar
from carlab.benchmark.world.measurement import Noise, Recording, record
from carlab.benchmark.world.physics import World
from carlab.benchmark.world.simulation import drive
from carlab.core.episode_data import EpisodeData
from carlab.core.policy import PolicyInput
from carlab.core.quantities import STATE_NAMES, Action, CarState
from carlab.core.safety import SafetyEnvelope
from carlab.core.task import ParkingTask
from carlab.experiment.episodes.scripted_policies import ReverseParkingPolicy
from carlab.experiment.episodes.session import Session
from carlab.recording.run_folder import RunDirectory
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.simulated_car import SimulatedCar

TASK = ParkingTask()
TICKS = 100


@dataclass(frozen=True)
class Concealed:
    """Episodes, the simulator without their concealed effect, its parameters, and the true scores of channels."""

    episodes: list[EpisodeData]
    simulator: SimulatorConfig
    parameters: dict[str, float]
    scores: dict[str, float]

    @property
    def main_channels(self) -> list[str]:
        """The channels with at least half of the largest squared excess, by the generator's simulator."""
        excess = {name: max(score**2 - 1.0, 0.0) for name, score in self.scores.items()}
        return [name for name, e in excess.items() if e >= 0.5 * max(excess.values()) > 0.0]


class NoisyParkingPolicy:
    """Reverse parking at a wrong goal with slow noise on the commands; the errors decrease from episode to episode."""

    name = "noisy_parking"

    def __init__(self, rng: np.random.Generator, skill: float) -> None:
        self._rng = rng
        self._parker = ReverseParkingPolicy.for_car(SimulatorConfig.from_preset())
        self._parker.cruise_mps = float(rng.uniform(0.8, 2.2))
        goal = rng.normal(size=3) * (0.6, 0.6, 0.8) * (1.0 - skill)
        self._parker.goal = (float(goal[0]), float(goal[1]), float(goal[2]))
        self._size = (1.0 - 0.6 * skill) * rng.uniform(0.15, 0.6, size=2)
        self._noise = np.zeros(2)

    def reset(self) -> None:
        self._noise = np.zeros(2)

    def act(self, view: PolicyInput) -> Action | None:
        return Action.from_array(self.command(view.observation.state))

    def command(self, state: CarState) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
        decay = np.exp(-1.0 / 30.0 / 0.25)
        self._noise = decay * self._noise + np.sqrt(1.0 - decay**2) * self._rng.normal(size=2) * self._size
        action = self._parker.act(cast(Any, SimpleNamespace(observation=SimpleNamespace(state=state))))
        assert action is not None
        return np.clip(action.to_array() + self._noise, -1.0, 1.0)


def drive_like_learning(
    true: SimulatorConfig, folder: Path, episodes: int = 5, seed: int = 0, ticks: int = TICKS
) -> RunDirectory:
    """A run folder with ``episodes`` recordings of the simulated car ``true``."""
    run = RunDirectory.create(folder, f"drives{seed}")
    envelope = SafetyEnvelope(arena_m=TASK.arena_m)
    with SimulatedCar(true, seed=seed) as car:
        for k in range(episodes):
            policy = NoisyParkingPolicy(np.random.default_rng((seed, k)), k / max(episodes, 1))
            Session(
                car, policy, TASK, envelope, run, true.control_period_s, seed=100 * seed + k, max_ticks=ticks,
                record_rerun=False,
            ).drive(1)  # fmt: skip
            car.reset_fault()
    return run


def concealed_drives(effect: str | None, size: float, seed: int, episodes: int = 5, share: float = 0.0) -> Concealed:
    """Generate episodes of an independent car with one concealed effect, and the simulator without it.

    Args:
        effect: effect id, or None.
        size: size in typical sizes of the generator's form.
        seed: seed of all random draws.
        episodes: number of episodes.
        share: maximum relative error of the base parameters of the true car.
    """
    draws = np.random.default_rng((seed, 1))
    nominal = replace(BaseCar(), position_std=0.0003)
    true = nominal.perturbed(draws, share)
    x, y = np.meshgrid(np.arange(0.5, 1.6, 0.25), np.arange(-1.2, 0.1, 0.25))
    drawn = Draw.from_rng(draws, true, np.stack([x.ravel(), y.ravel()], axis=1))
    episodes_data, recordings, parameters = [], [], dict[str, float]()
    for k in range(episodes):
        world = World(true)
        if effect is not None:
            form = all_forms()[(effect, "catalogue")]
            parameters = form.sized(size * form.typical, drawn)
            form.attach(world, parameters)
        rng = np.random.default_rng((seed, 2, k))
        policy = NoisyParkingPolicy(rng, k / max(episodes, 1))
        start = TASK.sample_start(rng).to_array()
        driven = drive(
            world,
            lambda t, state, policy=policy: tuple(policy.command(CarState.from_array(state))),
            TICKS / 30.0,
            start=(*map(float, start[:3]), 0.0, 0.0, 0.0),
        )
        noise = Noise(nominal.position_std, nominal.yaw_std)
        recording = record(driven, world, noise, np.random.default_rng((seed, 3, k)))
        recordings.append(recording)
        sent, no_latency = recording.commands[:-1], np.full(len(recording.commands) - 1, np.nan)
        episodes_data.append(EpisodeData(recording.t_s, recording.measured, sent, sent, no_latency))
    return Concealed(
        episodes_data, SimulatorConfig.from_tables(nominal.table()), parameters, _scores(recordings, nominal, true)
    )


def _scores(recordings: Sequence[Recording], nominal: BaseCar, true: BaseCar) -> dict[str, float]:
    """Return scores of the nominal car by channel, with the generator's windows, simulator and floor."""
    squared = [
        (channel_scores(cut_windows(r, true, horizon_s=0.8, every_s=0.2), nominal.free()) ** 2) for r in recordings
    ]
    return dict(zip(STATE_NAMES, map(float, np.sqrt(np.mean(squared, axis=0))), strict=True))
