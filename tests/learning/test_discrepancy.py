"""Test the discrepancy covariance against its formula, and its fit against scipy and known processes."""

import math

import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from scipy.stats import multivariate_normal

from learning.posterior import discrepancy as discrepancy_module
from learning.posterior.discrepancy import (
    CHOLESKY_JITTER,
    LOG_STD_INPUT_FACTOR,
    LOG_STD_OUTPUT_FACTOR,
    LOG_STD_SCALE,
    LOG_STD_SHAPE,
    PRIOR_LENGTHSCALE,
    DiscrepancyCovariance,
    evidence_gradient,
    fit_discrepancy,
)
from learning.posterior.row_noise import LOG_STD_NOISE


def positive(*shape, seed=0):
    return torch.tensor(np.random.default_rng(seed).uniform(0.3, 2.0, shape))


def normal(*shape, seed=0):
    return torch.tensor(np.random.default_rng(seed).normal(size=shape))


COVARIANCE = DiscrepancyCovariance(
    positive(2),
    positive(2, 3, seed=1),
    positive(2, 3, seed=2),
    positive(2, seed=3),
    positive(2, seed=4),
    positive(2, 3, seed=5),
)


def kernel(discrepancy, output, first, second):
    """Evaluate the covariance formula entry by entry (N, M)."""
    s, length, w, c = (
        v[output].numpy()
        for v in (discrepancy.scales, discrepancy.lengthscales, discrepancy.slopes, discrepancy.offsets)
    )

    def entry(a, b):
        return s**2 * np.exp(-np.sum(((a - b) / length) ** 2) / 2) + np.dot(w * a, w * b) + c**2

    return np.array([[entry(a, b) for b in np.asarray(second)] for a in np.asarray(first)])


def smooth(x, scale, lengthscales):
    """Evaluate a squared-exponential covariance in numpy (N, N)."""
    distance = (x[:, None] - x[None]) / lengthscales
    return scale**2 * np.exp(-0.5 * (distance**2).sum(axis=2))


def multiplicative_kernel(discrepancy, output, first, second):
    """Evaluate the multiplicative term entry by entry (N, M); inputs (N, 3 + 2) end with simulator outputs."""
    d, length = (v[output].numpy() for v in (discrepancy.multiplier_stds, discrepancy.multiplier_lengthscales))

    def entry(a, b):
        return d**2 * a[3 + output] * b[3 + output] * np.exp(-np.sum(((a[:3] - b[:3]) / length) ** 2) / 2)

    return np.array([[entry(a, b) for b in np.asarray(second)] for a in np.asarray(first)])


class TestCovariance:
    def test_covariance_equals_its_formula(self):
        first, second = normal(5, 3, seed=4), normal(4, 3, seed=5)
        for output in range(2):
            assert np.allclose(COVARIANCE(first, second)[output], kernel(COVARIANCE, output, first, second), atol=1e-12)
            assert np.allclose(COVARIANCE(first)[output], kernel(COVARIANCE, output, first, first), atol=1e-12)

    def test_batched_inputs_equal_single_inputs(self):
        first, second = normal(6, 5, 3, seed=4), normal(6, 4, 3, seed=5)
        found, alone = COVARIANCE(first, second), COVARIANCE(first)
        assert found.shape == (2, 6, 5, 4)
        for output in range(2):
            for b in range(6):
                assert np.allclose(found[output, b], kernel(COVARIANCE, output, first[b], second[b]), atol=1e-12)
                assert np.allclose(alone[output, b], kernel(COVARIANCE, output, first[b], first[b]), atol=1e-12)

    def test_multiplicative_part_equals_its_formula(self):
        first, second = normal(6, 5, 5, seed=4), normal(6, 4, 5, seed=5)
        found = COVARIANCE(first, second)
        for output in range(2):
            for b in range(6):
                additive = kernel(COVARIANCE, output, first[b, :, :3], second[b, :, :3])
                assert np.allclose(
                    found[output, b],
                    additive + multiplicative_kernel(COVARIANCE, output, first[b], second[b]),
                    atol=1e-12,
                )

    def test_all_parts_have_the_prior_size_at_the_prior_median(self):
        found = DiscrepancyCovariance.at_prior_median(3, torch.tensor([0.5, 2.0]))
        a, b = normal(3, seed=6), normal(3, seed=7)
        shape = np.exp(-0.5 * float(((a - b) ** 2).sum()) / PRIOR_LENGTHSCALE**2) + float(a @ b) / 3 + 1.0
        assert np.allclose(found(a[None], b[None])[:, 0, 0], [0.25 * shape, 4.0 * shape], atol=1e-12)


