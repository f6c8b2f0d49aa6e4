"""The gap's covariance against its formula, and what is learned of it against scipy and known processes."""

import math

import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from scipy.stats import multivariate_normal

from learning import gap as gap_module
from learning.gap import (
    MIDDLE_LENGTH,
    TINY,
    WIDTH_NOISE,
    WIDTH_OWN,
    WIDTH_REACH,
    WIDTH_SCALE,
    WIDTH_SIZE,
    GapCovariance,
    evidence_gradient,
    learn_gap,
)


def positive(*shape, seed=0):
    return torch.tensor(np.random.default_rng(seed).uniform(0.3, 2.0, shape))


def normal(*shape, seed=0):
    return torch.tensor(np.random.default_rng(seed).normal(size=shape))


GAP = GapCovariance(
    positive(2),
    positive(2, 3, seed=1),
    positive(2, 3, seed=2),
    positive(2, seed=3),
    positive(2, seed=4),
    positive(2, 3, seed=5),
)


def kernel(gap, output, first, second):
    """The formula entry by entry (N, M)."""
    s, length, w, c = (v[output].numpy() for v in (gap.scales, gap.lengths, gap.slopes, gap.offsets))

    def entry(a, b):
        return s**2 * np.exp(-np.sum(((a - b) / length) ** 2) / 2) + np.dot(w * a, w * b) + c**2

    return np.array([[entry(a, b) for b in np.asarray(second)] for a in np.asarray(first)])


def smooth(x, scale, lengths):
    """Squared-exponential covariance in numpy (N, N)."""
    off = (x[:, None] - x[None]) / lengths
    return scale**2 * np.exp(-0.5 * (off**2).sum(axis=2))


def share(gap, output, first, second):
    """The term of the simulator's own outputs, entry by entry (N, M), for inputs (N, 3 + 2)."""
    d, length = (v[output].numpy() for v in (gap.doubts, gap.doubt_lengths))

    def entry(a, b):
        return d**2 * a[3 + output] * b[3 + output] * np.exp(-np.sum(((a[:3] - b[:3]) / length) ** 2) / 2)

    return np.array([[entry(a, b) for b in np.asarray(second)] for a in np.asarray(first)])


class TestCovariance:
    def test_it_is_its_formula(self):
        first, second = normal(5, 3, seed=4), normal(4, 3, seed=5)
        for output in range(2):
            assert np.allclose(GAP(first, second)[output], kernel(GAP, output, first, second), atol=1e-12)
            assert np.allclose(GAP(first)[output], kernel(GAP, output, first, first), atol=1e-12)

    def test_inputs_may_come_in_batches(self):
        first, second = normal(6, 5, 3, seed=4), normal(6, 4, 3, seed=5)
        found, alone = GAP(first, second), GAP(first)
        assert found.shape == (2, 6, 5, 4)
        for output in range(2):
            for b in range(6):
                assert np.allclose(found[output, b], kernel(GAP, output, first[b], second[b]), atol=1e-12)
                assert np.allclose(alone[output, b], kernel(GAP, output, first[b], first[b]), atol=1e-12)

    def test_what_the_simulator_says_counts_by_a_share(self):
        first, second = normal(6, 5, 5, seed=4), normal(6, 4, 5, seed=5)
        found = GAP(first, second)
        for output in range(2):
            for b in range(6):
                own = kernel(GAP, output, first[b, :, :3], second[b, :, :3])
                assert np.allclose(found[output, b], own + share(GAP, output, first[b], second[b]), atol=1e-12)

    def test_before_data_all_parts_are_of_the_expected_size(self):
        found = GapCovariance.before_data(3, torch.tensor([0.5, 2.0]))
        a, b = normal(3, seed=6), normal(3, seed=7)
        shape = np.exp(-0.5 * float(((a - b) ** 2).sum()) / MIDDLE_LENGTH**2) + float(a @ b) / 3 + 1.0
        assert np.allclose(found(a[None], b[None])[:, 0, 0], [0.25 * shape, 4.0 * shape], atol=1e-12)


@pytest.mark.parametrize("with_simulator", [False, True])
def test_the_derivative_by_hand_is_that_of_small_steps(with_simulator):
    """Along a symmetric way, by the logarithms of all six parts, with central differences."""
    inputs, way = normal(7, 3 + 2 * with_simulator), normal(2, 7, 7, seed=1)
    way = way + way.transpose(1, 2)
    logs = [0.3 * normal(*size, seed=2) for size in [(2,), (2, 3), (2, 3), (2,), (2,), (2, 3)]]
    found, pullback = GapCovariance(*(v.exp() for v in logs)).with_pullback(inputs)
    assert np.allclose(found, GapCovariance(*(v.exp() for v in logs))(inputs), atol=1e-12)
    for part, own in enumerate(pullback(way)):
        for place in np.ndindex(own.shape):
            both = []
            for step in (1e-5, -1e-5):
                moved = [v.clone() for v in logs]
                moved[part][place] += step
                both.append(float((GapCovariance(*(v.exp() for v in moved))(inputs) * way).sum()))
            assert float(own[place]) == pytest.approx((both[0] - both[1]) / 2e-5, abs=1e-6)


