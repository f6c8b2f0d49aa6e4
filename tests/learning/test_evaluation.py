"""Test figures of merit against scipy and Monte Carlo draws."""

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal, multivariate_t, norm
from scipy.stats import t as student

from learning.evaluation import (
    LEVELS,
    Mixture,
    calibration_error,
    negative_log_likelihood,
    root_mean_square_error,
)


def random(*shape, seed=0):
    return torch.tensor(np.random.default_rng(seed).normal(size=shape))


def test_joint_density_of_a_mixture_equals_scipy():
    prediction = Mixture(random(4, 5, 3), random(1, 1, 3, seed=1).exp())
    targets = random(5, 3, seed=2)
    densities = norm(prediction.means.numpy(), prediction.stds.numpy()).pdf(targets.numpy()).prod(axis=2)
    assert np.allclose(prediction.log_density(targets), np.log(densities.mean(axis=0)), atol=1e-12)
    assert negative_log_likelihood(prediction, targets) == pytest.approx(-np.log(densities.mean(axis=0)).mean())


def test_mean_and_std_of_a_mixture_equal_those_of_draws():
    prediction = Mixture(random(3, 2, 2), random(3, 1, 2, seed=1).exp())
    rng = np.random.default_rng(3)
    component = rng.integers(3, size=400_000)
    stds = prediction.stds.expand_as(prediction.means).numpy()
    draws = prediction.means.numpy()[component] + stds[component] * rng.normal(size=(len(component), 2, 2))
    assert np.allclose(prediction.mean, draws.mean(axis=0), atol=0.02)
    assert np.allclose(prediction.std, draws.std(axis=0), rtol=0.01)


class TestDecorrelatedErrors:
    """Mixtures with correlated errors of the outputs."""

    DECORRELATION = np.array([[1.7, 0.0, -0.2], [0.3, 1.0, 0.0], [0.0, 0.0, 2.0]])
    STDS = np.array([0.5, 1.0, 2.0])
    BACK = np.linalg.inv(DECORRELATION)
    SHAPE = BACK @ np.diag(STDS**2) @ BACK.T

    def mixture(self, dof=math.inf):
        return Mixture(random(4, 6, 3), torch.tensor(self.STDS)[None, None], dof, torch.tensor(self.DECORRELATION))

    @pytest.mark.parametrize("dof", [3.5, math.inf])
    def test_joint_density_equals_scipy(self, dof):
        mixture, targets = self.mixture(dof), 2.0 * random(6, 3, seed=1)
        distribution = multivariate_normal if math.isinf(dof) else partial(multivariate_t, df=dof)
        densities = [
            [distribution(m, self.SHAPE).pdf(y) for m, y in zip(k, targets.numpy(), strict=True)] for k in mixture.means
        ]
        assert np.allclose(mixture.log_density(targets), np.log(np.mean(densities, axis=0)), atol=1e-12)

    def test_marginal_scales_are_those_of_single_outputs(self):
        assert np.allclose(self.mixture().marginal_scales, np.sqrt(np.diag(self.SHAPE)))
        assert np.allclose(self.mixture().aleatoric_std, np.sqrt(np.diag(self.SHAPE)))

    def test_calibration_of_draws_is_good_with_decorrelation_only(self):
        draws = np.random.default_rng(5).multivariate_normal(np.zeros(3), self.SHAPE, 40_000)
        flat = Mixture(torch.zeros(1, 40_000, 3).double(), *self.mixture().stds.expand(1, 1, 1, 3), math.inf)
        flat = replace(flat, decorrelation=torch.tensor(self.DECORRELATION))
        assert calibration_error(flat, torch.tensor(draws)) < 0.005
        assert calibration_error(replace(flat, decorrelation=None), torch.tensor(draws)) > 0.05

    def test_smoothing_keeps_the_variance_of_decorrelated_errors(self):
        sharp = self.mixture()
        for mixture in (sharp, sharp.smoothed(0.6), sharp.gaussians()):
            decorrelated = mixture.means.numpy() @ self.DECORRELATION.T
            # The decorrelated errors are independent.
            variance = decorrelated.var(axis=0) + (mixture.stds.numpy() ** 2).mean(axis=0)
            exact = (sharp.means.numpy() @ self.DECORRELATION.T).var(axis=0) + self.STDS**2
            assert np.allclose(variance, exact)
            assert np.allclose(mixture.mean, sharp.mean)


