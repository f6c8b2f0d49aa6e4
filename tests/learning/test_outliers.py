"""Test robust statistics against refits without each row and scipy's Student-t distributions."""

import math

import numpy as np
import pytest
import torch
from linear_simulator import UNITS
from scipy.stats import multivariate_normal, multivariate_t, norm
from scipy.stats import t as student

from learning.outliers import (
    LOG_MEDIAN_VARIANCE,
    SCALE_LOG_STD,
    SCALE_RANGE,
    decorrelation_of,
    leave_one_out,
    leave_one_out_log_density,
    log_student,
    median_scale,
    output_correlation,
    student_weights,
    tail_scales,
)


def discrepancy(n, seed=0):
    """Covariances (2, n, n) of smooth functions at random places."""
    x = np.random.default_rng(seed).uniform(-2, 2, n)
    shape = np.exp(-0.5 * (x[:, None] - x) ** 2)
    return np.stack([shape, 0.3 * shape**4])


@pytest.mark.parametrize("equal_weights", [True, False])
def test_leave_one_out_errors_equal_a_fit_without_the_row(equal_weights):
    """The other rows keep their weights; the left-out row has the noise of weight 1."""
    n, noise = 12, np.array([0.2, 0.5])
    rng = np.random.default_rng(1)
    row_weights = np.ones(n) if equal_weights else rng.uniform(0.05, 1.0, n)
    known, residuals = discrepancy(n), rng.normal(size=(n, 2))
    covariance = known + np.stack([np.diag(s**2 / row_weights) for s in noise])
    white, variance_of_row = leave_one_out(*(torch.tensor(v) for v in (residuals, covariance, noise, row_weights)))
    assert white.shape == variance_of_row.shape == (n, 2)
    for k in range(2):
        for row in range(n):
            others = np.arange(n) != row
            gain = np.linalg.solve(covariance[k][np.ix_(others, others)], known[k][others, row])
            variance = known[k][row, row] - gain @ known[k][others, row] + noise[k] ** 2
            assert float(variance_of_row[row, k]) == pytest.approx(variance, rel=1e-9)
            error = residuals[row, k] - gain @ residuals[others, k]
            assert float(white[row, k]) == pytest.approx(error / np.sqrt(variance))


@pytest.mark.parametrize(("dof", "tolerance"), [(4.0, 0.02), (math.inf, 0.05)])
def test_leave_one_out_density_is_close_to_the_true_density(dof, tolerance):
    """The density uses fitted correlation, scales and degrees of freedom; scipy uses the true ones.

    Robust scales are too small for Gaussian errors, so that the fitted tails are slightly too heavy.
    """
    shape = np.array([[1.0, 0.8, 0.0], [0.8, 1.0, 0.0], [0.0, 0.0, 1.0]])
    size = np.array([0.5, 2.0, 1.0])
    rng = np.random.default_rng(5)
    true = multivariate_t(np.zeros(3), size[:, None] * shape * size, df=dof)
    drawn, variance_of_row = true.rvs(4000, random_state=rng), rng.uniform(0.1, 10.0, (4000, 3))
    expected = true.logpdf(drawn) - 0.5 * np.log(variance_of_row).sum(axis=1)
    found = leave_one_out_log_density(torch.tensor(drawn), torch.tensor(variance_of_row)).numpy()
    assert found.mean() == pytest.approx(expected.mean(), abs=tolerance)
    assert np.corrcoef(found, expected)[0, 1] > 0.99


