"""Test FSVGD on a prior alone, on data alone, and on both with a known posterior."""

import math

import pytest
import torch

from carlab.core.errors import DataError
from learning.baselines import ensemble
from learning.baselines.ensemble import deep_ensemble
from learning.evaluation import calibration_error, negative_log_likelihood
from learning.functional_svgd.fsvgd import FsvgdSettings, GaussianProcessPrior, SimulatorPrior, fit_fsvgd
from learning.networks.normaliser import Normaliser
from learning.priors.function_prior import RbfCovariance
from tests.helpers.seeded import generator

UNIT = Normaliser(torch.zeros(1), torch.ones(1), torch.zeros(1), torch.ones(1))
EMPTY = torch.zeros(0, 1)


def lines(x, count=400, seed=0):
    """Draw functions ``a x + b`` with a ~ N(1, 0.5^2), b ~ N(0, 0.3^2)."""
    drawn = torch.randn(count, 2, generator=generator(seed)) * torch.tensor([0.5, 0.3]) + torch.tensor([1.0, 0.0])
    return (drawn[:, :1] * x[:, 0] + drawn[:, 1:])[:, :, None]


def test_fit_to_a_simulator_alone_has_the_moments_of_its_draws():
    pool = torch.linspace(-2, 2, 64)[:, None]
    prior = SimulatorPrior(lines(pool), pool)
    settings = FsvgdSettings(steps=800, hidden=(32, 32), fit_noise=False, noise_std=0.05)
    prediction = fit_fsvgd(EMPTY, EMPTY, pool, prior, UNIT, settings).predict(pool)
    assert torch.allclose(prediction.mean[:, 0], pool[:, 0], atol=0.25)
    exact = (0.25 * pool[:, 0] ** 2 + 0.09).sqrt()
    assert torch.allclose(prediction.epistemic_std[:, 0], exact, rtol=0.4, atol=0.05)


def test_fit_to_data_is_close_to_the_conjugate_posterior():
    """Bayesian linear regression with two rows has a closed form."""
    pool = torch.linspace(-2, 2, 64)[:, None]
    x, y = torch.tensor([[-1.0], [0.5]]), torch.tensor([[-1.6], [0.9]])
    noise = 0.2
    prior = SimulatorPrior(lines(torch.cat([x, pool]), 4000), torch.cat([x, pool]))
    settings = FsvgdSettings(steps=1200, hidden=(32, 32), fit_noise=False, noise_std=noise)
    prediction = fit_fsvgd(x, y, pool, prior, UNIT, settings).predict(pool)
    features = torch.cat([x, torch.ones_like(x)], dim=1)
    precision = torch.diag(torch.tensor([4.0, 1 / 0.09])) + features.T @ features / noise**2
    mean = torch.linalg.solve(precision, torch.tensor([[4.0], [0.0]]) + features.T @ y / noise**2)
    at = torch.cat([pool, torch.ones_like(pool)], dim=1)
    exact_std = (at @ torch.linalg.inv(precision) * at).sum(dim=1).sqrt()
    assert torch.allclose(prediction.mean, at @ mean, atol=0.12)
    assert torch.allclose(prediction.epistemic_std[:, 0], exact_std, rtol=0.5, atol=0.04)


def test_one_particle_converges_to_the_maximum_a_posteriori_function():
    """With a Gaussian-process prior it is kernel ridge regression at the data."""
    x = torch.linspace(-1, 1, 9)[:, None]
    y = torch.sin(3 * x)
    covariance = RbfCovariance((1.0,), (0.7,))
    prior = GaussianProcessPrior(torch.cat([x, x]), covariance, jitter=1e-2)
    settings = FsvgdSettings(
        particles=1,
        steps=1500,
        measurement_points=0,
        fit_noise=False,
        noise_std=0.3,
        weight_decay=0.0,
        hidden=(64, 64),
    )
    found = fit_fsvgd(x, y, x, prior, UNIT, settings).predict(x).mean
    kernel = covariance(x)[0] + 1e-2 * torch.eye(9)
    ridge = kernel @ torch.linalg.solve(kernel + 0.3**2 * torch.eye(9), y)
    assert torch.allclose(found, ridge, atol=0.02)


