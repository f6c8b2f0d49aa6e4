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
    left_out_density,
    log_student,
    output_correlation,
    student_weights,
    tail_scales,
    turn_of,
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
    white, doubt = left_out(*(torch.tensor(v) for v in (left, covariance, noise, trust)))
    assert white.shape == doubt.shape == (n, 2)
    for k in range(2):
        for row in range(n):
            others = np.arange(n) != row
            gain = np.linalg.solve(covariance[k][np.ix_(others, others)], known[k][others, row])
            variance = known[k][row, row] - gain @ known[k][others, row] + noise[k] ** 2
            assert float(doubt[row, k]) == pytest.approx(variance, rel=1e-9)
            off = left[row, k] - gain @ left[others, k]
            assert float(white[row, k]) == pytest.approx(off / np.sqrt(variance))


@pytest.mark.parametrize(("freedom", "lost"), [(4.0, 0.02), (math.inf, 0.05)])
def test_rows_left_out_are_as_likely_as_the_distribution_they_were_drawn_from_says(freedom, lost):
    """Its correlation, sizes and tails are told from the rows; scipy knows them.

    Sizes that bear outliers are too small for a Gaussian, whose tails then look heavier than they are.
    """
    shape = np.array([[1.0, 0.8, 0.0], [0.8, 1.0, 0.0], [0.0, 0.0, 1.0]])
    size = np.array([0.5, 2.0, 1.0])
    rng = np.random.default_rng(5)
    true = multivariate_t(np.zeros(3), size[:, None] * shape * size, df=freedom)
    drawn, doubt = true.rvs(4000, random_state=rng), rng.uniform(0.1, 10.0, (4000, 3))
    theirs = true.logpdf(drawn) - 0.5 * np.log(doubt).sum(axis=1)
    found = left_out_density(torch.tensor(drawn), torch.tensor(doubt)).numpy()
    assert found.mean() == pytest.approx(theirs.mean(), abs=lost)
    assert np.corrcoef(found, theirs)[0, 1] > 0.99


class TestCorrelation:
    TRUE = np.array([[1.0, 0.9, 0.0], [0.9, 1.0, -0.3], [0.0, -0.3, 1.0]])
    SIZE = np.array([0.5, 2.0, 1.0])

    def drawn(self, rows, freedom):
        """Of a multivariate Student distribution."""
        draws = multivariate_t(np.zeros(3), self.TRUE, df=freedom).rvs(rows, random_state=3)
        return torch.tensor(draws * self.SIZE)

    @pytest.mark.parametrize("freedom", [2.5, 5.0, 500.0])
    def test_it_is_found_whatever_the_tails_and_the_scales(self, freedom):
        assert np.allclose(output_correlation(self.drawn(20_000, freedom))[0], self.TRUE, atol=0.02)

    def test_a_few_outliers_have_little_say(self):
        white = self.drawn(2000, 500.0)
        white[:20] = torch.tensor([50.0, -200.0, 100.0])
        assert np.allclose(output_correlation(white)[0], self.TRUE, atol=0.08)
        assert np.corrcoef(white.numpy().T)[0, 1] < -0.5

    def test_errors_that_are_independent_stay_so(self):
        """Of fifteen pairs one in eighty is beyond two and a half standard errors by chance."""
        apart = torch.tensor(np.random.default_rng(6).normal(size=(50, 80, 6)))
        pairs = sum(int((output_correlation(white)[0] != 0).sum()) - 6 for white in apart) / 2
        assert pairs < 0.03 * 50 * 15

    @pytest.mark.parametrize("rows", [1, 2, 5])
    def test_of_few_rows_it_is_not_told(self, rows):
        assert torch.equal(output_correlation(torch.ones(rows, 3).double())[0], torch.eye(3).double())

    def test_without_errors_there_is_none(self):
        assert torch.equal(output_correlation(torch.zeros(50, 3).double())[0], torch.eye(3).double())

    def test_what_is_left_out_leaves_a_correlation(self):
        """Without the weak tie of a chain's ends, which 200 rows do not tell, its strong ones are impossible."""
        chain = np.array([[1.0, 0.75, 0.14], [0.75, 1.0, 0.75], [0.14, 0.75, 1.0]])
        draws = np.random.default_rng(7).normal(size=(200, 3))
        draws = np.linalg.solve(np.linalg.cholesky(np.cov(draws.T)), draws.T).T @ np.linalg.cholesky(chain).T
        found, _ = output_correlation(torch.tensor(draws))
        assert torch.linalg.eigvalsh(found).min() > 0.0
        assert np.allclose(found, chain, atol=0.1)

    def test_turned_errors_are_independent_and_as_large_as_before(self):
        size = torch.tensor(self.SIZE)
        turn = turn_of(torch.tensor(self.TRUE), size).numpy()
        shape = self.SIZE[:, None] * self.TRUE * self.SIZE
        assert np.allclose(turn @ shape @ turn.T, np.diag(self.SIZE**2), atol=1e-12)
        # The largest error is itself still.
        assert np.allclose(turn[1], [0.0, 1.0, 0.0])


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
