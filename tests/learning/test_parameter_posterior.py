"""Test posterior draws of simulator parameters against conjugate posteriors and quadrature."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from torch import Tensor

from carlab.core.errors import DataError
from learning.networks.normaliser import Normaliser
from learning.posterior import parameter_posterior
from learning.posterior.parameter_posterior import posterior_parameters
from learning.priors.domain_models import uniform
from tests.helpers.seeded import generator

PRIOR_MEAN, PRIOR_STD = torch.tensor([1.0, -0.5, 0.2]), torch.tensor([0.5, 2.0, 1.0])


def features(x):
    """Return the features of two outputs in numpy (O, N, 3)."""
    x = np.asarray(x)[:, 0]
    return np.stack([np.stack([x, np.ones_like(x), x**2], axis=1), np.stack([np.sin(x), x, 0 * x], axis=1)])


@dataclass(frozen=True)
class Linear:
    """Simulator with two outputs, linear in three independent normal parameters."""

    size: int = 3

    def inputs(self, count: int, generator: torch.Generator) -> Tensor:
        return uniform(((-2.0, 2.0),), count, generator)

    def parameters(self, normal: Tensor) -> Tensor:
        return PRIOR_MEAN.to(normal) + PRIOR_STD.to(normal) * normal

    def __call__(self, inputs: Tensor, parameters: Tensor) -> Tensor:
        return torch.einsum("onk,pk->pno", torch.tensor(features(inputs)).to(parameters), parameters)


@dataclass(frozen=True)
class ConstantOutput:
    """Simulator whose output is a function of one standard normal parameter, constant in the input."""

    shape: Callable[[Tensor], Tensor]
    size: int = 1

    def inputs(self, count: int, generator: torch.Generator) -> Tensor:
        return torch.zeros(count, 1)

    def parameters(self, normal: Tensor) -> Tensor:
        return normal

    def __call__(self, inputs: Tensor, parameters: Tensor) -> Tensor:
        return self.shape(parameters)[:, :, None].expand(-1, len(inputs), 1)


UNITS = Normaliser(torch.zeros(1), torch.ones(1), torch.tensor([0.5, -1.0]), torch.tensor([2.0, 0.5]))
PLAIN = Normaliser(torch.zeros(1), torch.ones(1), torch.zeros(1), torch.ones(1))


def conjugate(x, y, covariance):
    """Return posterior mean and covariance of the linear model; ``covariance`` (O, n, n) is in normalised outputs."""
    prior = np.diag(1.0 / PRIOR_STD.double().numpy() ** 2)
    precision, weighted = prior, prior @ PRIOR_MEAN.double().numpy()
    for k, std in enumerate(UNITS.output_std.double().numpy()):
        at = features(x.double())[k]
        solved = np.linalg.solve(std**2 * covariance[k], np.column_stack([at, y[:, k].double().numpy()]))
        precision, weighted = precision + at.T @ solved[:, :3], weighted + at.T @ solved[:, 3]
    found = np.linalg.inv(precision)
    return found @ weighted, found


def linear_data(rows, noise, seed=0):
    """Return rows of the linear model with correlated errors, and the error covariance in normalised outputs."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(-2, 2, (rows, 1))
    smooth = noise**2 * np.exp(-0.5 * (x - x.T) ** 2)
    covariance = np.stack([smooth, 4.0 * smooth]) + noise**2 * np.eye(rows)
    errors = [np.linalg.cholesky(c) @ rng.normal(size=rows) for c in covariance]
    truth = features(x) @ np.array([1.3, 1.0, -0.4])
    y = truth.T + np.stack(errors, axis=1) * UNITS.output_std.numpy()
    return torch.tensor(x).float(), torch.tensor(y).float(), covariance


@pytest.mark.parametrize(("rows", "noise"), [(1, 0.5), (6, 0.3), (60, 0.1), (100, 0.003)])
def test_linear_simulator_has_the_conjugate_posterior(rows, noise):
    """The cases range from one row to parameters known to a thousandth of the prior width."""
    x, y, covariance = linear_data(rows, noise)
    factor = torch.linalg.cholesky(torch.tensor(covariance))
    draws = posterior_parameters(Linear(), x, y, factor, UNITS, 2000, generator()).double().numpy()
    mean, exact = conjugate(x, y, covariance)
    root = np.linalg.cholesky(exact)
    # In these units the posterior is standard normal; the mean of 2000 draws has an error of 0.02.
    white = np.linalg.solve(root, (draws - mean).T)
    assert np.allclose(white.mean(axis=1), 0.0, atol=0.1)
    assert np.allclose(np.cov(white), np.eye(3), atol=0.15)


def test_tempering_ends_at_the_posterior_however_many_steps_it_takes(monkeypatch, caplog):
    """With this effective sample size it takes more than 60 steps, at which the draws are 2.5 times too wide."""
    monkeypatch.setattr(parameter_posterior, "MIN_EFFECTIVE_SHARE", 0.95)
    x, y, covariance = linear_data(100, 0.003)
    factor = torch.linalg.cholesky(torch.tensor(covariance))
    draws = posterior_parameters(Linear(), x, y, factor, UNITS, 500, generator()).double().numpy()
    mean, exact = conjugate(x, y, covariance)
    white = np.linalg.solve(np.linalg.cholesky(exact), (draws - mean).T)
    assert np.allclose(np.cov(white), np.eye(3), atol=0.3)
    assert not caplog.records
    monkeypatch.setattr(parameter_posterior, "MAX_TEMPERING_STEPS", 60)
    posterior_parameters(Linear(), x, y, factor, UNITS, 500, generator())
    (warning,) = caplog.messages
    assert "is too wide: after 60 tempering steps" in warning