@pytest.mark.parametrize("with_simulator", [False, True])
def test_pullback_equals_finite_differences(with_simulator):
    """Central differences in the logarithms of all six parts, for a symmetric direction."""
    inputs, direction = normal(7, 3 + 2 * with_simulator), normal(2, 7, 7, seed=1)
    direction = direction + direction.transpose(1, 2)
    logs = [0.3 * normal(*size, seed=2) for size in [(2,), (2, 3), (2, 3), (2,), (2,), (2, 3)]]
    found, pullback = DiscrepancyCovariance(*(v.exp() for v in logs)).with_pullback(inputs)
    assert np.allclose(found, DiscrepancyCovariance(*(v.exp() for v in logs))(inputs), atol=1e-12)
    for part, gradient in enumerate(pullback(direction)):
        for index in np.ndindex(gradient.shape):
            values = []
            for step in (1e-5, -1e-5):
                shifted = [v.clone() for v in logs]
                shifted[part][index] += step
                values.append(float((DiscrepancyCovariance(*(v.exp() for v in shifted))(inputs) * direction).sum()))
            assert float(gradient[index]) == pytest.approx((values[0] - values[1]) / 2e-5, abs=1e-6)


@pytest.mark.parametrize("draws", [(), (1,), (3,)])
def test_evidence_gradient_equals_finite_differences_of_scipy(draws):
    """Central differences along symmetric directions, of the mean over draws of the residual."""
    residual, roots, direction = normal(*draws, 6, 2), normal(2, 6, 6, seed=1), normal(2, 6, 6, seed=2)
    covariance = roots @ roots.transpose(1, 2) + 0.1 * torch.eye(6)
    direction = direction + direction.transpose(1, 2)
    found = evidence_gradient(residual, covariance)
    for k in range(2):

        def nll(step, k=k):
            distribution = multivariate_normal(np.zeros(6), covariance[k] + step * direction[k])
            return -np.mean(distribution.logpdf(residual[..., k]))

        expected = (nll(1e-5) - nll(-1e-5)) / 2e-5
        assert float((found[k] * direction[k]).sum()) == pytest.approx(expected, rel=1e-6)