class TestCorrelation:
    TRUE = np.array([[1.0, 0.9, 0.0], [0.9, 1.0, -0.3], [0.0, -0.3, 1.0]])
    SIZE = np.array([0.5, 2.0, 1.0])

    def drawn(self, rows, dof):
        """Draw rows of a multivariate Student-t distribution."""
        draws = multivariate_t(np.zeros(3), self.TRUE, df=dof).rvs(rows, random_state=3)
        return torch.tensor(draws * self.SIZE)

    @pytest.mark.parametrize("dof", [2.5, 5.0, 500.0])
    def test_correlation_is_estimated_for_any_degrees_of_freedom(self, dof):
        assert np.allclose(output_correlation(self.drawn(20_000, dof))[0], self.TRUE, atol=0.02)

    def test_correlation_is_robust_to_one_percent_of_outliers(self):
        white = self.drawn(2000, 500.0)
        white[:20] = torch.tensor([50.0, -200.0, 100.0])
        assert np.allclose(output_correlation(white)[0], self.TRUE, atol=0.08)
        assert np.corrcoef(white.numpy().T)[0, 1] < -0.5

    def test_independent_errors_get_almost_no_correlation(self):
        """By chance one pair of eighty exceeds two and a half standard errors."""
        independent = torch.tensor(np.random.default_rng(6).normal(size=(50, 80, 6)))
        pairs = sum(int((output_correlation(white)[0] != 0).sum()) - 6 for white in independent) / 2
        assert pairs < 0.03 * 50 * 15

    @pytest.mark.parametrize("rows", [1, 2, 5])
    def test_correlation_is_zero_with_few_rows(self, rows):
        assert torch.equal(output_correlation(torch.ones(rows, 3).double())[0], torch.eye(3).double())

    def test_correlation_is_zero_for_zero_errors(self):
        assert torch.equal(output_correlation(torch.zeros(50, 3).double())[0], torch.eye(3).double())

    def test_correlation_is_positive_definite_after_dropping_weak_pairs(self):
        """Dropping the weak pair, insignificant with 200 rows, would make the matrix indefinite."""
        chain = np.array([[1.0, 0.75, 0.14], [0.75, 1.0, 0.75], [0.14, 0.75, 1.0]])
        draws = np.random.default_rng(7).normal(size=(200, 3))
        draws = np.linalg.solve(np.linalg.cholesky(np.cov(draws.T)), draws.T).T @ np.linalg.cholesky(chain).T
        found, _ = output_correlation(torch.tensor(draws))
        assert torch.linalg.eigvalsh(found).min() > 0.0
        assert np.allclose(found, chain, atol=0.1)

    def test_decorrelated_errors_keep_their_variances(self):
        size = torch.tensor(self.SIZE)
        decorrelation = decorrelation_of(torch.tensor(self.TRUE), size).numpy()
        shape = self.SIZE[:, None] * self.TRUE * self.SIZE
        assert np.allclose(decorrelation @ shape @ decorrelation.T, np.diag(self.SIZE**2), atol=1e-12)
        # The output with the largest error stays unchanged.
        assert np.allclose(decorrelation[1], [0.0, 1.0, 0.0])


@pytest.mark.parametrize("dof", [2.5, 6.0, 20.0])
@pytest.mark.parametrize("outputs", [1, 3])
def test_density_equals_scipys_multivariate_t(outputs, dof):
    draws = 3.0 * np.random.default_rng(2).normal(size=(9, outputs))
    expected = multivariate_t(np.zeros(outputs), np.eye(outputs), df=dof).logpdf(draws)
    found = log_student(torch.tensor((draws**2).sum(axis=1)), outputs, dof)
    assert np.allclose(found, expected, atol=1e-12)


def test_density_is_gaussian_for_infinite_degrees_of_freedom():
    draws = 3.0 * np.random.default_rng(2).normal(size=(9, 3))
    found = log_student(torch.tensor((draws**2).sum(axis=1)), 3, math.inf)
    assert np.allclose(found, norm.logpdf(draws).sum(axis=1), atol=1e-12)


class TestWeights:
    def test_gaussian_errors_have_weight_one(self):
        draws = np.random.default_rng(3).normal(size=(2000, 3))
        dof, weights = student_weights(torch.tensor((draws**2).sum(axis=1)), 3)
        assert dof == math.inf
        assert torch.equal(weights, torch.ones(2000, dtype=torch.float64))

    @pytest.mark.parametrize("true", [3.0, 6.0])
    def test_degrees_of_freedom_of_student_errors_are_estimated(self, true):
        draws = multivariate_t(np.zeros(3), np.eye(3), df=true).rvs(2000, random_state=4)
        dof, _ = student_weights(torch.tensor((draws**2).sum(axis=1)), 3)
        assert 0.6 * true < dof < 1.7 * true

    def test_weight_falls_with_the_mahalanobis_distance(self):
        draws = multivariate_t(np.zeros(3), np.eye(3), df=3.0).rvs(300, random_state=5)
        draws[:5] += 100.0
        square = torch.tensor((draws**2).sum(axis=1))
        dof, weights = student_weights(square, 3)
        assert dof <= 3.0
        assert set(weights.argsort()[:5].tolist()) == set(range(5))
        assert float(weights[:5].max()) < 0.001
        assert float(weights.max()) == 1.0
        far = square > 3.0
        assert torch.allclose(weights[far], (dof + 3.0) / (dof + square[far]))
        assert (weights[~far] == 1.0).all()


