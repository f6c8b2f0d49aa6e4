"""A simulator linear in its parameters, and data with a discrepancy from it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from learning.evaluation import Mixture
from learning.networks.normaliser import Normaliser
from learning.priors.domain_models import uniform

UNITS = Normaliser(
    torch.tensor([0.5, -1.0]), torch.tensor([2.0, 0.5]), torch.tensor([1.0, -2.0]), torch.tensor([2.0, 0.5])
)
NOISE = torch.tensor([0.2, 0.1])
EMPTY = torch.zeros(0, 2)


def features(x):
    """Features of two outputs in NumPy (O, N, 3)."""
    a, b = np.asarray(x, dtype=float).T
    return np.stack([np.stack([a, b, np.ones_like(a)], axis=1), np.stack([0 * a, 0.3 * a, np.sin(b)], axis=1)])


@dataclass(frozen=True)
class Linear:
    """Simulator with two outputs, linear in three standard normal parameters (a Gaussian process)."""

    size: int = 3

    def inputs(self, count: int, generator: torch.Generator) -> Tensor:
        return uniform(((-3.0, 4.0), (-2.0, 0.0)), count, generator)

    def parameters(self, normal: Tensor) -> Tensor:
        return normal

    def __call__(self, inputs: Tensor, parameters: Tensor) -> Tensor:
        return torch.einsum("onk,pk->pno", torch.tensor(features(inputs)).to(parameters), parameters)


def rows(count, seed=0, noise=NOISE):
    """Inputs and outputs with a discrepancy from the linear simulator."""
    rng = np.random.default_rng(seed)
    x = np.stack([rng.uniform(-3, 4, count), rng.uniform(-2, 0, count)], axis=1)
    return tensors(x, truth(x) + noise.numpy() * rng.normal(size=(count, 2)))


def truth(x):
    x = np.asarray(x, dtype=float)
    wave = np.stack([0.5 * np.sin(2 * x[:, 0]), 0.2 * np.cos(3 * x[:, 1])], axis=1)
    return (features(x) @ np.array([0.8, -1.1, 0.4])).T + wave


def tensors(*arrays):
    return [torch.tensor(a, dtype=torch.float32) for a in arrays]


def mean_and_scale(prediction: Mixture) -> tuple[Tensor, Tensor]:
    """Return mean and scale (N, O) of a prediction with one component."""
    return prediction.means[0], prediction.marginal_scales[0]