def test_fit_is_close_to_the_maximum_a_posteriori():
    """The reference is scipy's minimum of the same negative log posterior (one output, one input)."""
    rng = np.random.default_rng(0)
    x = rng.uniform(-2, 2, (30, 1))
    y = np.sin(2 * x[:, 0]) + 0.2 * rng.normal(size=30)
    parameter_covariance = 0.1 * x @ x.T
    row_weights = np.where(np.arange(30) < 25, 1.0, 0.3)
    medians = np.log([0.5, PRIOR_LENGTHSCALE, 0.5, 0.5, 0.3, 1.0, 1.0])
    widths = np.array(
        [
            LOG_STD_SCALE,
            LOG_STD_SHAPE,
            LOG_STD_SHAPE,
            LOG_STD_SCALE,
            LOG_STD_NOISE,
            LOG_STD_OUTPUT_FACTOR,
            LOG_STD_INPUT_FACTOR,
        ]
    )

    def combined(logs):
        """Apply the common factors to all sizes and lengthscales."""
        scale, length, slope, offset, noise, size_factor, length_factor = logs
        return np.array([scale + size_factor, length + length_factor, slope + size_factor, offset + size_factor, noise])

    def nll(logs):
        s, length, w, c, noise = np.exp(combined(logs))
        covariance = (
            smooth(x, s, length)
            + w**2 * x @ x.T
            + c**2
            + parameter_covariance
            + np.diag(noise**2 / row_weights + CHOLESKY_JITTER)
        )
        return -multivariate_normal(np.zeros(30), covariance).logpdf(y) + 0.5 * np.sum(((logs - medians) / widths) ** 2)

    discrepancy, noise = fit_discrepancy(
        torch.tensor(x), torch.tensor(y)[:, None], torch.tensor(parameter_covariance)[None],
        torch.tensor([0.3]), torch.tensor([0.5]), torch.tensor(row_weights),
    )  # fmt: skip
    found = np.log(
        [
            float(v.squeeze())
            for v in (discrepancy.scales, discrepancy.lengthscales, discrepancy.slopes, discrepancy.offsets, noise.std)
        ]
    )
    best = minimize(nll, medians, method="L-BFGS-B")
    assert nll(medians) > best.fun + 10.0
    assert np.allclose(found, combined(best.x), atol=0.15)


@pytest.fixture(scope="module")
def process():
    """Fit 150 rows of a known process; 60 more rows are held out. Each output depends on one input only.

    The true lengthscales are 0.8 and 1.2, the noise is 0.1 and 0.25, the expected noise is 0.2.
    """
    rng = np.random.default_rng(1)
    x = rng.uniform(-2, 2, (210, 2))
    shapes = [smooth(x, 1.0, np.array([0.8, np.inf])), smooth(x, 0.7, np.array([np.inf, 1.2]))]
    drawn = [np.linalg.cholesky(k + 1e-9 * np.eye(210)) @ rng.normal(size=210) for k in shapes]
    y = np.stack(drawn, axis=1) + np.array([0.1, 0.25]) * rng.normal(size=(210, 2))
    expected = torch.tensor([0.3, 0.3])
    discrepancy, noise = fit_discrepancy(
        torch.tensor(x[:150]), torch.tensor(y[:150]), None, torch.tensor([0.2, 0.2]), expected, torch.ones(150)
    )
    return x, y, discrepancy, noise.std


class TestKnownProcess:
    def test_noise_is_estimated(self, process):
        assert np.allclose(process[3], [0.1, 0.25], rtol=0.3)

    def test_irrelevant_input_has_the_longer_lengthscale(self, process):
        """The outputs share a lengthscale factor, although each depends on another input."""
        lengthscales = process[2].lengthscales
        assert lengthscales[0, 1] > 2.5 * lengthscales[0, 0]
        assert lengthscales[1, 0] > 1.7 * lengthscales[1, 1]
        assert float(lengthscales[0, 0]) == pytest.approx(0.8, rel=0.5)
        assert float(lengthscales[1, 1]) == pytest.approx(1.2, rel=0.5)

    def test_fit_raises_the_held_out_density(self, process):
        x, y, discrepancy, noise = process

        def held_out_log_density(covariance, stds):
            """Return the log density of the last 60 rows given the first 150."""
            total = 0.0
            for k in range(2):
                full = kernel(covariance, k, x, x) + float(stds[k]) ** 2 * np.eye(210)
                total += multivariate_normal(np.zeros(210), full).logpdf(y[:, k])
                total -= multivariate_normal(np.zeros(150), full[:150, :150]).logpdf(y[:150, k])
            return total

        before = held_out_log_density(DiscrepancyCovariance.at_prior_median(2, torch.tensor([0.3, 0.3])), [0.2, 0.2])
        assert held_out_log_density(discrepancy, noise) > before + 15.0


