"""Test identified parameters against scipy's least squares and the true parameters."""

import math

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares
from scipy.stats import norm

from carlab.core.errors import DataError
from learning.baselines import system_identification
from learning.baselines.system_identification import identify
from learning.evaluation import negative_log_likelihood
from learning.priors.domain_models import Pendulum, Sinusoids, draw_parameters
from tests.helpers.seeded import generator


@pytest.fixture(autouse=True)
def few_steps(monkeypatch):
    for name, value in (("STEPS", 150), ("N_RESTARTS", 8), ("REFINEMENT_STEPS", 40)):
        monkeypatch.setattr(system_identification, name, value)


def pendulum(count, noise, seed=0, **friction):
    model = Pendulum(**friction)
    inputs = model.inputs(count, generator(seed))
    truth = draw_parameters(model, 1, generator(seed + 1))
    outputs = model(inputs, truth)[0]
    return inputs, outputs + noise * torch.randn(outputs.shape, generator=generator(seed + 2)), truth[0]


def test_pendulum_parameters_equal_nonlinear_least_squares():
    inputs, outputs, truth = pendulum(60, 0.02)
    found = identify(Pendulum(), inputs, outputs, torch.full((3,), 0.02))
    identifiable = found.parameters[2] / found.parameters[1], 1.0 / (found.parameters[0] * found.parameters[1] ** 2)

    def residual(x):
        """Return residuals as a function of the identifiable g / l and 1 / (m l^2)."""
        length = 1.0
        parameters = torch.tensor([[1.0 / (x[1] * length**2), length, x[0] * length, *[0.0] * 5]], dtype=torch.float64)
        return (Pendulum()(inputs.double(), parameters)[0] - outputs.double()).numpy().ravel()

    exact = least_squares(residual, [10.0, 1.0]).x
    assert np.allclose([float(v) for v in identifiable], exact, rtol=2e-2)
    assert float(found.residuals.scale.mean()) == pytest.approx(0.02, rel=0.15)
    assert float(truth[2] / truth[1]) == pytest.approx(exact[0], rel=0.1)


def test_restarts_find_the_global_optimum_of_a_sinusoid():
    """A sinusoid's likelihood has many local maxima."""
    model = Sinusoids()
    x = torch.linspace(-5, 5, 40)[:, None]
    truth = torch.tensor([[2.1, 2.25, 1.5]])
    found = identify(model, x, model(x, truth)[0], torch.tensor([0.01]))
    assert torch.allclose(found.parameters, truth[0], atol=1e-2)


def test_identified_parameters_are_robust_to_outliers():
    """One row of eight has an error of 40 noise standard deviations."""
    inputs, outputs, truth = pendulum(80, 0.02)
    with_outliers = outputs.clone()
    with_outliers[::8] += 0.8
    found = identify(Pendulum(), inputs, with_outliers, torch.full((3,), 0.02))
    clean = identify(Pendulum(), inputs, outputs, torch.full((3,), 0.02))

    def frequency(parameters):
        return math.sqrt(float(parameters[2] / parameters[1]))

    assert frequency(found.parameters) == pytest.approx(frequency(clean.parameters), rel=0.01)
    assert frequency(found.parameters) == pytest.approx(frequency(truth), rel=0.02)
    assert found.residuals.dof < 4.0 < clean.residuals.dof
    assert float(found.residuals.scale.max()) < 0.03


class FailingLine:
    """A line through the origin that returns NaN for slopes above one."""

    size = 1

    def parameters(self, normal):
        return 0.5 + 0.3 * normal

    def __call__(self, inputs, parameters):
        slope = parameters[:, None, :]
        return torch.where(slope > 1.0, torch.nan, slope * inputs[None])


def test_refinement_towards_invalid_parameters_keeps_a_valid_estimate():
    """Outliers keep least squares below the invalid slopes; the robust refinement moves towards them."""
    x = torch.linspace(-1, 1, 60)[:, None]
    y = 1.02 * x + 0.02 * torch.randn(x.shape, generator=generator(2))
    y[::8] -= 0.8 * x[::8].sign()
    found = identify(FailingLine(), x, y, torch.tensor([0.02]))
    assert 0.8 < float(found.parameters) <= 1.0
    assert torch.isfinite(found.residuals.factor).all()


def test_correlated_errors_gain_likelihood_by_the_closed_form():
    """The noise of two outputs has the correlation 0.9; the gain is their mutual information."""
    inputs, outputs, _ = pendulum(800, 0.0)
    noise = 0.02 * torch.randn(outputs.shape, generator=generator(4))
    noise[:, 1] = 0.9 * noise[:, 0] + math.sqrt(1.0 - 0.9**2) * noise[:, 1]
    noisy = outputs + noise
    simulator = identify(Pendulum(), inputs[:400], noisy[:400], torch.full((3,), 0.02))
    nll = negative_log_likelihood(simulator.predict(inputs[400:]), noisy[400:])
    residuals = (noisy[400:] - simulator.mean(inputs[400:])).double().numpy()
    independent_nll = -norm(0.0, residuals.std(axis=0)).logpdf(residuals).sum(axis=1).mean()
    assert independent_nll - nll == pytest.approx(-0.5 * math.log(1.0 - 0.9**2), abs=0.15)


def test_identification_without_data_is_refused():
    with pytest.raises(DataError, match="record an episode"):
        identify(Sinusoids(), torch.zeros(0, 1), torch.zeros(0, 1), torch.ones(1))