def test_root_mean_square_error_sums_over_outputs():
    prediction = Mixture(torch.zeros(2, 4, 3), torch.ones(1, 1, 3))
    assert root_mean_square_error(prediction, torch.full((4, 3), 2.0)) == pytest.approx(np.sqrt(12.0))


@pytest.mark.parametrize(("factor", "min_error", "max_error"), [(1.0, 0.0, 0.01), (3.0, 0.15, 0.4), (1 / 3, 0.3, 0.8)])
def test_calibration_error_is_large_for_a_wrong_std(factor, min_error, max_error):
    truth = random(20_000, 2)
    error = calibration_error(Mixture(torch.zeros(1, 20_000, 2).double(), factor * torch.ones(1, 1, 2)), truth)
    assert min_error <= error <= max_error


def test_student_component_density_equals_multivariate_t():
    rng = np.random.default_rng(3)
    means, targets, stds = rng.normal(size=(4, 6, 3)), 5.0 * rng.normal(size=(6, 3)), np.array([0.5, 1.0, 2.0])
    found = Mixture(*(torch.from_numpy(v) for v in (means, stds[None, None])), 3.5).log_density(torch.tensor(targets))
    densities = [
        [multivariate_t(m, np.diag(stds**2), 3.5).pdf(y) for m, y in zip(component, targets, strict=True)]
        for component in means
    ]
    assert np.allclose(found, np.log(np.mean(densities, axis=0)), atol=1e-12)


@pytest.mark.parametrize(("dof", "factor"), [(2.5, 5.0), (4.0, 2.0), (np.inf, 1.0), (2.0, np.inf), (1.5, np.inf)])
def test_std_of_student_noise_exceeds_its_scale(dof, factor):
    mixture = Mixture(torch.tensor([[[1.0]], [[3.0]]]), torch.tensor([[[0.5]]]), dof)
    assert float(mixture.aleatoric_std) == pytest.approx(0.5 * np.sqrt(factor))
    assert float(mixture.std) == pytest.approx(np.sqrt(1.0 + 0.25 * factor))


def test_gaussians_approximate_a_student_mixture():
    mixture = Mixture(torch.tensor([[[-1.0]], [[2.0]]]).double().expand(2, 9, 1), torch.tensor([[[0.5]], [[1.5]]]), 4.0)
    query = torch.linspace(-6.0, 8.0, 9).double()[:, None]
    exact = [student(4.0, m, s).pdf(query[:, 0].numpy()) for m, s in ((-1.0, 0.5), (2.0, 1.5))]
    found = mixture.gaussians(200)
    assert found.means.shape == (400, 9, 1)
    assert math.isinf(found.dof)
    assert np.allclose(found.log_density(query), np.log(np.mean(exact, axis=0)), atol=0.05)
    sharp = Mixture(random(4, 5, 3), random(4, 1, 3, seed=1).exp())
    assert sharp.gaussians() is sharp


@pytest.mark.parametrize("bandwidth", [0.0, 0.4, 0.9, 1.0])
def test_smoothed_mixture_keeps_mean_and_variance(bandwidth):
    sharp = Mixture(random(4, 5, 3), random(4, 1, 3, seed=1).exp())
    found = sharp.smoothed(bandwidth)
    means, stds = found.means.numpy(), found.stds.expand_as(found.means).numpy()
    original_means, original_stds = sharp.means.numpy(), sharp.stds.expand_as(sharp.means).numpy()
    assert np.allclose(means.mean(axis=0), original_means.mean(axis=0), atol=1e-12)
    assert np.allclose(
        means.var(axis=0) + (stds**2).mean(axis=0), original_means.var(axis=0) + (original_stds**2).mean(axis=0)
    )
    assert np.allclose(means.std(axis=0), np.sqrt(1.0 - bandwidth**2) * original_means.std(axis=0), atol=1e-12)


