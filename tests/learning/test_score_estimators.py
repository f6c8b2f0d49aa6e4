"""Test estimators of scores by closed forms and by direct computations in NumPy."""

import numpy as np
import pytest
import torch
from scipy.spatial.distance import cdist, pdist

from learning.functional_svgd.estimated_prior import EstimatedPrior
from learning.functional_svgd.fsvgd import FsvgdSettings, SimulatorPrior, fit_fsvgd
from learning.functional_svgd.score_estimators import NuMethod, SpectralStein, kernel_density
from learning.networks.normaliser import Normaliser
from learning.priors.function_prior import RbfCovariance
from tests.helpers.seeded import normal

ALL = [kernel_density, SpectralStein(), NuMethod()]
NAMES = ["kde", "ssge", "nu"]
every_estimator = pytest.mark.parametrize("estimator", ALL, ids=NAMES)


def relative_error(estimate, score):
    return float((estimate - score).norm() / score.norm())


def gaussian_fit(draws, points):
    """Score of the Gaussian with the moments of the draws: the estimator of the paper."""
    mean = draws.mean(dim=1, keepdim=True)
    covariance = (draws - mean).mT @ (draws - mean) / draws.shape[1]
    return -torch.linalg.solve(covariance, (points - mean).mT).mT


def mixture(count, seed):
    """Draw from unit Gaussians at (2, 0) and (-2, 0) with equal weights (1, count, 2)."""
    side = torch.tensor([[2.0, 0.0]]) * normal(count, 1, seed=seed + 100).sign()
    return (normal(count, 2, seed=seed) + side)[None]


def mixture_score(points):
    return torch.stack([2.0 * torch.tanh(2.0 * points[..., 0]), torch.zeros_like(points[..., 0])], dim=2) - points


@pytest.mark.parametrize(("estimator", "bound"), list(zip(ALL, (0.65, 0.35, 0.35), strict=True)), ids=NAMES)
def test_score_of_a_gaussian_is_minus_precision_times_deviation(estimator, bound):
    factor, mean = torch.tensor([[1.0, 0.0, 0.0], [0.3, 0.8, 0.0], [0.0, -0.2, 0.9]]).double(), torch.arange(3.0)
    draws, points = (normal(n, 3, seed=s) @ factor.T + mean for n, s in ((1000, 0), (200, 1)))
    score = -(points - mean) @ torch.linalg.inv(factor @ factor.T)
    assert relative_error(estimator(draws[None], points[None])[0], score) < bound


@pytest.mark.parametrize(
    ("estimator", "bound"), [(kernel_density, 0.45), (SpectralStein(0.98), 0.4), (NuMethod(), 0.4)], ids=NAMES
)
def test_score_of_a_mixture_that_a_gaussian_does_not_fit(estimator, bound):
    draws, points = mixture(800, 0), mixture(300, 1)
    score = mixture_score(points)
    assert relative_error(gaussian_fit(draws, points), score) > 0.5
    assert relative_error(estimator(draws, points), score) < bound


@pytest.mark.parametrize("estimator", [kernel_density, SpectralStein(0.98), NuMethod()], ids=NAMES)
def test_error_falls_with_the_number_of_draws(estimator):
    points = mixture(300, 1)
    errors = [
        np.mean([relative_error(estimator(mixture(n, seed), points), mixture_score(points)) for seed in range(2, 6)])
        for n in (50, 200, 800)
    ]
    assert errors[0] > 1.1 * errors[1]
    assert errors[1] > 1.05 * errors[2]


@every_estimator
def test_batched_scores_equal_single_ones(estimator):
    draws, points = normal(3, 40, 4) * torch.tensor([1.0, 5.0, 0.2])[:, None, None], normal(3, 6, 4, seed=1)
    together = estimator(draws, points)
    assert together.shape == points.shape
    for k in range(3):
        assert torch.allclose(estimator(draws[k : k + 1], points[k : k + 1])[0], together[k], rtol=1e-9, atol=1e-12)