class TestTails:
    @pytest.mark.parametrize("dof", [2.5, 4.0, 20.0])
    def test_equal_mixture_of_tail_scales_approximates_a_student_distribution(self, dof):
        scales = tail_scales(dof, 200).double().numpy()
        at = np.array([-8.0, -3.0, -1.0, 0.0, 0.5, 2.0, 5.0])
        mixture = norm.cdf(at[:, None] / scales).mean(axis=1)
        assert np.allclose(mixture, student.cdf(at, dof), atol=0.002)

    def test_tail_scales_of_a_gaussian_are_one(self):
        assert torch.equal(tail_scales(math.inf, 7), torch.ones(7))


class TestMedianScale:
    def test_half_of_the_rows_lie_within_the_corrected_quartiles(self):
        """PosteriorSampler of a Student-t distribution whose assumed scales are too small by 1.5 and too large by 2."""
        draws = student(4.0).rvs((20_001, 2), random_state=6) * np.array([1.5, 0.5])
        found = median_scale(torch.tensor(draws**2), 4.0)
        assert np.allclose(found, [1.5, 0.5], rtol=0.03)
        within = np.abs(draws) <= self.unshrunk(found.numpy(), 20_001) * student.ppf(0.75, 4.0)
        assert np.allclose(within.mean(axis=0), 0.5, atol=1e-4)

    @staticmethod
    def unshrunk(found, rows):
        """Undo the shrinkage of a normal prior and a normal median on the logarithmic scale."""
        return found ** (1.0 + LOG_MEDIAN_VARIANCE / rows / SCALE_LOG_STD**2)

    def test_variance_of_the_log_median_equals_its_asymptotic_formula(self):
        """The asymptotic variance of a sample median follows from the half-normal density at its median."""
        median = norm.ppf(0.75)
        assert 1.0 / (4.0 * (2.0 * norm.pdf(median)) ** 2 * median**2) == pytest.approx(LOG_MEDIAN_VARIANCE, rel=1e-3)

    def test_shrinkage_is_calibrated_with_few_rows(self):
        """With scales wrong by a tenth, the regression of the truth on the estimate from 51 rows has slope one."""
        rng = np.random.default_rng(8)
        truth = 0.1 * rng.normal(size=4000)
        draws = np.exp(truth) * rng.normal(size=(51, 4000))
        found = np.log(median_scale(torch.tensor(draws**2), math.inf).numpy())
        assert np.polyfit(found, truth, 1)[0] == pytest.approx(1.0, abs=0.1)
        unshrunk = np.log(np.median(np.abs(draws), axis=0) / norm.ppf(0.75))
        assert ((found - truth) ** 2).mean() < 0.4 * ((unshrunk - truth) ** 2).mean()

    def test_median_scale_is_robust_to_two_percent_of_outliers(self):
        draws = np.random.default_rng(7).normal(size=(1001, 1))
        draws[:20] = 1e4
        assert float(median_scale(torch.tensor(draws**2), math.inf)) == pytest.approx(1.0, rel=0.1)

    def test_median_scale_stays_within_its_range(self):
        found = median_scale(torch.tensor([[1e-9, 1e9]] * 500, dtype=torch.float64), 4.0)
        assert np.allclose(self.unshrunk(found.numpy(), 500), SCALE_RANGE, rtol=1e-6, atol=0.0)


def test_densities_of_decorrelated_outputs_differ_by_the_log_determinant():
    """The reference is scipy's density of normal errors before and after two transformations."""
    rng = np.random.default_rng(4)
    first, second, root = rng.normal(size=(3, 2, 2))
    units = UNITS.decorrelated(torch.tensor(first)).decorrelated(torch.tensor(second))
    decorrelation, spread = second @ first, root @ root.T + np.eye(2)
    errors = rng.normal(size=(5, 2))
    joint = multivariate_normal(cov=spread).logpdf(errors)
    decorrelated = multivariate_normal(cov=decorrelation @ spread @ decorrelation.T).logpdf(errors @ decorrelation.T)
    assert np.allclose(decorrelated + units.decorrelation_log_det, joint)
    assert UNITS.decorrelation_log_det == 0.0
