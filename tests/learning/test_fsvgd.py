"""Fitting particles: to a prior alone, to data alone, and to both where the posterior is known."""

import math

import pytest
import torch

from carlab.core.errors import DataError
from learning.baselines.ensemble import deep_ensemble
from learning.evaluation import calibration_error, negative_log_likelihood
from learning.functional_svgd.fsvgd import FsvgdSettings, GaussianProcessPrior, SimulatorPrior, fit_fsvgd
from learning.networks.normaliser import Normaliser
from learning.priors.function_prior import RbfCovariance

UNIT = Normaliser(torch.zeros(1), torch.ones(1), torch.zeros(1), torch.ones(1))
EMPTY = torch.zeros(0, 1)


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def lines(x, count=400, seed=0):
    """Draws a x + b, a ~ N(1, 0.5^2), b ~ N(0, 0.3^2)."""
    drawn = torch.randn(count, 2, generator=generator(seed)) * torch.tensor([0.5, 0.3]) + torch.tensor([1.0, 0.0])
    return (drawn[:, :1] * x[:, 0] + drawn[:, 1:])[:, :, None]


def test_fitted_to_a_simulator_alone_it_predicts_like_its_draws():
    pool = torch.linspace(-2, 2, 64)[:, None]
    prior = SimulatorPrior(lines(pool), pool)
    settings = FsvgdSettings(steps=1500, hidden=(32, 32), fit_noise=False, noise_std=0.05)
    prediction = fit_fsvgd(EMPTY, EMPTY, pool, prior, UNIT, settings).predict(pool)
    assert torch.allclose(prediction.mean[:, 0], pool[:, 0], atol=0.25)
    exact = (0.25 * pool[:, 0] ** 2 + 0.09).sqrt()
    assert torch.allclose(prediction.epistemic_std[:, 0], exact, rtol=0.4, atol=0.05)


def test_with_data_it_comes_near_the_conjugate_posterior():
    """Two points on a line of unknown slope and height: Bayesian linear regression in closed form."""
    pool = torch.linspace(-2, 2, 64)[:, None]
    x, y = torch.tensor([[-1.0], [0.5]]), torch.tensor([[-1.6], [0.9]])
    noise = 0.2
    prior = SimulatorPrior(lines(torch.cat([x, pool]), 4000), torch.cat([x, pool]))
    settings = FsvgdSettings(steps=3000, hidden=(32, 32), fit_noise=False, noise_std=noise)
    prediction = fit_fsvgd(x, y, pool, prior, UNIT, settings).predict(pool)
    features = torch.cat([x, torch.ones_like(x)], dim=1)
    precision = torch.diag(torch.tensor([4.0, 1 / 0.09])) + features.T @ features / noise**2
    mean = torch.linalg.solve(precision, torch.tensor([[4.0], [0.0]]) + features.T @ y / noise**2)
    at = torch.cat([pool, torch.ones_like(pool)], dim=1)
    exact_std = (at @ torch.linalg.inv(precision) * at).sum(dim=1).sqrt()
    assert torch.allclose(prediction.mean, at @ mean, atol=0.12)
    assert torch.allclose(prediction.epistemic_std[:, 0], exact_std, rtol=0.5, atol=0.04)


