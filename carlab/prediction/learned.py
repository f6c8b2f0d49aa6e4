"""Predictions by learned dynamics: sampled paths of one-step models."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from carlab.core.errors import DataError
from carlab.core.observation import decode_state, encode
from carlab.core.quantities import FloatArray
from carlab.prediction.windows import PredictionWindows
from learning.world.car_dynamics import OneStep

N_SAMPLES = 64


def sample_paths(
    dynamics: OneStep,
    initial_states: FloatArray,
    past_commands: FloatArray,
    commands: FloatArray,
    *,
    n_samples: int = N_SAMPLES,
    seed: int = 0,
) -> FloatArray:
    """Sample paths of a learned car; each step samples particle and noise.

    Args:
        dynamics: the learned one-step model with a history of H commands.
        initial_states: (S, 6).
        past_commands: (S, H, 2) before the first step.
        commands: (S, K, 2), one per step.
        n_samples: paths from each initial state.
        seed: seed of the samples.

    Returns:
        States (S, K + 1, n_samples, 6), yaw unwrapped along a path.
    """
    generator = torch.Generator().manual_seed(seed)
    first = encode(initial_states, past_commands)
    features = torch.from_numpy(first).float().repeat_interleave(n_samples, dim=0)
    states = [decode_state(features).view(len(initial_states), n_samples, 6)]
    for command in np.moveaxis(commands, 1, 0):
        action = torch.from_numpy(np.ascontiguousarray(command)).float().repeat_interleave(n_samples, dim=0)
        features = dynamics.step(features, action, generator)
        states.append(decode_state(features).view(len(initial_states), n_samples, 6))
    paths = torch.stack(states, dim=1).double().numpy()
    paths[..., 2] = np.unwrap(paths[..., 2], axis=1)
    return np.asarray(paths)


@dataclass(frozen=True, slots=True)
class LearnedModel:
    """A learned car as a predictive model: the mean of its sampled paths.

    Attributes:
        dynamics: one-step model with the step of the windows.
        n_samples: paths from each initial state.
        seed: seed of the samples.
    """

    dynamics: OneStep
    n_samples: int = N_SAMPLES
    seed: int = 0

    def predict(self, windows: PredictionWindows) -> FloatArray:
        """As ``PredictiveModel``. Raises DataError if the model's history is longer than that of the windows."""
        history = self.dynamics.history
        if history > windows.past_commands.shape[1]:
            raise DataError(
                f"The learned car requires {history} past commands, but the windows have "
                f"{windows.past_commands.shape[1]}; learn with a shorter history."
            )
        past = windows.past_commands[:, windows.past_commands.shape[1] - history :]
        paths = sample_paths(
            self.dynamics, windows.initial_states, past, windows.commands, n_samples=self.n_samples, seed=self.seed
        )
        mean = np.asarray(paths.mean(axis=2))
        # Angles are encoded by sine and cosine; the recording's yaw is unwrapped.
        mean[..., 2] += np.round((windows.initial_states[:, 2] - mean[:, 0, 2]) / (2 * np.pi))[:, None] * 2 * np.pi
        return mean


__all__ = ["N_SAMPLES", "LearnedModel", "sample_paths"]
