"""Predictions by learned cars: sampled paths."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from carlab.core.episode_data import EpisodeData
from carlab.core.errors import DataError
from carlab.core.observation import decode_state, encode
from carlab.core.planar import to_body, to_world
from carlab.core.quantities import FloatArray
from carlab.prediction.initial_states import as_recorded
from carlab.prediction.windows import PredictionWindows, cut_windows, segments_of
from learning.rollouts import RolloutModel
from learning.world.drive_windows import DriveWindows

N_SAMPLES = 64


def sample_paths(
    dynamics: RolloutModel,
    initial_states: FloatArray,
    past_commands: FloatArray,
    commands: FloatArray,
    *,
    n_samples: int = N_SAMPLES,
    seed: int = 0,
) -> FloatArray:
    """Sample paths of a learned car.

    A one-step model samples particle and noise in each step. With a disturbance, each path has one particle and one
    path of the disturbance, and the noise of the measurement is added after each step without moving the car.

    Args:
        dynamics: the learned car with a history of H commands.
        initial_states: (S, 6) x, y [m], yaw [rad], vx, vy [m/s], yaw rate [rad/s].
        past_commands: (S, H, 2) steering and throttle before the first step.
        commands: (S, K, 2), one per step.
        n_samples: paths from each initial state.
        seed: seed of the samples.

    Returns:
        States (S, K + 1, n_samples, 6), yaw unwrapped along a path.
    """
    generator = torch.Generator().manual_seed(seed)
    first = encode(initial_states, past_commands)
    features = torch.from_numpy(first).float().repeat_interleave(n_samples, dim=0)
    rollouts = dynamics.rollouts(len(features), generator)
    states = [decode_state(features).view(len(initial_states), n_samples, 6)]
    for command in np.moveaxis(commands, 1, 0):
        action = torch.from_numpy(np.ascontiguousarray(command)).float().repeat_interleave(n_samples, dim=0)
        features = rollouts.step(features, action, generator)
        state, noise = decode_state(features), rollouts.measurement_noise(generator)
        if noise is not None:
            x, y = to_world(noise[:, 0], noise[:, 1], state[:, 2])
            state = state + torch.cat([x[:, None], y[:, None], noise[:, 2:]], dim=1)
        states.append(state.view(len(initial_states), n_samples, 6))
    paths = torch.stack(states, dim=1).double().numpy()
    paths[..., 2] = np.unwrap(paths[..., 2], axis=1)
    return np.asarray(paths)


@dataclass(frozen=True, slots=True)
class LearnedModel:
    """A learned car as a predictive model: the mean of its sampled paths.

    Attributes:
        dynamics: learned car with the step of the windows.
        n_samples: paths from each initial state.
        seed: seed of the samples.
    """

    dynamics: RolloutModel
    n_samples: int = N_SAMPLES
    seed: int = 0

    def predict(self, windows: PredictionWindows) -> FloatArray:
        """As ``PredictiveModel``, (S, K + 1, 6).

        Raises:
            DataError: the model's history is longer than that of the windows.
        """
        return np.asarray(self.sample(windows).mean(axis=2))

    def sample(self, windows: PredictionWindows) -> FloatArray:
        """Paths (S, K + 1, n_samples, 6), yaw continuous with that of the windows. Raises DataError as ``predict``."""
        past = past_commands(windows, self.dynamics.history)
        start = windows.initial_states[:, None, None]
        at_origin = windows.initial_states * [0.0, 0.0, 1.0, 1.0, 1.0, 1.0]  # 32 bits resolve positions near 0 only
        paths = sample_paths(self.dynamics, at_origin, past, windows.commands, n_samples=self.n_samples, seed=self.seed)
        paths[..., :2] += start[..., :2]
        # Angles are encoded by sine and cosine; the recording's yaw is unwrapped.
        paths[..., 2] += 2 * np.pi * np.round((start[..., 2] - paths[:, :1, :, 2]) / (2 * np.pi))
        return paths


def past_commands(windows: PredictionWindows, history: int) -> FloatArray:
    """The last ``history`` commands (S, H, 2) before windows. Raises DataError if the windows have fewer."""
    length = windows.past_commands.shape[1]
    if history > length:
        raise DataError(
            f"The learned car requires {history} past commands, but the windows have {length}; learn with a shorter "
            "history."
        )
    return windows.past_commands[:, length - history :]


def recorded_windows(episodes: Sequence[EpisodeData], horizon_s: float, stride_s: float) -> PredictionWindows:
    """Windows with the period of the recordings and initial states as recorded, to which a one-step model is fitted.

    Raises:
        DataError: no recording, a recording has fewer than two commands, or the car moves in no window.
    """
    if not episodes:
        raise DataError("There is no recording to cut windows from; record a drive.")
    return as_recorded(cut_windows(segments_of(episodes, episodes[0].period_s), horizon_s, stride_s))


def drive_windows(windows: PredictionWindows, history: int) -> DriveWindows:
    """The same windows in the frames of their initial poses, for the fit of a disturbance.

    Args:
        windows: windows with initial states as they are measured, since a one-step model is fitted to these.
        history: number of past commands of the learned car.

    Raises:
        DataError: the windows have fewer past commands.
    """
    start = windows.initial_states[:, None]
    motion = windows.measured[:, 1:].copy()
    dx, dy = motion[..., 0] - start[..., 0], motion[..., 1] - start[..., 1]
    motion[..., 0], motion[..., 1] = to_body(dx, dy, start[..., 2])
    motion[..., 2] -= start[..., 2]
    arrays = (windows.initial_states[:, 3:], past_commands(windows, history), windows.commands, motion)
    velocities, past, commands, motions = (torch.from_numpy(np.ascontiguousarray(a)).float() for a in arrays)
    return DriveWindows(velocities, past, commands, motions, windows.period_s)
