"""What an episode of learning came to: return and final pose beside what the model had foretold."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import torch

from carlab.core.episode_data import EpisodeData
from carlab.core.observation import decode_state, encode
from carlab.core.quantities import FloatArray
from carlab.experiment.reality_check import RealityCheck
from carlab.experiment.session import EpisodeResult
from learning.car_dynamics import OneStep

AHEAD_S = 1.0
SAMPLES = 64


@dataclass(frozen=True, slots=True)
class EpisodeFigures:
    """One row of the learning curve.

    Attributes:
        episode: from 1.
        total_reward: on the car.
        foretold: mean return of the same policy in the learned car.
        parked: on the car.
        distance_m, yaw_error_rad, speed_mps: at the end.
        rows: from which the model was learned.
        last_episode_nll: of the episode before under the model that had not seen it [nat]; NaN for the first.
        last_episode_calibration_error: of the same.
        model_seconds, policy_seconds: that learning took.
        updates: gradient steps of SAC.
        end: why the episode ended.
        reality: verdict of the light diagnosis of all episodes so far (explains, left, undecided, failed); empty
            where there is none.
        excess: noise floors by which the errors of the simulator exceed one, NaN where that is not known.
        excess_std: its standard error.
        diagnosis: what the light diagnosis says, in words.
    """

    episode: int
    total_reward: float
    foretold: float
    parked: bool
    distance_m: float
    yaw_error_rad: float
    speed_mps: float
    rows: int
    last_episode_nll: float
    last_episode_calibration_error: float
    model_seconds: float
    policy_seconds: float
    updates: int
    end: str
    reality: str = ""
    excess: float = float("nan")
    excess_std: float = float("nan")
    diagnosis: str = ""

    def to_dict(self) -> dict[str, Any]:
        """For a file; what is no number is null."""
        return {k: None if isinstance(v, float) and v != v else v for k, v in asdict(self).items()}

    def with_check(self, told: RealityCheck) -> EpisodeFigures:
        """The same with what a light diagnosis says."""
        text = " ".join(told.sentences)
        return replace(self, reality=told.verdict, excess=told.excess, excess_std=told.excess_std, diagnosis=text)

    @classmethod
    def from_dict(cls, row: Mapping[str, Any]) -> EpisodeFigures:
        """What ``to_dict`` gave. Raises TypeError for other names."""
        found: dict[str, Any] = {k: float("nan") if v is None else v for k, v in row.items()}
        return cls(**found)


def figures_of(result: EpisodeResult, training: Mapping[str, Any]) -> EpisodeFigures:
    """Figures of an episode and of what was learned before it."""
    summary = result.summary
    return EpisodeFigures(
        episode=int(training["episode"]),
        total_reward=result.total_reward,
        foretold=float(training["return_in_model"]),
        parked=bool(summary["parked"]),
        distance_m=summary["distance_m"],
        yaw_error_rad=summary["yaw_error_rad"],
        speed_mps=summary["speed_mps"],
        rows=int(training["rows"]),
        last_episode_nll=float(training.get("last_episode_nll", float("nan"))),
        last_episode_calibration_error=float(training.get("last_episode_calibration_error", float("nan"))),
        model_seconds=float(training["model_seconds"]),
        policy_seconds=float(training["policy_seconds"]),
        updates=int(training["updates"]),
        end=result.reason.name,
    )


@dataclass(frozen=True, slots=True)
class Foretold:
    """Where the model says the car goes from recorded states, by the recorded commands.

    Attributes:
        ticks: of the recording, the first of each stretch being where it starts (S, T).
        mean, std: of x, y [m], yaw [rad], vx, vy [m/s] and yaw rate [rad/s] at those ticks (S, T, 6).
    """

    ticks: np.ndarray
    mean: FloatArray
    std: FloatArray


def foretell(dynamics: OneStep, episode: EpisodeData, seed: int = 0) -> Foretold:
    """Stretches of a second, one after the other, by draws of particles and noise; none of a shorter episode."""
    history = dynamics.history
    length = max(round(AHEAD_S / episode.period_s), 1)
    starts = np.arange(history, episode.ticks - length + 1, length)
    if not len(starts):
        none = np.zeros((0, length + 1, 6))
        return Foretold(np.zeros((0, length + 1), dtype=np.int64), none, none)
    generator = torch.Generator().manual_seed(seed)
    past = episode.sent[starts[:, None] - np.arange(history, 0, -1)]
    first = encode(episode.states[starts], past)
    features = torch.from_numpy(first).float().repeat_interleave(SAMPLES, dim=0)
    states = []
    for k in range(length + 1):
        states.append(decode_state(features).view(len(starts), SAMPLES, 6))
        if k < length:
            command = torch.from_numpy(episode.sent[starts + k]).float().repeat_interleave(SAMPLES, dim=0)
            features = dynamics.step(features, command, generator)
    every = torch.stack(states, dim=1).double().numpy()  # (S, T, samples, 6)
    every[..., 2] = np.unwrap(every[..., 2], axis=1)
    return Foretold(starts[:, None] + np.arange(length + 1), every.mean(axis=2), every.std(axis=2))


__all__ = ["EpisodeFigures", "Foretold", "figures_of", "foretell"]
