"""Test the noise that is inferred from few rows against the evidence of a dense Gaussian in scipy."""

import math
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from scipy.optimize import minimize_scalar
from scipy.stats import multivariate_normal

from learning.networks.normaliser import Normaliser
from learning.posterior.discrepancy import CHOLESKY_JITTER
from learning.posterior.inference import infer
from learning.posterior.row_noise import LOG_STD_NOISE

UNITS = Normaliser(torch.zeros(1), torch.ones(1), torch.zeros(1), torch.ones(1))
NOISE = 0.1


@dataclass(frozen=True)
class Polynomial:
    """Simulator with standard normal coefficients of 1, x, x^2 ..."""

    size: int

    def inputs(self, count, generator):
        return 4.0 * torch.rand((count, 1), generator=generator) - 2.0

    def parameters(self, normal):
        return normal

    def features(self, inputs):
        return inputs ** torch.arange(self.size)

    def __call__(self, inputs, parameters):
        return (parameters @ self.features(inputs).T)[:, :, None]


def noise_of_maximum_evidence(features, y):
    """Maximum a posteriori of the noise with the coefficients integrated out."""

    def loss(log_noise):
        covariance = features @ features.T + (math.exp(2.0 * log_noise) + CHOLESKY_JITTER) * np.eye(len(y))
        prior = 0.5 * ((log_noise - math.log(NOISE)) / LOG_STD_NOISE) ** 2
        return prior - multivariate_normal(np.zeros(len(y)), covariance).logpdf(y)

    return math.exp(minimize_scalar(loss, bounds=(math.log(NOISE) - 4.0, math.log(NOISE) + 4.0)).x)


@pytest.mark.parametrize(("size", "count"), [(1, 4), (2, 4), (3, 4), (3, 8)])
def test_noise_of_few_rows_maximises_the_evidence(size, count):
    simulator, ratios = Polynomial(size), []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        x = torch.tensor(rng.uniform(-2.0, 2.0, (count, 1))).float()
        features = simulator.features(x).double().numpy()
        y = features @ rng.normal(size=size) + NOISE * rng.normal(size=count)
        posterior = infer(
            simulator, x, torch.tensor(y[:, None]).float(), UNITS, torch.tensor([NOISE]), with_discrepancy=False,
            seed=seed,
        )  # fmt: skip
        ratios.append(float(posterior.noise_std) / noise_of_maximum_evidence(features, y))
    assert math.exp(np.mean(np.log(ratios))) == pytest.approx(1.0, abs=0.03)