def test_noise_of_the_data_is_estimated():
    x = 2.0 * torch.rand(400, 1, generator=generator()) - 1.0
    y = 0.5 * x + 0.15 * torch.randn(400, 1, generator=generator(1))
    settings = FsvgdSettings(steps=1000, hidden=(16,), noise_std=0.6, particles=5)
    posterior = fit_fsvgd(
        x, y, x, GaussianProcessPrior(torch.cat([x, x]), RbfCovariance((1.0,), (0.8,))), UNIT, settings
    )
    assert float(posterior.noise_std) == pytest.approx(0.15, rel=0.1)
    assert negative_log_likelihood(posterior.predict(x), y) < -0.4


def test_expected_noise_has_the_weight_of_its_prior_rows():
    """With three rows fitted exactly, the variance is the expected one times prior rows over all rows."""
    x = torch.tensor([[-1.0], [0.0], [1.0]])
    settings = FsvgdSettings(steps=3000, hidden=(32,), noise_std=0.1, noise_rows=2.0, particles=3, weight_decay=0.0)
    found = deep_ensemble(x, torch.sin(3 * x), UNIT, settings).networks
    assert float(found.noise_std) == pytest.approx(0.1 * math.sqrt(2.0 / 5.0), rel=0.05)


def test_ensemble_members_are_trained_independently():
    """The first of three members equals the same network trained alone with AdamW."""
    x = torch.linspace(-1, 1, 20)[:, None]
    y = torch.sin(3 * x)
    settings = FsvgdSettings(particles=3, steps=300, hidden=(8,), fit_noise=False)
    found = deep_ensemble(x, y, UNIT, settings).networks  # Three members leave out no rows.
    three, network = found.parameters, found.network
    start = network.initial(3, generator(), "cpu")
    alone = start[:1].clone().requires_grad_()
    optimiser = torch.optim.AdamW([alone], lr=settings.learning_rate, weight_decay=settings.weight_decay)
    for step in range(settings.steps):
        optimiser.param_groups[0]["lr"] = 1e-3 * (0.01 + 0.495 * (1 + math.cos(math.pi * step / settings.steps)))
        optimiser.zero_grad()
        (0.5 * ((network(alone, x)[0] - y) ** 2).sum() / 0.1**2).backward()
        optimiser.step()
    assert torch.allclose(three[:1], alone.detach(), atol=1e-3)
    assert not torch.allclose(three[0], three[1], atol=1e-2)


def test_ensemble_members_leave_out_one_fifth_of_the_rows_each(monkeypatch):
    """Without a trend, a changed row changes four fifths of the members and leaves the others equal."""
    monkeypatch.setattr(ensemble, "_ridge_trend", lambda _, inputs, outputs: (torch.zeros(2, 1), outputs.double()))
    x = torch.linspace(-1, 1, 20)[:, None]
    y = torch.sin(3 * x)
    settings = FsvgdSettings(particles=10, steps=30, hidden=(8,), fit_noise=False)
    before = deep_ensemble(x, y, UNIT, settings).networks.parameters
    n_left_out = torch.zeros(10)
    for row in range(20):
        changed = y.clone()
        changed[row] += 5.0
        after = deep_ensemble(x, changed, UNIT, settings).networks.parameters
        same = (after == before).all(dim=1)
        assert int(same.sum()) == 2
        n_left_out += same
    assert n_left_out.tolist() == [4.0] * 10


