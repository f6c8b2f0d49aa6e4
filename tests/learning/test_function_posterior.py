"""Test the posterior over functions of a linear simulator against Gaussian processes in numpy."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from gaussian_process_reference import discrepancy_alone, kernel, raw_noise, simulator_and_discrepancy
from linear_simulator import EMPTY, NOISE, UNITS, Linear, features, mean_and_scale, rows, tensors, truth
from scipy.stats import norm
from scipy.stats import t as student
from torch import Tensor

from learning.evaluation import negative_log_likelihood
from learning.posterior import discrepancy, inference
from learning.posterior.discrepancy import CHOLESKY_JITTER, PRIOR_DISCREPANCY_STD, PRIOR_LENGTHSCALE
from learning.posterior.inference import PARAMETER_DRAWS, infer

ALL_STEPS = discrepancy.STEPS


@pytest.fixture(autouse=True, scope="module")
def half_of_the_steps():
    """Most references use the fitted covariance, whether or not its fit has converged."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(discrepancy, "STEPS", ALL_STEPS // 2)
        yield


@pytest.fixture(scope="module")
def posterior(half_of_the_steps):
    """Infer a posterior without a simulator."""
    return infer(None, TestWithoutSimulator.x, TestWithoutSimulator.y, UNITS, NOISE)


class TestWithoutSimulator:
    """The reference is the exact Gaussian process with the fitted covariance."""

    x, y = rows(30)

    def test_predictions_equal_the_gaussian_process(self, posterior):
        query, _ = rows(1500, seed=1)
        mean, std = mean_and_scale(posterior.predict(query))
        exact_mean, exact, _ = discrepancy_alone(self.x, self.y, query, posterior.discrepancy, raw_noise(posterior))
        assert np.allclose(mean, exact_mean, atol=2e-5)
        assert np.allclose(std, exact, rtol=1e-5)

    def test_marginals_equal_the_gaussian_process(self, posterior):
        query, _ = rows(35, seed=2)
        means, covariances = posterior.marginals(query.view(7, 5, 2))
        units = UNITS.output_std.numpy()
        for k in range(7):
            mean, _, exact = discrepancy_alone(
                self.x, self.y, query[5 * k : 5 * k + 5], posterior.discrepancy, raw_noise(posterior)
            )
            assert np.allclose(means[k].numpy().T * units + UNITS.output_mean.numpy(), mean, atol=2e-5)
            assert np.allclose(covariances[k], exact / units[:, None, None] ** 2, atol=2e-5)

    def test_prediction_is_close_to_the_true_function_near_the_data(self, posterior):
        """The outputs have amplitudes of 2 and 0.6 and noise of 0.2 and 0.1."""
        query, _ = rows(200, seed=3)
        error = posterior.predict(query).mean.numpy() - truth(query)
        assert (np.sqrt((error**2).mean(axis=0)) < [0.4, 0.15]).all()


def errors_over_seeds(x, y, query, count, **settings):
    """Return errors of the mean (count, M, 2) in exact standard deviations, and variance ratios."""
    mean_errors, ratios = [], []
    for seed in range(count):
        posterior = infer(Linear(), x, y, UNITS, NOISE, seed=seed, **settings)
        mean, std = mean_and_scale(posterior.predict(query))
        exact_mean, exact, _ = simulator_and_discrepancy(
            x, y, query, posterior.discrepancy, raw_noise(posterior), posterior.parameters
        )
        variance, exact_variance = (v**2 - raw_noise(posterior) ** 2 for v in (std.double().numpy(), exact))
        mean_errors.append((mean.numpy() - exact_mean) / np.sqrt(exact_variance))
        ratios.append(variance / exact_variance)
    return np.stack(mean_errors), np.stack(ratios)