def test_smoothing_by_one_gives_a_gaussian_and_by_zero_no_change():
    sharp = Mixture(random(4, 5, 3), random(1, 1, 3, seed=1).exp())
    targets = random(5, 3, seed=2)
    mean, variance = sharp.means.numpy().mean(axis=0), sharp.means.numpy().var(axis=0) + sharp.stds.numpy()[0] ** 2
    expected = norm(mean, np.sqrt(variance)).logpdf(targets.numpy()).sum(axis=1)
    assert np.allclose(sharp.smoothed(1.0).log_density(targets), expected, atol=1e-12)
    assert np.allclose(sharp.smoothed(0.0).log_density(targets), sharp.log_density(targets), atol=1e-12)


def test_smoothed_student_mixture_is_one_student_distribution():
    """Noise scale 0.3 and means with standard deviation 0.4 combine to scale 0.5."""
    means = torch.randn(400, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    means = 1.0 + 0.4 * (means - means.mean()) / means.std(correction=0)
    query = np.linspace(-4.0, 6.0, 21)
    found = Mixture(means[:, None, None].expand(-1, 21, 1), torch.tensor([[[0.3]]]).double(), 4.0).smoothed(1.0)
    expected = student(4.0, loc=1.0, scale=0.5).logpdf(query)
    assert np.allclose(found.log_density(torch.from_numpy(query)[:, None]), expected, atol=1e-6)


@pytest.mark.parametrize("dof", [2.5, 20.0])
def test_calibration_error_uses_student_quantiles(dof):
    draws = torch.tensor(student(dof).rvs((50_000, 2), random_state=2) * [0.5, 2.0])
    stds = torch.tensor([[[0.5, 2.0]]]).double()
    assert calibration_error(Mixture(torch.zeros(1, 50_000, 2).double(), stds, dof), draws) < 0.003
    assert calibration_error(Mixture(torch.zeros(1, 50_000, 2).double(), stds), draws) > (0.04 if dof < 3.0 else 0.004)


def test_calibration_error_uses_mixture_quantiles():
    """The reference values are quantiles of draws; a Gaussian with the same moments is not calibrated."""
    rng = np.random.default_rng(5)
    means, stds = np.array([[-3.0, 0.0], [2.0, 1.0], [2.5, 8.0]]), np.array([[0.3, 0.2], [1.0, 0.5], [0.2, 2.0]])
    targets = np.array([-1.0, 2.0]) + np.array([2.5, 3.0]) * rng.normal(size=(3000, 2))
    component = rng.integers(3, size=1_000_000)
    draws = means[component] + stds[component] * rng.normal(size=(len(component), 2))
    coverage_errors = []
    for level in LEVELS:
        low, high = np.quantile(draws, [0.5 - level / 2, 0.5 + level / 2], axis=0)
        coverage_errors.append(np.abs(((targets >= low) & (targets <= high)).mean(axis=0) - level))
    prediction = Mixture(torch.tensor(means)[:, None].expand(3, 3000, 2), torch.tensor(stds)[:, None])
    assert calibration_error(prediction, torch.tensor(targets)) == pytest.approx(np.mean(coverage_errors), abs=0.002)
    own_draws = torch.tensor(draws[:50_000])
    mixture = Mixture(torch.tensor(means)[:, None].expand(3, 50_000, 2), torch.tensor(stds)[:, None])
    assert calibration_error(mixture, own_draws) < 0.005
    gaussian = Mixture(mixture.mean[None], mixture.std[None])
    assert calibration_error(gaussian, own_draws) > 0.02