def test_the_gradient_of_the_evidence_is_that_of_scipys_density():
    """Along symmetric ways, by central differences."""
    residual, roots, way = normal(6, 2), normal(2, 6, 6, seed=1), normal(2, 6, 6, seed=2)
    covariance = roots @ roots.transpose(1, 2) + 0.1 * torch.eye(6)
    way = way + way.transpose(1, 2)
    found = evidence_gradient(residual, covariance)
    for k in range(2):

        def surprise(share, k=k):
            return -multivariate_normal(np.zeros(6), covariance[k] + share * way[k]).logpdf(residual[:, k])

        theirs = (surprise(1e-5) - surprise(-1e-5)) / 2e-5
        assert float((found[k] * way[k]).sum()) == pytest.approx(theirs, rel=1e-6)


def test_what_is_learned_is_nearly_the_most_probable():
    """Against scipy's minimum of the same surprise, with one output and one input."""
    rng = np.random.default_rng(0)
    x = rng.uniform(-2, 2, (30, 1))
    y = np.sin(2 * x[:, 0]) + 0.2 * rng.normal(size=30)
    known = 0.1 * x @ x.T
    trust = np.where(np.arange(30) < 25, 1.0, 0.3)
    middles = np.log([0.5, MIDDLE_LENGTH, 0.5, 0.5, 0.3, 1.0, 1.0])
    widths = np.array([WIDTH_SCALE, WIDTH_OWN, WIDTH_OWN, WIDTH_SCALE, WIDTH_NOISE, WIDTH_SIZE, WIDTH_REACH])

    def together(logs):
        """Of sizes, length and noise with the factors on all sizes and lengths."""
        scale, length, slope, offset, noise, size, reach = logs
        return np.array([scale + size, length + reach, slope + size, offset + size, noise])

    def surprise(logs):
        s, length, w, c, noise = np.exp(together(logs))
        covariance = smooth(x, s, length) + w**2 * x @ x.T + c**2 + known + np.diag(noise**2 / trust + TINY)
        return -multivariate_normal(np.zeros(30), covariance).logpdf(y) + 0.5 * np.sum(((logs - middles) / widths) ** 2)

    gap, noise = learn_gap(
        torch.tensor(x), torch.tensor(y)[:, None], torch.tensor(known)[None], torch.tensor([0.3]), torch.tensor([0.5]),
        torch.tensor(trust),
    )  # fmt: skip
    found = np.log([float(v.squeeze()) for v in (gap.scales, gap.lengths, gap.slopes, gap.offsets, noise)])
    best = minimize(surprise, middles, method="L-BFGS-B")
    assert surprise(middles) > best.fun + 10.0
    assert np.allclose(found, together(best.x), atol=0.15)


@pytest.fixture(scope="module")
def process():
    """150 rows and 60 more of two outputs; the first does not depend on the second input, the second not on the first.

    Of lengths 0.8 and 1.2, noises 0.1 and 0.25, and expected to have noises 0.2 and 0.2.
    """
    rng = np.random.default_rng(1)
    x = rng.uniform(-2, 2, (210, 2))
    shapes = [smooth(x, 1.0, np.array([0.8, np.inf])), smooth(x, 0.7, np.array([np.inf, 1.2]))]
    drawn = [np.linalg.cholesky(k + 1e-9 * np.eye(210)) @ rng.normal(size=210) for k in shapes]
    y = np.stack(drawn, axis=1) + np.array([0.1, 0.25]) * rng.normal(size=(210, 2))
    expected = torch.tensor([0.3, 0.3])
    gap, noise = learn_gap(
        torch.tensor(x[:150]), torch.tensor(y[:150]), None, torch.tensor([0.2, 0.2]), expected, torch.ones(150)
    )
    return x, y, gap, noise