class TestWithSimulator:
    query, _ = rows(40, seed=1)

    @pytest.mark.parametrize(
        "settings",
        [{}, {"discrepancy_std": torch.tensor([0.1, 0.03])}, {"with_discrepancy": False, "noise_known": True}],
    )
    def test_posterior_equals_the_gaussian_process_of_simulator_and_discrepancy(self, settings):
        """Differences stay within the Monte Carlo error of 128 draws; the average of six seeds is closer."""
        mean_errors, ratios = errors_over_seeds(*rows(12), self.query, 6, **settings)
        assert np.abs(mean_errors).max() < 4.0 / math.sqrt(PARAMETER_DRAWS)
        assert np.abs(ratios - 1.0).max() < 4.5 * math.sqrt(2.0 / PARAMETER_DRAWS)
        assert np.abs(mean_errors.mean(axis=0)).max() < 2.0 / math.sqrt(PARAMETER_DRAWS)
        assert np.abs(ratios.mean(axis=0) - 1.0).max() < 2.0 * math.sqrt(2.0 / PARAMETER_DRAWS)

    def test_marginals_equal_the_gaussian_process_of_simulator_and_discrepancy(self):
        x, y = rows(12)
        posterior = infer(Linear(), x, y, UNITS, NOISE)
        means, covariances = posterior.marginals(self.query[:20].view(4, 5, 2))
        units = UNITS.output_std.numpy()
        for k in range(4):
            mean, _, exact = simulator_and_discrepancy(
                x, y, self.query[5 * k : 5 * k + 5], posterior.discrepancy, raw_noise(posterior), posterior.parameters
            )
            exact = exact / units[:, None, None] ** 2
            std = np.sqrt(exact.diagonal(axis1=1, axis2=2))
            assert (np.abs(means[k].numpy().T * units + UNITS.output_mean.numpy() - mean) / units < 0.35 * std.T).all()
            scaled = (covariances[k].numpy() - exact) / (std[:, :, None] * std[:, None, :])
            assert np.abs(scaled).max() < 0.5

    def test_known_noise_is_kept_without_discrepancy(self):
        posterior = infer(Linear(), *rows(12), UNITS, NOISE, with_discrepancy=False, noise_known=True)
        assert posterior.discrepancy is None
        assert np.allclose(raw_noise(posterior), NOISE)
        assert math.isinf(posterior.dof)

    def test_residual_of_the_best_parameters_is_noise_without_discrepancy(self):
        """The reference is the least-squares estimate, for data with and without a misspecified simulator."""
        x, wrong = rows(30)
        (right,) = tensors((features(x) @ np.array([0.8, -1.1, 0.4])).T)
        right += NOISE * torch.randn(right.shape, generator=torch.Generator().manual_seed(1))
        for y in (right, wrong):
            posterior = infer(Linear(), x, y, UNITS, NOISE, with_discrepancy=False)
            a, b = features(x).reshape(-1, 3), y.double().numpy().T.reshape(-1)
            residuals = (b - a @ np.linalg.lstsq(a, b, rcond=None)[0]).reshape(2, -1)
            expected_noise = np.sqrt((residuals**2).sum(axis=1) / (30 - 1.5))
            assert np.allclose(raw_noise(posterior), expected_noise, rtol=0.35)

    def test_all_of_700_rows_inform_the_parameters(self):
        """The posterior equals the conjugate one of all rows; one of fewer rows is wider."""
        x, _ = rows(700)
        rng = np.random.default_rng(6)
        shape = features(x)
        y = (shape @ np.array([0.8, -1.1, 0.4])).T + NOISE.numpy() * rng.normal(size=(700, 2))
        parameters = [
            infer(Linear(), x, *tensors(y), UNITS, NOISE, with_discrepancy=False, noise_known=True, seed=s).parameters
            for s in range(3)
        ]
        scaled = np.concatenate([shape[k] / NOISE.double().numpy()[k] for k in range(2)])
        scaled_outputs = np.concatenate([y[:, k] / NOISE.double().numpy()[k] for k in range(2)])
        covariance = np.linalg.inv(np.eye(3) + scaled.T @ scaled)
        draws = torch.cat(parameters).double().numpy()
        std = np.sqrt(np.diag(covariance))
        assert np.allclose(draws.std(axis=0), std, rtol=0.2)
        assert np.allclose((draws.mean(axis=0) - covariance @ scaled.T @ scaled_outputs) / std, 0.0, atol=0.3)

    def test_discrepancy_is_smaller_for_a_correct_simulator(self):
        """One data set comes from the simulator, the other from a function that it cannot represent."""
        x, wrong = rows(100)
        (right,) = tensors((features(x) @ np.array([0.8, -1.1, 0.4])).T)
        right += NOISE * torch.randn(right.shape, generator=torch.Generator().manual_seed(1))
        small, large = (
            infer(Linear(), x, y, UNITS, NOISE, restart_scales=(1.0,)).discrepancy.scales for y in (right, wrong)
        )
        assert (small < 0.7 * large).all()
        assert (small < PRIOR_DISCREPANCY_STD).all()