@every_estimator
def test_score_is_invariant_to_translation_and_has_the_reciprocal_unit(estimator):
    draws, points = normal(1, 60, 3), normal(1, 5, 3, seed=1)
    score, offset = estimator(draws, points), torch.tensor([3.0, -2.0, 50.0])
    assert torch.allclose(estimator(draws + offset, points + offset), score, atol=1e-9)
    assert torch.allclose(estimator(100.0 * draws, 100.0 * points) * 100.0, score, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("estimator", [SpectralStein(from_normal=True), NuMethod(from_normal=True)], ids=NAMES[1:])
def test_far_from_all_draws_only_the_score_of_the_standard_normal_remains(estimator):
    draws, far = normal(1, 60, 3), 100.0 * normal(1, 5, 3, seed=1)
    assert relative_error(estimator(draws, far), -far) < 1e-3


@every_estimator
def test_scores_have_the_type_of_the_points(estimator):
    draws, points = normal(2, 60, 3), normal(2, 5, 3, seed=1)
    single = estimator(draws.float(), points.float())
    assert single.dtype == torch.float32
    assert torch.allclose(single.double(), estimator(draws, points), rtol=1e-3, atol=1e-3)


def test_kernel_density_score_equals_finite_differences():
    draws, points, h = normal(30, 2).numpy(), normal(4, 2, seed=1).numpy(), 1e-5
    bandwidth = draws.std(axis=0, ddof=1) * 30 ** (-1 / 6)

    def log_density(at):
        return np.log(np.exp(-0.5 * cdist(at / bandwidth, draws / bandwidth) ** 2).sum(axis=1))

    expected = np.stack(
        [(log_density(points + h * e) - log_density(points - h * e)) / (2 * h) for e in np.eye(2)], axis=1
    )
    found = kernel_density(torch.from_numpy(draws)[None], torch.from_numpy(points)[None])[0]
    assert np.allclose(found, expected, atol=1e-7)


@pytest.mark.parametrize("from_normal", [False, True])
def test_ssge_equals_its_definition(from_normal):
    """Eigenfunctions of the Nystroem method, and coefficients minus their mean gradients by finite differences."""
    draws, points, share, h = normal(26, 2).numpy(), normal(4, 2, seed=1).numpy(), 0.9, 1e-5  # An odd number of pairs.
    width = np.median(pdist(draws))
    values, vectors = np.linalg.eigh(np.exp(-0.5 * cdist(draws, draws) ** 2 / width**2))
    order = np.argsort(values)[::-1]
    used = order[: np.searchsorted(np.cumsum(values[order]) / values.sum(), share) + 1]
    assert 2 < len(used) < 26

    def eigenfunctions(at):
        return np.sqrt(26) / values[used] * (np.exp(-0.5 * cdist(at, draws) ** 2 / width**2) @ vectors[:, used])

    slopes = [(eigenfunctions(draws + h * e) - eigenfunctions(draws - h * e)).mean(axis=0) / (2 * h) for e in np.eye(2)]
    start = -from_normal * draws
    expected = eigenfunctions(points) @ (-np.array(slopes).T - eigenfunctions(draws).T @ start / 26)
    expected -= from_normal * points
    found = SpectralStein(share, from_normal)(torch.from_numpy(draws)[None], torch.from_numpy(points)[None])[0]
    assert np.allclose(found, expected, atol=1e-6)


class TestNuMethod:
    """Small systems whose kernel is differentiated automatically."""

    draws, points = normal(7, 2), normal(3, 2, seed=1)

    def kernel_and_divergence(self, width):
        """Kernel (10, 2, 7, 2) between draws and points, and draws, and its mean divergence (10, 2) over the draws."""
        scale = width * np.median(pdist(self.draws.numpy()))
        at = torch.cat([self.draws, self.points])

        def block(a, b):
            """Minus the Hessian by b (2, 2)."""
            return -torch.autograd.functional.hessian(
                lambda y: scale**2 * (1.0 + ((a - y) ** 2).sum() / scale**2) ** -0.5, b, create_graph=True
            )

        kernel = torch.stack([torch.stack([block(a, b) for b in self.draws], dim=1) for a in at])
        slopes = [[torch.autograd.functional.jacobian(lambda y, a=a: block(a, y), b) for b in self.draws] for a in at]
        divergence = torch.stack([torch.stack([torch.einsum("abb->a", s) for s in row]).mean(dim=0) for row in slopes])
        return kernel.detach().numpy(), divergence.detach().numpy()

    @pytest.mark.parametrize("from_normal", [False, True])
    def test_equals_the_recursion_of_function_values(self, from_normal):
        steps, nu = 6, 1.0
        kernel, divergence = self.kernel_and_divergence(2.0)
        now = before = -from_normal * torch.cat([self.draws, self.points]).numpy()
        for t in range(1, steps + 1):
            u = (t - 1) * (2 * t - 3) * (2 * t + 2 * nu - 1)
            u /= (t + 2 * nu - 1) * (2 * t + 4 * nu - 1) * (2 * t + 2 * nu - 3)
            w = 4 * (2 * t + 2 * nu - 1) * (t + nu - 1) / ((t + 2 * nu - 1) * (2 * t + 4 * nu - 1))
            w = (4 * nu + 2) / (4 * nu + 1) if t == 1 else w
            residual = divergence + np.einsum("iajb,jb->ia", kernel, now[:7]) / 7
            before, now = now, now + u * (now - before) - w * residual
        found = NuMethod(steps, 2.0, nu, from_normal)(self.draws[None], self.points[None])[0]
        assert np.allclose(found, now[7:], atol=1e-10)

    def test_converges_to_the_solution_without_regularisation(self):
        """With a narrow kernel the system at the draws is well conditioned."""
        kernel, divergence = self.kernel_and_divergence(0.3)
        system = kernel[:7].reshape(14, 14) / 7
        expected = np.linalg.solve(system, -divergence[:7].ravel()).reshape(7, 2)
        found = NuMethod(400, 0.3)(self.draws[None], self.draws[None])[0]
        assert np.allclose(found, expected, rtol=1e-3, atol=1e-4)
        regularised = np.linalg.solve(system + 0.3 * np.eye(14), -divergence[:7].ravel()).reshape(7, 2)
        assert not np.allclose(regularised, expected, rtol=0.1)


class TestEstimatedPrior:
    inputs = torch.linspace(-2.0, 2.0, 12)[:, None]
    drawn = normal(3000, 2, seed=3).float()
    values = normal(5, 4, 2, seed=4).float()
    chosen = torch.tensor([0, 3, 7, 11])

    def prior(self, discrepancy):
        lines = self.drawn[:, :1] * self.inputs[:, 0] + self.drawn[:, 1:]
        return SimulatorPrior(torch.stack([lines, 0.5 * lines], dim=2), self.inputs, discrepancy, jitter=1e-2)

    @pytest.mark.parametrize("discrepancy", [None, RbfCovariance((0.3, 0.1), (1.0,))], ids=["exact", "discrepancy"])
    def test_draws_have_the_moments_of_simulator_and_discrepancy(self, discrepancy):
        prior = self.prior(discrepancy)
        expected = prior.marginal(self.chosen)
        found = EstimatedPrior(prior, gaussian_fit, count=3000).marginal(self.chosen)
        assert relative_error(found.score(self.values), expected.score(self.values)) < 0.1
        assert torch.equal(found.precision(), expected.precision())

    def test_standard_normal_score_of_whitened_draws_is_the_gaussian_fit(self):
        prior = self.prior(RbfCovariance((0.3, 0.1), (1.0,)))
        found = EstimatedPrior(prior, lambda draws, points: -points).marginal(self.chosen)
        expected = prior.marginal(self.chosen).score(self.values)
        assert torch.allclose(found.score(self.values), expected, rtol=1e-3, atol=1e-3)

    def test_draws_follow_from_the_seed(self):
        scores = [
            EstimatedPrior(self.prior(None), NuMethod(), seed).marginal(self.chosen).score(self.values)
            for seed in (1, 1, 2)
        ]
        assert torch.equal(scores[0], scores[1])
        assert not torch.allclose(scores[0], scores[2])

    @pytest.mark.parametrize(
        "estimator", [SpectralStein(from_normal=True), NuMethod(from_normal=True)], ids=["ssge", "nu"]
    )
    def test_fit_to_a_simulator_alone_has_the_moments_of_its_draws(self, estimator):
        pool = torch.linspace(-2, 2, 64)[:, None]
        lines = (1.0 + 0.5 * self.drawn[:400, :1]) * pool[:, 0] + 0.3 * self.drawn[:400, 1:]
        prior = EstimatedPrior(SimulatorPrior(lines[:, :, None], pool), estimator, count=64)
        settings = FsvgdSettings(steps=400, measurement_points=8, hidden=(32, 32), fit_noise=False, noise_std=0.05)
        unit, empty = Normaliser(torch.zeros(1), torch.ones(1), torch.zeros(1), torch.ones(1)), torch.zeros(0, 1)
        prediction = fit_fsvgd(empty, empty, pool, prior, unit, settings).predict(pool)
        assert torch.allclose(prediction.mean[:, 0], lines.mean(dim=0), atol=0.25)
        assert torch.allclose(prediction.epistemic_std[:, 0], lines.std(dim=0), rtol=0.4, atol=0.1)
