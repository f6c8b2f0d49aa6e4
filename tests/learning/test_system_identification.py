"""Identified parameters against least squares by scipy and against the truth that made the data."""

import math

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares
from scipy.stats import norm

from carlab.core.errors import DataError
from learning.baselines.system_identification import grey_box, identify
from learning.evaluation import negative_log_likelihood
from learning.functional_svgd.fsvgd import FsvgdSettings
from learning.networks.normaliser import Normaliser
from learning.priors.domain_models import Pendulum, Sinusoids, draw_parameters
from learning.priors.function_prior import RbfCovariance


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def pendulum(count, noise, seed=0, **friction):
    model = Pendulum(**friction)
    inputs = model.inputs(count, generator(seed))
    truth = draw_parameters(model, 1, generator(seed + 1))
    outputs = model(inputs, truth)[0]
    return inputs, outputs + noise * torch.randn(outputs.shape, generator=generator(seed + 2)), truth[0]


def test_parameters_of_a_pendulum_are_those_of_nonlinear_least_squares():
    inputs, outputs, truth = pendulum(60, 0.02)
    found = identify(Pendulum(), inputs, outputs, torch.full((3,), 0.02))
    identifiable = found.parameters[2] / found.parameters[1], 1.0 / (found.parameters[0] * found.parameters[1] ** 2)

    def residual(x):
        """In the two numbers that the motion depends on: g / l and 1 / (m l^2)."""
        length = 1.0
        parameters = torch.tensor([[1.0 / (x[1] * length**2), length, x[0] * length, *[0.0] * 5]], dtype=torch.float64)
        return (Pendulum()(inputs.double(), parameters)[0] - outputs.double()).numpy().ravel()

    exact = least_squares(residual, [10.0, 1.0]).x
    assert np.allclose([float(v) for v in identifiable], exact, rtol=2e-2)
    assert float(found.residuals.scale.mean()) == pytest.approx(0.02, rel=0.15)
    assert float(truth[2] / truth[1]) == pytest.approx(exact[0], rel=0.1)


def test_several_starts_find_the_frequency():
    """A sinusoid's likelihood has many local maxima."""
    model = Sinusoids()
    x = torch.linspace(-5, 5, 40)[:, None]
    truth = torch.tensor([[2.1, 2.25, 1.5]])
    found = identify(model, x, model(x, truth)[0], torch.tensor([0.01]))
    assert torch.allclose(found.parameters, truth[0], atol=1e-2)


def test_outliers_do_not_move_the_parameters():
    """One row of eight is off by forty noises: least squares follow them, a likelihood with tails does not."""
    inputs, outputs, truth = pendulum(80, 0.02)
    spoilt = outputs.clone()
    spoilt[::8] += 0.8
    found = identify(Pendulum(), inputs, spoilt, torch.full((3,), 0.02))
    clean = identify(Pendulum(), inputs, outputs, torch.full((3,), 0.02))

    def frequency(of):
        return math.sqrt(float(of[2] / of[1]))

    assert frequency(found.parameters) == pytest.approx(frequency(clean.parameters), rel=0.01)
    assert frequency(found.parameters) == pytest.approx(frequency(truth), rel=0.02)
    assert found.residuals.dof < 4.0 < clean.residuals.dof
    assert float(found.residuals.scale.max()) < 0.03


class Edged:
    """A line through nothing whose simulator breaks down beyond a slope of one."""

    size = 1

    def parameters(self, normal):
        return 0.5 + 0.3 * normal

    def __call__(self, inputs, parameters):
        slope = parameters[:, None, :]
        return torch.where(slope > 1.0, torch.nan, slope * inputs[None])


def test_a_way_down_that_ends_where_the_simulator_breaks_down_takes_nothing_away():
    """Rows that were spoilt hold least squares back from the edge; errors with tails lead over it."""
    x = torch.linspace(-1, 1, 60)[:, None]
    y = 1.02 * x + 0.02 * torch.randn(x.shape, generator=generator(2))
    y[::8] -= 0.8 * x[::8].sign()
    found = identify(Edged(), x, y, torch.tensor([0.02]))
    assert 0.8 < float(found.parameters) <= 1.0
    assert torch.isfinite(found.residuals.factor).all()


def test_correlated_errors_are_identified():
    """The second output's noise is nine tenths of the first's: what a likelihood gains by it is the closed form's."""
    inputs, outputs, _ = pendulum(800, 0.0)
    noise = 0.02 * torch.randn(outputs.shape, generator=generator(4))
    noise[:, 1] = 0.9 * noise[:, 0] + math.sqrt(1.0 - 0.9**2) * noise[:, 1]
    given = outputs + noise
    simulator = identify(Pendulum(), inputs[:400], given[:400], torch.full((3,), 0.02))
    nll = negative_log_likelihood(simulator.predict(inputs[400:]), given[400:])
    off = (given[400:] - simulator.mean(inputs[400:])).double().numpy()
    apart = -norm(0.0, off.std(axis=0)).logpdf(off).sum(axis=1).mean()
    assert apart - nll == pytest.approx(-0.5 * math.log(1.0 - 0.9**2), abs=0.15)


def test_grey_box_learns_the_simulators_error():
    inputs, outputs, _ = pendulum(300, 0.02, frictions=(0.5, 0.5), drags=(0.5, 0.5))
    noise = torch.full((3,), 0.02)
    simulator = identify(Pendulum(), inputs[:200], outputs[:200], noise)
    zero, one = torch.zeros(4), torch.tensor([1.0, 1.0, 3.5, 2.0])
    normaliser = Normaliser(zero, one, torch.zeros(3), torch.tensor([0.1, 0.1, 0.3]))
    settings = FsvgdSettings(particles=10, steps=1500, hidden=(32, 32), noise_std=0.2, measurement_points=16)
    covariance = RbfCovariance((1.0, 1.0, 1.0), (1.0,))
    pool = Pendulum().inputs(256, generator(9))
    model = grey_box(simulator, inputs[:200], outputs[:200], pool, covariance, normaliser, settings)
    held = inputs[200:], outputs[200:]
    alone, together = (negative_log_likelihood(m.predict(held[0]), held[1]) for m in (simulator, model))
    assert together < alone - 0.5


def test_nothing_can_be_identified_without_data():
    with pytest.raises(DataError, match="record an episode"):
        identify(Sinusoids(), torch.zeros(0, 1), torch.zeros(0, 1), torch.ones(1))