KNOWN = torch.tensor([[0.8, -1.1, 0.4]])


@dataclass(frozen=True)
class Known(Linear):
    """The same simulator with known parameters."""

    size: int = 0

    def __call__(self, inputs: Tensor, parameters: Tensor) -> Tensor:
        return super().__call__(inputs, KNOWN.to(inputs).expand(len(parameters), -1))


class TestWithKnownParameters:
    def test_posterior_equals_the_gaussian_process_of_the_residual(self):
        """One draw is enough, because all are equal."""
        x, y = rows(30)
        query, _ = rows(40, seed=1)
        posterior = infer(Known(), x, y, UNITS, NOISE)
        assert posterior.parameters.shape == (1, 0)
        mean, std = mean_and_scale(posterior.predict(query))
        simulated = {name: (features(v) @ KNOWN[0].double().numpy()).T for name, v in (("x", x), ("query", query))}
        between = [
            kernel(posterior.discrepancy, a, b, KNOWN) for a, b in ((x, x), (x, query), (query, query))
        ]  # fmt: skip
        for k, (noise, unit) in enumerate(zip(raw_noise(posterior), UNITS.output_std.double().numpy(), strict=True)):
            covariance = between[0][k] + (noise**2 + CHOLESKY_JITTER * unit**2) * np.eye(len(x))
            gain = np.linalg.solve(covariance, between[1][k]).T
            exact = simulated["query"][:, k] + gain @ (y.double().numpy() - simulated["x"])[:, k]
            variance = np.diag(between[2][k] - gain @ between[1][k]) + noise**2
            assert np.allclose(mean[:, k], exact, atol=2e-5)
            assert np.allclose(std[:, k], np.sqrt(variance), rtol=1e-4)

    def test_prior_without_rows_is_the_simulator_and_the_discrepancy(self):
        query, _ = rows(10, seed=1)
        posterior = infer(Known(), EMPTY, EMPTY, UNITS, NOISE)
        assert posterior.parameters.shape == (1, 0)
        assert np.allclose(posterior.predict(query).mean, (features(query) @ KNOWN[0].double().numpy()).T, atol=1e-5)


class TestWithoutRows:
    query, _ = rows(10, seed=1)

    @pytest.mark.parametrize("expected", [None, torch.tensor([0.3, 0.7])])
    def test_prior_has_the_moments_of_simulator_draws_and_prior_discrepancy(self, expected):
        posterior = infer(Linear(), EMPTY, EMPTY, UNITS, NOISE, discrepancy_std=expected)
        means, covariances = posterior.marginals(self.query.view(2, 5, 2))
        assert posterior.parameters.shape == (PARAMETER_DRAWS, 3)
        drawn = np.einsum("onk,pk->pon", features(self.query), posterior.parameters.double().numpy())
        drawn = (drawn - UNITS.output_mean.numpy()[:, None]) / UNITS.output_std.numpy()[:, None]
        size = [PRIOR_DISCREPANCY_STD] * 2 if expected is None else (expected / UNITS.output_std).tolist()
        x = (self.query.double().numpy() - UNITS.input_mean.numpy()) / UNITS.input_std.numpy()
        distance = ((x[:, None] - x[None]) ** 2).sum(axis=2)
        for k in range(2):
            kernel, mean = np.exp(-0.5 * distance / PRIOR_LENGTHSCALE**2), drawn[:, k].mean(axis=0)
            of_discrepancy = size[k] ** 2 * (kernel + x @ x.T / 2 + 1.0 + mean[:, None] * mean * kernel)
            exact = np.cov(drawn[:, k].T, bias=True) + of_discrepancy
            assert np.allclose(means[:, k].flatten(), drawn[:, k].mean(axis=0), atol=1e-5)
            for b in range(2):
                block = slice(5 * b, 5 * b + 5)
                assert np.allclose(covariances[b, k], exact[block, block], atol=1e-4)

    def test_parameter_draws_have_the_prior_distribution(self):
        mean, std = mean_and_scale(
            infer(Linear(), EMPTY, EMPTY, UNITS, NOISE, with_discrepancy=False).predict(self.query)
        )
        exact = np.sqrt((features(self.query) ** 2).sum(axis=2).T + NOISE.numpy() ** 2)
        assert np.abs(mean.numpy() / exact).max() < 4.0 / math.sqrt(PARAMETER_DRAWS)
        assert np.allclose(std, exact, rtol=4.0 / math.sqrt(2.0 * PARAMETER_DRAWS))