class TestOfAKnownProcess:
    def test_the_noise_is_found(self, process):
        assert np.allclose(process[3], [0.1, 0.25], rtol=0.3)

    def test_an_input_that_does_not_count_has_the_longer_length(self, process):
        """Although the outputs share a factor on their lengths, and another input counts for each."""
        lengths = process[2].lengths
        assert lengths[0, 1] > 2.5 * lengths[0, 0]
        assert lengths[1, 0] > 1.7 * lengths[1, 1]
        assert float(lengths[0, 0]) == pytest.approx(0.8, rel=0.5)
        assert float(lengths[1, 1]) == pytest.approx(1.2, rel=0.5)

    def test_other_rows_are_less_surprising_than_before(self, process):
        x, y, gap, noise = process

        def of_others(covariance, stds):
            """Log density of the last 60 rows given the first 150."""
            total = 0.0
            for k in range(2):
                full = kernel(covariance, k, x, x) + float(stds[k]) ** 2 * np.eye(210)
                total += multivariate_normal(np.zeros(210), full).logpdf(y[:, k])
                total -= multivariate_normal(np.zeros(150), full[:150, :150]).logpdf(y[:150, k])
            return total

        before = of_others(GapCovariance.before_data(2, torch.tensor([0.3, 0.3])), [0.2, 0.2])
        assert of_others(gap, noise) > before + 15.0


def test_of_many_rows_all_are_heard(monkeypatch):
    """Half of the rows are three times as noisy: steps of 60 of 240 rows find the noise of all, whatever is drawn."""
    monkeypatch.setattr(gap_module, "EVIDENCE_ROWS", 60)
    rng = np.random.default_rng(5)
    x = rng.uniform(-2, 2, (240, 1))
    spread = np.where(np.arange(240) < 120, 0.1, 0.3)[:, None]
    y = np.sin(2 * x) + spread * rng.normal(size=x.shape)
    tensors = [torch.tensor(v) for v in (x, y)]
    settings = (torch.tensor([0.2]), torch.tensor([0.5]))
    noises = [float(learn_gap(*tensors, None, *settings, torch.ones(240), seed=k)[1]) for k in range(3)]
    first = float(learn_gap(*(v[:60] for v in tensors), None, *settings, torch.ones(60))[1])
    # One noise for two halves with each its own.
    together = math.sqrt(0.5 * (0.1**2 + 0.3**2))
    assert np.allclose(noises, together, rtol=0.15)
    assert abs(first - together) > 0.3 * together


def test_what_the_simulator_doubts_is_no_gap():
    """A residual that is all a line of unknown slope: a gap only where the simulator claims to know it."""
    rng = np.random.default_rng(2)
    x = rng.uniform(-2, 2, (40, 1))
    y = torch.tensor(1.5 * x + 0.05 * rng.normal(size=(40, 1)))
    x = torch.tensor(x)
    settings = (torch.tensor([0.05]), torch.tensor([0.1]), torch.ones(40))
    sure, _ = learn_gap(x, y, None, *settings)
    doubtful, noise = learn_gap(x, y, 4.0 * (x @ x.T)[None], *settings)
    at = torch.tensor([[2.0]], dtype=torch.float64)
    assert float(sure(at)) > 1.0
    assert float(doubtful(at)) < 0.1
    assert float(noise) == pytest.approx(0.05, rel=0.3)


def test_rows_that_are_not_trusted_leave_the_noise_alone():
    """One row in five is twenty times as noisy, and known to be: its variance is divided by 1/400."""
    rng = np.random.default_rng(3)
    x = torch.tensor(rng.uniform(-2, 2, (100, 1)))
    trust = torch.ones(100, dtype=torch.float64)
    trust[::5] = 1.0 / 400.0
    y = 0.5 * x + 0.1 * torch.tensor(rng.normal(size=(100, 1))) / trust[:, None].sqrt()
    expected = (torch.tensor([0.15]), torch.tensor([0.3]))
    assert float(learn_gap(x, y, None, *expected, trust)[1]) == pytest.approx(0.1, rel=0.2)
    assert float(learn_gap(x, y, None, *expected, torch.ones(100))[1]) > 0.4


def test_a_simulator_that_is_right_in_one_half_is_believed_there_alone():
    """It says sin(3 a), which is so where a < 0; beyond, the truth is another wave of the same size."""
    rng = np.random.default_rng(4)
    x = rng.uniform(-2, 2, (80, 1))
    said = np.sin(3.0 * x)
    y = np.where(x < 0.0, said, np.cos(5.0 * x)) + 0.02 * rng.normal(size=x.shape)
    tensors = [torch.tensor(v) for v in (x, y - said)]
    settings = (torch.tensor([0.02]), torch.tensor([0.3]), torch.ones(80))
    gap, noise = learn_gap(tensors[0], tensors[1], None, *settings, torch.tensor(said))
    rows = torch.tensor(np.concatenate([x, said], axis=1))
    at = np.linspace(-1.8, -0.3, 40)[:, None]
    there = torch.tensor(np.concatenate([at, np.sin(3.0 * at)], axis=1))
    covariance = gap(rows)[0] + float(noise) ** 2 * torch.eye(80)
    mean = gap(there, rows)[0] @ torch.linalg.solve(covariance, tensors[1])
    assert float(mean.abs().max()) < 0.1