def test_minibatches_use_all_rows(monkeypatch):
    """Half of the rows have three times the noise: batches of 60 rows find the common noise of all 240."""
    monkeypatch.setattr(discrepancy_module, "BATCH_ROWS", 60)
    rng = np.random.default_rng(5)
    x = rng.uniform(-2, 2, (240, 1))
    spread = np.where(np.arange(240) < 120, 0.1, 0.3)[:, None]
    y = np.sin(2 * x) + spread * rng.normal(size=x.shape)
    tensors = [torch.tensor(v) for v in (x, y)]
    settings = (torch.tensor([0.2]), torch.tensor([0.5]))
    noises = [float(fit_discrepancy(*tensors, None, *settings, torch.ones(240), seed=k)[1].std) for k in range(3)]
    first = float(fit_discrepancy(*(v[:60] for v in tensors), None, *settings, torch.ones(60))[1].std)
    # The common noise is the root mean square of both halves.
    common_noise = math.sqrt(0.5 * (0.1**2 + 0.3**2))
    assert np.allclose(noises, common_noise, rtol=0.15)
    assert abs(first - common_noise) > 0.3 * common_noise


def test_parameter_uncertainty_is_not_attributed_to_the_discrepancy():
    """A linear residual is a discrepancy only if the simulator's slope is exact."""
    rng = np.random.default_rng(2)
    x = rng.uniform(-2, 2, (40, 1))
    y = torch.tensor(1.5 * x + 0.05 * rng.normal(size=(40, 1)))
    x = torch.tensor(x)
    settings = (torch.tensor([0.05]), torch.tensor([0.1]), torch.ones(40))
    exact, _ = fit_discrepancy(x, y, None, *settings)
    uncertain, noise = fit_discrepancy(x, y, 4.0 * (x @ x.T)[None], *settings)
    query = torch.tensor([[2.0]], dtype=torch.float64)
    assert float(exact(query)) > 1.0
    assert float(uncertain(query)) < 0.1
    assert float(noise.std) == pytest.approx(0.05, rel=0.3)


def test_rows_of_low_weight_do_not_change_the_noise():
    """One row in five has twenty times the noise and the weight 1/400."""
    rng = np.random.default_rng(3)
    x = torch.tensor(rng.uniform(-2, 2, (100, 1)))
    row_weights = torch.ones(100, dtype=torch.float64)
    row_weights[::5] = 1.0 / 400.0
    y = 0.5 * x + 0.1 * torch.tensor(rng.normal(size=(100, 1))) / row_weights[:, None].sqrt()
    expected = (torch.tensor([0.15]), torch.tensor([0.3]))
    assert float(fit_discrepancy(x, y, None, *expected, row_weights)[1].std) == pytest.approx(0.1, rel=0.2)
    assert float(fit_discrepancy(x, y, None, *expected, torch.ones(100))[1].std) > 0.4


def test_discrepancy_is_zero_where_the_simulator_is_correct():
    """The simulator is sin(3 a); the truth equals it for a < 0 and is cos(5 a) elsewhere."""
    rng = np.random.default_rng(4)
    x = rng.uniform(-2, 2, (80, 1))
    simulated = np.sin(3.0 * x)
    y = np.where(x < 0.0, simulated, np.cos(5.0 * x)) + 0.02 * rng.normal(size=x.shape)
    tensors = [torch.tensor(v) for v in (x, y - simulated)]
    settings = (torch.tensor([0.02]), torch.tensor([0.3]), torch.ones(80))
    discrepancy, noise = fit_discrepancy(tensors[0], tensors[1], None, *settings, torch.tensor(simulated))
    rows = torch.tensor(np.concatenate([x, simulated], axis=1))
    at = np.linspace(-1.8, -0.3, 40)[:, None]
    query = torch.tensor(np.concatenate([at, np.sin(3.0 * at)], axis=1))
    covariance = discrepancy(rows)[0] + float(noise.std) ** 2 * torch.eye(80)
    mean = discrepancy(query, rows)[0] @ torch.linalg.solve(covariance, tensors[1])
    assert float(mean.abs().max()) < 0.1