class TestOutliers:
    """Four rows of a hundred have errors of about 30 or 300 times the noise."""

    noise = torch.tensor([0.1, 0.05])
    x, y = rows(100, noise=noise)
    query, _ = rows(200, seed=5)

    def with_outliers(self, size):
        errors = torch.tensor([[1.0, 0.3], [-1.0, 0.25], [1.2, -0.25], [0.9, -0.3]])
        return self.y.index_add(0, torch.tensor([3, 30, 60, 90]), size * errors)

    @staticmethod
    @functools.cache
    def clean(model):
        """Infer the posterior without outliers."""
        return infer(model, TestOutliers.x, TestOutliers.y, UNITS, TestOutliers.noise)

    def error(self, mean):
        return np.sqrt(((np.asarray(mean) - truth(self.query)) ** 2).mean(axis=0))

    @pytest.mark.parametrize("model", [None, pytest.param(Linear(), marks=pytest.mark.slow)])
    @pytest.mark.parametrize("size", [3.0, 30.0])
    def test_outliers_hardly_change_the_prediction(self, monkeypatch, model, size):
        """A Gaussian process with the same covariance and Gaussian noise follows the outliers."""
        monkeypatch.setattr(discrepancy, "STEPS", ALL_STEPS)
        y = self.with_outliers(size)
        posterior, clean = infer(model, self.x, y, UNITS, self.noise), self.clean(model)
        robust_error = self.error(posterior.predict(self.query).mean)
        assert (robust_error < self.error(clean.predict(self.query).mean) + 0.2 * self.noise.numpy()).all()
        assert posterior.dof < 10.0
        assert np.allclose(raw_noise(posterior), self.noise, rtol=0.5)
        gaussian_process = simulator_and_discrepancy if model else discrepancy_alone
        gaussian_mean = gaussian_process(self.x, y, self.query, posterior.discrepancy, raw_noise(posterior))[0]
        assert (self.error(gaussian_mean) > 3.0 * robust_error).all()

    def test_weights_stay_gaussian_with_fewer_than_40_rows(self):
        posterior, clean = (
            infer(None, self.x[:39], v[:39], UNITS, self.noise) for v in (self.with_outliers(3.0), self.y)
        )
        assert posterior.dof == clean.dof


class TestCorrelatedErrors:
    """The measurement errors of the two outputs are correlated."""

    def correlated_rows(self, count, seed, correlation):
        rng = np.random.default_rng(seed)
        x = np.stack([rng.uniform(-3, 4, count), rng.uniform(-2, 0, count)], axis=1)
        first, second = rng.normal(size=(2, count))
        second = correlation * first + math.sqrt(1.0 - correlation**2) * second
        return tensors(x, truth(x) + 2.0 * NOISE.numpy() * np.stack([first, second], axis=1))

    def density_gain(self, monkeypatch, model, correlation, count=300):
        """Return the gain of held-out log density per row [nats] by the correlation, and the prediction."""
        x, y = self.correlated_rows(count, 0, correlation)
        posterior = infer(model, x, y, UNITS, 2.0 * NOISE)
        monkeypatch.setattr(inference, "output_correlation", lambda w: (torch.eye(2).double(), torch.ones(2)))
        independent_model = infer(model, x, y, UNITS, 2.0 * NOISE)
        query, outputs = self.correlated_rows(500, 1, correlation)
        joint, independent = (
            float(f.predict(query).log_density(outputs).mean()) for f in (posterior, independent_model)
        )
        return joint - independent, posterior.predict(query)

    @pytest.mark.slow
    @pytest.mark.parametrize("count", [300, 600])
    def test_held_out_density_gains_the_mutual_information_of_the_outputs(self, monkeypatch, count):
        """The mutual information of two Gaussians is ``-log(1 - r^2) / 2``; function uncertainty reduces the gain.

        The counts are the batch size of the optimiser and twice that.
        """
        monkeypatch.setattr(discrepancy, "STEPS", ALL_STEPS)
        correlation = 0.98
        mutual_information = -0.5 * math.log(1.0 - correlation**2)
        gain, prediction = self.density_gain(monkeypatch, Linear(), correlation, count)
        assert 0.7 * mutual_information < gain < 1.1 * mutual_information
        back = np.linalg.inv(prediction.decorrelation.double().numpy())
        scale = prediction.stds[0].median(dim=0).values.double().numpy()
        shape = back @ (scale[:, None] * prediction.correlation.double().numpy() * scale) @ back.T
        assert shape[0, 1] / np.sqrt(shape[0, 0] * shape[1, 1]) == pytest.approx(correlation, abs=0.03)

    @pytest.mark.slow
    def test_correlation_estimate_costs_little_density_for_independent_errors(self, monkeypatch):
        gain, _ = self.density_gain(monkeypatch, None, 0.0)
        assert abs(gain) < 0.03