def test_ensemble_has_the_linear_trend_of_a_ridge_regression():
    """Networks that are trained this briefly have an error of 0.7 to 0.9 if they are fitted to the outputs."""
    units = Normaliser(torch.ones(3), torch.tensor([1.0, 2.0, 0.5]), torch.tensor([1.0, 2.0]), torch.tensor([2.0, 3.0]))
    x = units.raw_inputs(torch.randn(240, 3, generator=generator()))
    y = x @ torch.tensor([[2.0, 0.5], [-1.0, 0.3], [0.7, -2.0]]) + torch.tensor([3.0, -1.0])
    y = y + torch.tensor([0.01, 0.03]) * torch.randn(y.shape, generator=generator(1))
    settings = FsvgdSettings(particles=10, steps=800, hidden=(8,), noise_std=0.05, learning_rate=1e-2)
    prediction = deep_ensemble(x[:40], y[:40], units, settings).predict(x[40:])
    assert float((prediction.mean - y[40:]).square().mean(dim=0).sqrt().max()) < 0.2
    assert calibration_error(prediction, y[40:]) < 0.12


def test_ensemble_noise_is_estimated_from_left_out_rows():
    """Wide networks interpolate their training rows, so training residuals underestimate the noise."""
    x = torch.linspace(-1, 1, 40)[:, None]
    clean = torch.sin(3 * x)
    y = clean + 0.2 * torch.randn(x.shape, generator=generator(3))
    settings = FsvgdSettings(particles=10, steps=1500, hidden=(64, 64), weight_decay=0.0, noise_std=0.05)
    found = deep_ensemble(x, y, UNIT, settings)
    training_rms = float((found.networks.predict(x).mean - y).std())
    assert training_rms < 0.15
    new = clean + 0.2 * torch.randn(x.shape, generator=generator(4))
    assert calibration_error(found.predict(x), new) < 0.1
    assert (
        negative_log_likelihood(found.predict(x), new) < negative_log_likelihood(found.networks.predict(x), new) - 0.3
    )


def test_ensemble_predicts_the_error_of_the_mean_of_all_members():
    """Untrained members are independent: the mean of the four that hold out a row has five times the variance."""
    squares = []
    for seed in range(4):
        x, y = (
            torch.randn(1200, 3, generator=generator(seed)),
            0.05 * torch.randn(1200, 1, generator=generator(10 + seed)),
        )
        units = Normaliser(torch.zeros(3), torch.ones(3), torch.zeros(1), torch.ones(1))
        settings = FsvgdSettings(steps=0, hidden=(64,), seed=seed)
        prediction = deep_ensemble(x[:200], y[:200], units, settings).predict(x[200:])
        squares.append(float(((prediction.mean - y[200:]) / prediction.std).square().mean()))
    assert 0.5 < sum(squares) / 4 < 1.5


def test_equal_seeds_give_equal_models():
    pool = torch.linspace(-2, 2, 16)[:, None]
    settings = FsvgdSettings(steps=50, hidden=(8,))
    first, second = (fit_fsvgd(EMPTY, EMPTY, pool, SimulatorPrior(lines(pool), pool), UNIT, settings) for _ in range(2))
    assert torch.equal(first.parameters, second.parameters)


@pytest.mark.parametrize(
    ("inputs", "outputs", "prior", "message"),
    [
        (EMPTY, EMPTY, None, "neither data nor a prior"),
        (torch.ones(3, 1), torch.ones(2, 1), None, "3 rows of inputs and 2 of outputs"),
        (torch.tensor([[1.0], [float("nan")]]), torch.ones(2, 1), None, "missing or infinite"),
    ],
)
def test_invalid_data_is_refused(inputs, outputs, prior, message):
    with pytest.raises(DataError, match=message):
        fit_fsvgd(inputs, outputs, torch.ones(4, 1), prior, UNIT, FsvgdSettings(steps=1))


def test_ensemble_refuses_incomplete_rows():
    x = torch.linspace(-1, 1, 20)[:, None]
    settings = FsvgdSettings(steps=5, hidden=(8,))
    with pytest.raises(DataError, match="missing or infinite"):
        deep_ensemble(x, torch.where(x > 0.9, torch.nan, x), UNIT, settings)
    with pytest.raises(DataError, match="each row needs both"):
        deep_ensemble(x, x[:10], UNIT, settings)