def test_draws_are_mostly_distinct():
    x, y, covariance = linear_data(60, 0.1)
    draws = posterior_parameters(
        Linear(), x, y, torch.linalg.cholesky(torch.tensor(covariance)), UNITS, 128, generator()
    )
    assert draws.shape == (128, 3)
    assert len(torch.unique(draws, dim=0)) > 115


def test_draws_without_data_have_the_prior_distribution():
    empty_factor = torch.zeros((2, 0, 0), dtype=torch.float64)
    draws = posterior_parameters(Linear(), torch.zeros(0, 1), torch.zeros(0, 2), empty_factor, UNITS, 4000, generator())
    assert draws.dtype == torch.float32
    assert torch.allclose(draws.mean(dim=0), PRIOR_MEAN, atol=0.1)
    assert torch.allclose(torch.cov(draws.T), torch.diag(PRIOR_STD**2), atol=0.15)


def draws_of_one_parameter(shape, observed, noise, count=2000):
    """Draw the parameter (count,) of a constant output given ``observed`` values."""
    y = torch.tensor(observed)[:, None]
    factor = noise * torch.eye(len(y), dtype=torch.float64)[None]
    found = posterior_parameters(ConstantOutput(shape), torch.zeros(len(y), 1), y, factor, PLAIN, count, generator(1))
    return found[:, 0].double().numpy()


def posterior_by_quadrature(log_likelihood):
    """Return grid points and weights of the posterior with a standard normal prior."""
    grid = np.linspace(-6.0, 6.0, 24_001)
    with np.errstate(invalid="ignore"):
        logs = np.nan_to_num(log_likelihood(grid), nan=-np.inf) - 0.5 * grid**2
    weight = np.exp(logs - logs.max())
    return grid, weight / weight.sum()


def test_both_modes_of_a_bimodal_posterior_are_sampled():
    """The narrow mode fits better; the wide mode dominates at first during tempering."""

    def shape(t):
        return torch.where(t < 0.3, (t - 0.3) ** 2, ((t - 0.3) ** 2).clamp_max(1.3))

    observed = [1.4, 1.45, 1.45, 1.5]
    draws = draws_of_one_parameter(shape, observed, 0.15)
    grid, weight = posterior_by_quadrature(
        lambda t: -0.5 * sum((s - shape(torch.tensor(t)).numpy()) ** 2 for s in observed) / 0.15**2
    )
    below = grid < 0.3
    assert 0.3 < weight[below].sum() < 0.7
    assert (draws < 0.3).mean() == pytest.approx(weight[below].sum(), abs=0.06)
    for side, part in ((below, draws[draws < 0.3]), (~below, draws[draws >= 0.3])):
        mean = (weight * grid)[side].sum() / weight[side].sum()
        std = np.sqrt((weight * (grid - mean) ** 2)[side].sum() / weight[side].sum())
        assert part.mean() == pytest.approx(mean, abs=0.2 * std)
        assert part.std() == pytest.approx(std, rel=0.15)


@pytest.mark.parametrize("broken", [float("nan"), float("inf")])
def test_draws_avoid_parameters_with_invalid_outputs(broken):
    """Three quarters of the prior mass give invalid outputs."""

    def shape(t):
        return torch.where(t > 0.7, t, torch.full_like(t, broken))

    draws = draws_of_one_parameter(shape, [0.5], 0.5)
    grid, weight = posterior_by_quadrature(lambda t: np.where(t > 0.7, -0.5 * ((0.5 - t) / 0.5) ** 2, np.nan))
    mean = (weight * grid).sum()
    std = np.sqrt((weight * (grid - mean) ** 2).sum())
    assert draws.min() > 0.7
    assert draws.mean() == pytest.approx(mean, abs=0.15 * std)
    assert draws.std() == pytest.approx(std, rel=0.1)


def test_one_draw_with_valid_outputs_suffices():
    """Only 0.8 % of the prior mass give valid outputs; with this seed it is one of 128 draws."""

    def shape(t):
        return torch.where(t > 2.4, t, torch.full_like(t, torch.nan))

    draws = draws_of_one_parameter(shape, [2.6], 0.5, count=128)
    grid, weight = posterior_by_quadrature(lambda t: np.where(t > 2.4, -0.5 * ((2.6 - t) / 0.5) ** 2, np.nan))
    assert draws.min() > 2.4
    assert draws.mean() == pytest.approx((weight * grid).sum(), abs=0.06)


def test_simulator_with_invalid_outputs_everywhere_is_refused():
    with pytest.raises(DataError, match="narrow the ranges"):
        draws_of_one_parameter(lambda t: torch.full_like(t, float("nan")), [0.5], 0.5)


def test_equal_seeds_give_equal_draws():
    x, y, covariance = linear_data(6, 0.3)
    factor = torch.linalg.cholesky(torch.tensor(covariance))
    first, second, other = (
        posterior_parameters(Linear(), x, y, factor, UNITS, 64, generator(seed)) for seed in (3, 3, 4)
    )
    assert torch.equal(first, second)
    assert not torch.equal(first, other)
