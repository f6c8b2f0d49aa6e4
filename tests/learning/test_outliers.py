"""Outliers: leaving rows out by hand, and Student distributions by scipy."""

import math

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_t, norm
from scipy.stats import t as student

from learning.outliers import (
    SCALES,
    VARIANCE_OF_MEDIAN,
    WIDTH_DOUBT,
    left_out,
    log_student,
    student_weights,
    tail_scales,
    typical_scale,
)


def gap(n, seed=0):
    """Covariances (2, n, n) of smooth functions at random places."""
    x = np.random.default_rng(seed).uniform(-2, 2, n)
    shape = np.exp(-0.5 * (x[:, None] - x) ** 2)
    return np.stack([shape, 0.3 * shape**4])


@pytest.mark.parametrize("trusted", [True, False])
def test_a_rows_surprise_is_that_of_a_fit_without_it(trusted):
    """Trust of the others counts; the row itself is measured against the noise of an ordinary one."""
    n, noise = 12, np.array([0.2, 0.5])
    rng = np.random.default_rng(1)
    trust = np.ones(n) if trusted else rng.uniform(0.05, 1.0, n)
    known, left = gap(n), rng.normal(size=(n, 2))
    covariance = known + np.stack([np.diag(s**2 / trust) for s in noise])
    surprise, doubt = left_out(*(torch.tensor(v) for v in (left, covariance, noise, trust)))
    assert surprise.shape == doubt.shape == (n, 2)
    for k in range(2):
        for row in range(n):
            others = np.arange(n) != row
            gain = np.linalg.solve(covariance[k][np.ix_(others, others)], known[k][others, row])
            variance = known[k][row, row] - gain @ known[k][others, row] + noise[k] ** 2
            assert float(doubt[row, k]) == pytest.approx(variance, rel=1e-9)
            assert float(surprise[row, k]) == pytest.approx((left[row, k] - gain @ left[others, k]) ** 2 / variance)


@pytest.mark.parametrize("freedom", [2.5, 6.0, 20.0])
@pytest.mark.parametrize("outputs", [1, 3])
def test_the_density_is_scipys_multivariate_t(outputs, freedom):
    draws = 3.0 * np.random.default_rng(2).normal(size=(9, outputs))
    theirs = multivariate_t(np.zeros(outputs), np.eye(outputs), df=freedom).logpdf(draws)
    found = log_student(torch.tensor((draws**2).sum(axis=1)), outputs, freedom)
    assert np.allclose(found, theirs, atol=1e-12)


def test_with_infinite_freedom_the_density_is_a_gaussian():
    draws = 3.0 * np.random.default_rng(2).normal(size=(9, 3))
    found = log_student(torch.tensor((draws**2).sum(axis=1)), 3, math.inf)
    assert np.allclose(found, norm.logpdf(draws).sum(axis=1), atol=1e-12)


class TestWeights:
    def test_gaussian_surprises_are_all_trusted(self):
        draws = np.random.default_rng(3).normal(size=(2000, 3))
        freedom, weights = student_weights(torch.tensor((draws**2).sum(axis=1)), 3)
        assert freedom == math.inf
        assert torch.equal(weights, torch.ones(2000, dtype=torch.float64))

    @pytest.mark.parametrize("true", [3.0, 6.0])
    def test_the_freedom_of_student_surprises_is_found(self, true):
        draws = multivariate_t(np.zeros(3), np.eye(3), df=true).rvs(2000, random_state=4)
        freedom, _ = student_weights(torch.tensor((draws**2).sum(axis=1)), 3)
        assert 0.6 * true < freedom < 1.7 * true

    def test_the_more_surprising_the_less_weight(self):
        draws = multivariate_t(np.zeros(3), np.eye(3), df=3.0).rvs(300, random_state=5)
        draws[:5] += 100.0
        surprise = torch.tensor((draws**2).sum(axis=1))
        freedom, weights = student_weights(surprise, 3)
        assert freedom <= 3.0
        assert set(weights.argsort()[:5].tolist()) == set(range(5))
        assert float(weights[:5].max()) < 0.001
        assert float(weights.max()) == 1.0
        far = surprise > 3.0
        assert torch.allclose(weights[far], (freedom + 3.0) / (freedom + surprise[far]))
        assert (weights[~far] == 1.0).all()


class TestTails:
    @pytest.mark.parametrize("freedom", [2.5, 4.0, 20.0])
    def test_the_even_mixture_is_nearly_a_student_distribution(self, freedom):
        scales = tail_scales(freedom, 200).double().numpy()
        at = np.array([-8.0, -3.0, -1.0, 0.0, 0.5, 2.0, 5.0])
        mixture = norm.cdf(at[:, None] / scales).mean(axis=1)
        assert np.allclose(mixture, student.cdf(at, freedom), atol=0.002)

    def test_of_a_gaussian_they_are_one(self):
        assert torch.equal(tail_scales(math.inf, 7), torch.ones(7))


class TestTypicalScale:
    def test_half_of_the_rows_lie_within_the_corrected_doubt(self):
        """Draws of a Student distribution whose doubts are too small by 1.5 and too large by 2."""
        draws = student(4.0).rvs((20_001, 2), random_state=6) * np.array([1.5, 0.5])
        found = typical_scale(torch.tensor(draws**2), 4.0)
        assert np.allclose(found, [1.5, 0.5], rtol=0.03)
        within = np.abs(draws) <= self.told_by_all(found.numpy(), 20_001) * student.ppf(0.75, 4.0)
        assert np.allclose(within.mean(axis=0), 0.5, atol=1e-4)

    @staticmethod
    def told_by_all(found, rows):
        """What ``found`` would be of endless rows: a normal prior and a normal median, in logarithms."""
        return found ** (1.0 + VARIANCE_OF_MEDIAN / rows / WIDTH_DOUBT**2)

    def test_the_error_of_a_median_is_the_textbooks(self):
        """The square of half of |z|'s relative error, times the rows: from a half-normal's density at its median."""
        middle = norm.ppf(0.75)
        assert 1.0 / (4.0 * (2.0 * norm.pdf(middle)) ** 2 * middle**2) == pytest.approx(VARIANCE_OF_MEDIAN, rel=1e-3)

    def test_of_few_rows_it_is_what_a_doubt_is_wrong_by_on_average(self):
        """Of doubts that are wrong by a tenth: regression of the truth on what 50 rows tell has slope one."""
        rng = np.random.default_rng(8)
        truth = 0.1 * rng.normal(size=4000)
        draws = np.exp(truth) * rng.normal(size=(51, 4000))
        found = np.log(typical_scale(torch.tensor(draws**2), math.inf).numpy())
        assert np.polyfit(found, truth, 1)[0] == pytest.approx(1.0, abs=0.1)
        half = np.log(np.median(np.abs(draws), axis=0) / norm.ppf(0.75))
        assert ((found - truth) ** 2).mean() < 0.4 * ((half - truth) ** 2).mean()

    def test_a_few_wild_rows_do_not_count(self):
        draws = np.random.default_rng(7).normal(size=(1001, 1))
        draws[:20] = 1e4
        assert float(typical_scale(torch.tensor(draws**2), math.inf)) == pytest.approx(1.0, rel=0.1)

    def test_it_stays_within_bounds(self):
        found = typical_scale(torch.tensor([[1e-9, 1e9]] * 500, dtype=torch.float64), 4.0)
        assert np.allclose(self.told_by_all(found.numpy(), 500), SCALES, rtol=1e-6, atol=0.0)