def test_one_particle_finds_the_most_probable_function():
    """With a Gaussian-process prior that is kernel ridge regression at the data."""
    x = torch.linspace(-1, 1, 9)[:, None]
    y = torch.sin(3 * x)
    covariance = RbfCovariance((1.0,), (0.7,))
    prior = GaussianProcessPrior(torch.cat([x, x]), covariance, jitter=1e-2)
    settings = FsvgdSettings(
        particles=1,
        steps=4000,
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


def test_the_noise_of_the_data_is_found():
    x = 2.0 * torch.rand(400, 1, generator=generator()) - 1.0
    y = 0.5 * x + 0.15 * torch.randn(400, 1, generator=generator(1))
    settings = FsvgdSettings(steps=1500, hidden=(16,), noise_std=0.6, particles=5)
    posterior = fit_fsvgd(
        x, y, x, GaussianProcessPrior(torch.cat([x, x]), RbfCovariance((1.0,), (0.8,))), UNIT, settings
    )
    assert float(posterior.noise_std) == pytest.approx(0.15, rel=0.1)
    assert negative_log_likelihood(posterior.predict(x), y) < -0.4


def test_expected_noise_counts_for_its_rows():
    """Three rows met exactly: the most probable variance is the expected one times its rows over all rows."""
    x = torch.tensor([[-1.0], [0.0], [1.0]])
    settings = FsvgdSettings(steps=3000, hidden=(32,), noise_std=0.1, noise_rows=2.0, particles=3, weight_decay=0.0)
    found = deep_ensemble(x, torch.sin(3 * x), UNIT, settings).networks
    assert float(found.noise_std) == pytest.approx(0.1 * math.sqrt(2.0 / 5.0), rel=0.05)


def test_members_of_an_ensemble_do_not_feel_each_other():
    """The first member of three is what it is alone; Adam makes its step free of the number of members."""
    x = torch.linspace(-1, 1, 20)[:, None]
    y = torch.sin(3 * x)
    settings = FsvgdSettings(particles=3, steps=300, hidden=(8,), fit_noise=False)
    found = deep_ensemble(x, y, UNIT, settings).networks  # Three are too few to leave rows out.
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


def test_each_member_of_an_ensemble_leaves_out_another_fifth():
    """A row that is changed changes all members but a fifth, and these by nothing."""
    x = torch.linspace(-1, 1, 20)[:, None]
    y = torch.sin(3 * x)
    settings = FsvgdSettings(particles=10, steps=30, hidden=(8,), fit_noise=False)
    before = deep_ensemble(x, y, UNIT, settings).networks.parameters
    blind = torch.zeros(10)
    for row in range(20):
        spoilt = y.clone()
        spoilt[row] += 5.0
        after = deep_ensemble(x, spoilt, UNIT, settings).networks.parameters
        same = (after == before).all(dim=1)
        assert int(same.sum()) == 2
        blind += same
    assert blind.tolist() == [4.0] * 10


def test_noise_of_an_ensemble_is_that_of_rows_that_were_not_seen():
    """Networks wide enough to follow every row: in the sample they leave next to nothing."""
    x = torch.linspace(-1, 1, 40)[:, None]
    clean = torch.sin(3 * x)
    y = clean + 0.2 * torch.randn(x.shape, generator=generator(3))
    settings = FsvgdSettings(particles=10, steps=4000, hidden=(64, 64), weight_decay=0.0, noise_std=0.05)
    found = deep_ensemble(x, y, UNIT, settings)
    seen = float((found.networks.predict(x).mean - y).std())
    assert seen < 0.15
    new = clean + 0.2 * torch.randn(x.shape, generator=generator(4))
    assert calibration_error(found.predict(x), new) < 0.1
    assert (
        negative_log_likelihood(found.predict(x), new) < negative_log_likelihood(found.networks.predict(x), new) - 0.3
    )


def test_the_same_seed_gives_the_same_model():
    pool = torch.linspace(-2, 2, 16)[:, None]
    settings = FsvgdSettings(steps=50, hidden=(8,))
    first, second = (fit_fsvgd(EMPTY, EMPTY, pool, SimulatorPrior(lines(pool), pool), UNIT, settings) for _ in range(2))
    assert torch.equal(first.parameters, second.parameters)


@pytest.mark.parametrize(
    ("inputs", "outputs", "prior", "said"),
    [
        (EMPTY, EMPTY, None, "neither data nor a prior"),
        (torch.ones(3, 1), torch.ones(2, 1), None, "3 rows of inputs and 2 of outputs"),
        (torch.tensor([[1.0], [float("nan")]]), torch.ones(2, 1), None, "missing or infinite"),
    ],
)
def test_what_cannot_be_fitted_is_said(inputs, outputs, prior, said):
    with pytest.raises(DataError, match=said):
        fit_fsvgd(inputs, outputs, torch.ones(4, 1), prior, UNIT, FsvgdSettings(steps=1))


def test_an_ensemble_refuses_rows_that_are_not_whole():
    x = torch.linspace(-1, 1, 20)[:, None]
    settings = FsvgdSettings(steps=5, hidden=(8,))
    with pytest.raises(DataError, match="missing or infinite"):
        deep_ensemble(x, torch.where(x > 0.9, torch.nan, x), UNIT, settings)
    with pytest.raises(DataError, match="each row needs both"):
        deep_ensemble(x, x[:10], UNIT, settings)