class TestRestarts:
    """The evidence has several optima; the leave-one-out density selects one."""

    @pytest.mark.parametrize(
        ("model", "expected"),
        [
            pytest.param(None, 0.01, marks=pytest.mark.slow),
            (None, PRIOR_DISCREPANCY_STD),
            pytest.param(Linear(), PRIOR_DISCREPANCY_STD, marks=pytest.mark.slow),
        ],
        ids=str,
    )
    def test_restarts_raise_the_held_out_density(self, model, expected):
        """The average gain over three data sets is clear and no data set loses."""
        gains = []
        for seed in range(3):
            query, y = rows(300, 100 + seed)
            options = {"discrepancy_std": expected * UNITS.output_std, "seed": seed}
            single, restarted = (
                infer(model, *rows(60, seed), UNITS, NOISE, **options, **restart_scales)
                for restart_scales in ({"restart_scales": (1.0,)}, {})
            )
            before, after = (negative_log_likelihood(posterior.predict(query), y) for posterior in (single, restarted))
            gains.append(before - after)
        assert min(gains) > -0.02
        assert np.mean(gains) > 0.3

    def test_restart_without_a_computable_covariance_is_skipped(self):
        x, y = rows(50)
        query, _ = rows(5, seed=1)
        first, both = (
            infer(None, x, y, UNITS, NOISE, restart_scales=s).predict(query) for s in ((1.0,), (1.0, math.nan))
        )
        assert torch.equal(first.mean, both.mean)
        assert torch.equal(first.stds, both.stds)


class TestFewRows:
    """A covariance fitted to few rows is uncertain."""

    def test_predictions_have_heavy_tails_where_the_covariance_is_fitted(self):
        x, y = rows(15)
        assert infer(None, x, y, UNITS, NOISE).dof < 10.0
        assert infer(Linear(), x, y, UNITS, NOISE, with_discrepancy=False).dof < 10.0
        assert math.isinf(infer(Linear(), x, y, UNITS, NOISE, with_discrepancy=False, noise_known=True).dof)
        assert math.isinf(infer(Linear(), EMPTY, EMPTY, UNITS, NOISE).dof)

    def test_heavy_tails_raise_the_held_out_density_of_few_rows(self):
        """scipy computes marginal densities for eight data sets of twelve rows."""
        gains = []
        for seed in range(8):
            posterior = infer(None, *rows(12, seed), UNITS, NOISE, seed=seed)
            x, y = rows(200, 100 + seed)
            mean, std = (v.double().numpy() for v in mean_and_scale(posterior.predict(x)))
            standardised = (y.double().numpy() - mean) / std
            gains.append((student(posterior.dof).logpdf(standardised) - norm.logpdf(standardised)).mean())
        assert np.mean(gains) > 0.02


def test_equal_seeds_give_equal_predictions():
    query, _ = rows(5, seed=1)
    first, second, other = (infer(Linear(), *rows(8), UNITS, NOISE, seed=s).predict(query) for s in (2, 2, 3))
    assert torch.equal(first.mean, second.mean)
    assert torch.equal(first.stds, second.stds)
    assert not torch.equal(first.mean, other.mean)


def test_rows_beyond_the_maximum_are_subsampled(monkeypatch):
    monkeypatch.setattr(inference, "MAX_ROWS", 25)
    x, y = rows(60)
    posterior = infer(None, x, y, UNITS, NOISE)
    all_inputs = UNITS.inputs(x).double()
    subset = [int((all_inputs == row).all(dim=1).nonzero().item()) for row in posterior.inputs]
    assert len(set(subset)) == 25
    query, _ = rows(10, seed=1)
    exact_mean, _, _ = discrepancy_alone(x[subset], y[subset], query, posterior.discrepancy, raw_noise(posterior))
    assert np.allclose(posterior.predict(query).mean, exact_mean, atol=2e-5)
