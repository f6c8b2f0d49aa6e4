"""Test the distillation of a posterior into particles against autograd and closed forms."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from linear_simulator import mean_and_scale
from scipy.stats import t as student
from torch import Tensor

from carlab.core.errors import DataError
from learning.networks.normaliser import Normaliser
from learning.networks.particles import Network
from learning.posterior import distillation
from learning.posterior.distillation import MAX_NEIGHBOUR_DISTANCE, DistillationSettings, distil, measurement_points
from learning.posterior.inference import infer
from learning.priors.domain_models import Pendulum, uniform
from learning.stein import moment_direction
from tests.helpers.seeded import generator, normal

UNITS = Normaliser(torch.tensor([0.5]), torch.tensor([1.5]), torch.tensor([1.0]), torch.tensor([2.0]))
NOISE = torch.tensor([0.2])
EMPTY = torch.zeros(0, 1)


@pytest.mark.parametrize(("steps", "count"), [(3000, 8192), (40, 40 * 16 * 4), (1, 1024)])
def test_no_more_measurement_points_are_drawn_than_the_steps_use(steps, count):
    assert DistillationSettings(steps=steps).domain_points == count


@dataclass(frozen=True)
class FixedLine:
    """Simulator ``0.7 x - 1.2``; its parameter has no effect."""

    size: int = 1

    def inputs(self, count: int, generator: torch.Generator) -> Tensor:
        return uniform(((-3.0, 4.0),), count, generator)

    def parameters(self, normal: Tensor) -> Tensor:
        return normal

    def __call__(self, inputs: Tensor, parameters: Tensor) -> Tensor:
        return (0.7 * inputs - 1.2).expand(len(parameters), -1, -1)


@dataclass(frozen=True)
class RandomLine:
    """Simulator ``a x + b`` with standard normal a and b, for x in [-3, 4]."""

    size: int = 2

    def inputs(self, count: int, generator: torch.Generator) -> Tensor:
        return uniform(((-3.0, 4.0),), count, generator)

    def parameters(self, normal: Tensor) -> Tensor:
        return normal

    def __call__(self, inputs: Tensor, parameters: Tensor) -> Tensor:
        return (parameters[:, :1] * inputs[:, 0] + parameters[:, 1:])[:, :, None]


def gaussian(groups, points, seed=0):
    """Return random means (G, N) and Cholesky factors of covariances (G, N, N)."""
    roots = normal(groups, points, points, seed=seed)
    covariance = roots @ roots.transpose(1, 2) + 0.3 * torch.eye(points)
    return normal(groups, points, seed=seed + 1), torch.linalg.cholesky(covariance)


def standardised(values):
    """Transform particles (L, N) linearly to zero sample mean and unit sample covariance."""
    centred = values - values.mean(dim=0)
    root = torch.linalg.cholesky(centred.T @ centred / len(centred))
    return torch.linalg.solve_triangular(root, centred.T, upper=False).T


class TestDirection:
    def test_direction_is_zero_for_particles_with_the_target_moments(self):
        mean, factor = gaussian(3, 4)
        white = torch.stack([standardised(normal(9, 4, seed=s)) for s in range(3)], dim=1)
        values = mean + torch.einsum("gij,lgj->lgi", factor, white)
        assert moment_direction(values, mean, factor).abs().max() < 1e-12
        assert moment_direction(values + 0.1, mean, factor).abs().max() > 0.01
        assert moment_direction(mean + 1.1 * (values - mean), mean, factor).abs().max() > 0.01

    @pytest.mark.parametrize("size", [0.2, 1.0, 30.0])
    def test_direction_equals_the_stein_sum_by_autograd(self, size):
        """The kernel of whitened values is ``1 + u . v / c``; c is the larger of their mean square and one."""
        mean, factor = gaussian(2, 3, seed=4)
        values = mean + size * normal(5, 2, 3, seed=6)
        direction = moment_direction(values, mean, factor)
        for g in range(2):
            white = torch.linalg.solve(factor[g], (values[:, g] - mean[g]).T).T
            width = max(float((white**2).mean()), 1.0)
            assert (width > 1.0) == (size > 0.2)
            for particle in range(5):
                total = torch.zeros(3, dtype=torch.float64)
                for other in white:
                    u = other.clone().requires_grad_()
                    kernel = 1.0 + u @ white[particle] / width
                    (by_kernel,) = torch.autograd.grad(kernel, u)
                    (score,) = torch.autograd.grad(-0.5 * u @ u, u)
                    total += (kernel.detach() * score + by_kernel) / 5
                assert torch.allclose(direction[particle, g], factor[g] @ total, rtol=1e-9, atol=1e-12)

    def test_iterated_direction_reaches_mean_and_covariance_from_far_away(self):
        """Steps stay bounded although the particles start far from the target."""
        mean, factor = gaussian(2, 3, seed=8)
        values = 50.0 + 20.0 * normal(12, 2, 3, seed=9)
        for _ in range(300):
            values = values + 0.2 * moment_direction(values, mean, factor)
        for g in range(2):
            centred = values[:, g] - values[:, g].mean(dim=0)
            assert torch.allclose(values[:, g].mean(dim=0), mean[g], atol=1e-6)
            assert torch.allclose(centred.T @ centred / 12, factor[g] @ factor[g].T, atol=1e-6)


def constant(*heights, hidden=(4,)):
    """Return parameters of particles whose normalised outputs are the constants ``heights`` (L, O)."""
    network = Network(1, len(heights[0]), hidden)
    numbers = torch.zeros(len(heights), network.parameters)
    network.split(numbers)[-1][1][:, 0] = torch.tensor(heights)
    return numbers


class TestTrend:
    """The linear trend shared by all particles, before the first step."""

    settings = DistillationSettings(hidden=(4,), steps=0)

    def test_trend_is_weighted_least_squares(self):
        """numpy fits the same line with predictive-variance weights; a constant input gets no slope."""
        units = Normaliser(torch.tensor([0.5, 7.0]), torch.tensor([1.5, 1.0]), UNITS.output_mean, UNITS.output_std)
        x, points = (torch.cat([v, torch.full_like(v, 7.5)], dim=1) for v in (X, torch.linspace(-3, 4, 64)[:, None]))
        target = infer(None, x, Y, units, NOISE)
        distilled = distil(target, points, self.settings, start=torch.zeros(3, Network(2, 1, (4,)).parameters))
        mean, std = (v.double().numpy()[:, 0] for v in mean_and_scale(target.predict(points)))
        slope, offset = np.polyfit(points[:, 0].double().numpy(), mean, 1, w=1.0 / std)
        query = torch.tensor([[-3.0, 7.5], [0.0, 7.5], [4.0, 7.5]])
        assert np.allclose(distilled.predict(query).mean[:, 0], slope * query[:, 0].numpy() + offset, atol=2e-3)
        assert abs(slope) > 0.3

    def test_trend_alone_reproduces_a_linear_target(self):
        target = infer(FixedLine(), EMPTY, EMPTY, UNITS, NOISE, with_discrepancy=False)
        points = torch.linspace(-3, 4, 16)[:, None]
        distilled = distil(target, points, self.settings, start=constant((0.0,), (0.0,)))
        assert np.allclose(distilled.predict(points).mean, 0.7 * points - 1.2, atol=1e-3)


@pytest.fixture
def no_trend(monkeypatch):
    """Replace the linear trend by zero."""
    flat = lambda inputs, mean, weight: torch.zeros(1 + inputs.shape[2], mean.shape[1])  # noqa: E731
    monkeypatch.setattr(distillation, "_trend", flat)


def test_inputs_are_clipped_at_the_edge_of_the_training_inputs():
    """The training inputs end at 9; the prediction at 30 equals the one at 9."""
    rng = np.random.default_rng(0)
    x = torch.from_numpy(rng.uniform(-9.0, 9.0, (60, 1))).float()
    units = Normaliser(torch.zeros(1), torch.ones(1), torch.zeros(1), torch.ones(1))
    target = infer(None, x, 0.5 * x + 0.05 * torch.from_numpy(rng.normal(size=(60, 1))).float(), units, torch.ones(1))
    distilled = distil(target, torch.linspace(-9.0, 9.0, 400)[:, None], DistillationSettings(steps=200, hidden=(16,)))
    query = torch.tensor([[-8.5], [8.5], [9.0], [30.0]])
    predicted = distilled.predict(query).mean[:, 0]
    assert predicted[:2].tolist() == pytest.approx([-4.25, 4.25], abs=0.2)
    assert predicted[3] == pytest.approx(float(predicted[2]), abs=0.05)


@pytest.mark.usefixtures("no_trend")
class TestNoise:
    """Fitted noise of constant particles without a step, for a known target with two outputs."""

    points = torch.linspace(-3, 4, 16)[:, None]
    settings = DistillationSettings(hidden=(4,), steps=0)
    units = Normaliser(UNITS.input_mean, UNITS.input_std, torch.tensor([1.0, -3.0]), torch.tensor([2.0, 0.5]))
    target = infer(
        None, EMPTY, torch.zeros(0, 2), units, torch.tensor([0.2, 0.2]), discrepancy_std=torch.tensor([0.3, 0.1])
    )

    @pytest.mark.parametrize("heights", [[(0.2, 0.0)] * 2, [(-0.3, 0.1)] * 3, [(0.05, 0.2), (-0.05, -0.2)]])
    def test_noise_is_the_predictive_variance_not_covered_by_the_particles(self, heights):
        """Per point it sums measurement noise, squared error of the mean and target variance beyond the particles'."""
        distilled = distil(self.target, self.points, self.settings, start=constant(*heights))
        x = (self.points[:, 0].double().numpy() - 0.5) / 1.5
        for k, (noise, discrepancy) in enumerate(((0.1, 0.15), (0.4, 0.2))):
            # Smooth part, offset and slope of the discrepancy have the prior size.
            discrepancy_variance = discrepancy**2 * (2.0 + x**2)
            weight = 1.0 / (discrepancy_variance + noise**2)
            values = np.array(heights)[:, k]
            uncovered = values.mean() ** 2 + discrepancy_variance - values.var()
            missed = (weight * uncovered).sum() / weight.sum()
            assert float(distilled.noise_std[k]) == pytest.approx(np.sqrt(noise**2 + missed), rel=1e-4)

    @pytest.mark.parametrize(("rows", "at_data"), [(39, False), (40, True)])
    def test_noise_is_fitted_at_the_data_from_40_rows_on(self, rows, at_data):
        """The particles lie near 0.3; the target is near 0.3 at the data only; one row is far away."""
        heights = ((0.25, 0.4), (0.3, 0.3), (0.35, 0.2))
        x = torch.cat([torch.linspace(8.0, 12.0, rows - 1), torch.tensor([40.0])])[:, None]
        y = torch.tensor([[1.0 + 2.0 * 0.3, -3.0 + 0.5 * 0.3]]).expand(rows, 2)
        y = y + torch.tensor([[0.2, 0.2]]) * torch.randn((rows, 2), generator=generator(4))
        target = infer(None, x, y, self.units, torch.tensor([0.2, 0.2]), discrepancy_std=torch.tensor([0.6, 0.6]))
        distilled = distil(target, self.points, self.settings, start=constant(*heights))
        mean, std = mean_and_scale(target.predict(x if at_data else self.points))
        missed = ((mean - self.units.raw_outputs(torch.tensor([0.3, 0.3]))) / self.units.output_std) ** 2
        noise = target.noise_std**2
        function_variance = (std / self.units.output_std) ** 2 - noise - torch.tensor(heights).var(dim=0, correction=0)
        weight = torch.ones_like(function_variance) if at_data else (std / self.units.output_std) ** -2
        expected = (noise + (weight * (missed + function_variance)).sum(dim=0) / weight.sum(dim=0)).sqrt()
        assert np.allclose(distilled.noise_std, expected, rtol=2e-3)
        assert (bool((distilled.noise_std < 1.5 * target.noise_std).all())) is at_data

    @pytest.mark.parametrize("outlier_error", [5.0, 50.0])
    def test_one_row_with_a_large_error_hardly_changes_the_noise(self, outlier_error):
        """The particles fit sixty rows at 0.3 and miss one distant row of high leverage."""
        x = torch.cat([torch.linspace(8.0, 12.0, 60), torch.tensor([60.0])])[:, None]
        y = torch.tensor([[1.0 + 2.0 * 0.3, -3.0 + 0.5 * 0.3]]).repeat(61, 1)
        y = y + torch.tensor([[0.2, 0.2]]) * torch.randn((61, 2), generator=generator(4))
        y[-1] += outlier_error
        target = infer(None, x, y, self.units, torch.tensor([0.2, 0.2]), discrepancy_std=torch.tensor([0.6, 0.6]))
        distilled = distil(target, self.points, self.settings, start=constant(*[(0.3, 0.3)] * 2))
        error = target.predict(x[-1:]).mean - self.units.raw_outputs(torch.tensor([0.3, 0.3]))
        missed = error / self.units.output_std
        assert (missed[0] > 4.0 * target.noise_std).any()
        assert torch.allclose(distilled.noise_std, target.noise_std, rtol=0.25)

    def test_noise_variance_is_at_least_half_of_the_measurement_variance(self):
        distilled = distil(self.target, self.points, self.settings, start=constant((2.0, 2.0), (-2.0, -2.0)))
        assert np.allclose(distilled.noise_std, [0.1 * np.sqrt(0.5), 0.4 * np.sqrt(0.5)], rtol=1e-5)

    def test_prediction_has_the_degrees_of_freedom_of_the_target(self):
        """Three equal particles predict a Student-t distribution with the scale of their noise."""
        target = infer(None, EMPTY, EMPTY, UNITS, NOISE)
        distilled = distil(replace(target, dof=4.0), self.points, self.settings, start=constant(*[(0.0,)] * 3))
        query = np.array([-3.0, 0.0, 0.9, 1.0, 1.3, 4.0])
        prediction = distilled.predict(torch.zeros(len(query), 1))
        expected = student(4.0, loc=1.0, scale=2.0 * float(distilled.noise_std)).logpdf(query)
        density = prediction.log_density(torch.tensor(query, dtype=torch.float32)[:, None])
        assert np.allclose(density, expected, atol=1e-4)


X = torch.linspace(-2.5, 1.0, 8)[:, None]
Y = 0.7 * X - 0.4 + 0.3 * torch.sin(2.0 * X) + 0.2 * torch.randn(8, 1, generator=generator(3))
SETTINGS = DistillationSettings(hidden=(32, 32), steps=1500)


@pytest.fixture(scope="module")
def target():
    """Posterior of eight rows of a line plus a sine, all in the left half of the domain."""
    return infer(RandomLine(), X, Y, UNITS, NOISE, discrepancy_std=torch.tensor([0.4]))


@pytest.fixture(scope="module")
def points():
    return measurement_points(RandomLine(), X, UNITS, generator(1), count=1024)


@pytest.fixture(scope="module")
def steps_done():
    return []


@pytest.fixture(scope="module")
def particles(target, points, steps_done):
    return distil(target, points, SETTINGS, steps_done.append)


class TestFit:
    query = torch.linspace(-2.9, 3.9, 60)[:, None]

    def test_particles_have_the_mean_and_standard_deviation_of_the_target(self, target, particles):
        mean, std = mean_and_scale(target.predict(self.query))
        function_std = (std**2 - (target.noise_std * UNITS.output_std) ** 2).sqrt()
        prediction = particles.predict(self.query)
        assert float(function_std.max()) > 4.0 * float(function_std.min())
        assert ((prediction.mean - mean).abs() < 0.25 * std).all()
        assert torch.allclose(prediction.epistemic_std, function_std, rtol=0.2, atol=0.02)
        assert torch.allclose(prediction.std, std, rtol=0.2)

    def test_particles_have_the_correlation_of_the_target_between_inputs(self, target, particles):
        pairs = torch.stack([self.query[:-9], self.query[9:]], dim=1)
        _, covariance = target.marginals(pairs)
        exact = covariance[:, 0, 0, 1] / (covariance[:, 0, 0, 0] * covariance[:, 0, 1, 1]).sqrt()
        values = particles.predict(pairs.flatten(0, 1)).means[:, :, 0].view(-1, len(pairs), 2)
        correlation = [np.corrcoef(values[:, k].T)[0, 1] for k in range(len(pairs))]
        assert np.allclose(correlation, exact, atol=0.25)

    def test_noise_is_close_to_the_measurement_noise(self, target, particles):
        assert torch.allclose(particles.noise_std, target.noise_std, rtol=0.3)
        assert (particles.noise_std**2 >= 0.4999 * target.noise_std**2).all()

    @pytest.mark.usefixtures("particles")
    def test_progress_is_called_every_200_steps(self, steps_done):
        assert steps_done == [200, 400, 600, 800, 1000, 1200, 1400]

    def test_outputs_have_separate_means_standard_deviations_and_noise(self):
        """The first output is a sine with little noise, the second a line with 100 times as much."""
        units = Normaliser(UNITS.input_mean, UNITS.input_std, torch.tensor([0.0, 5.0]), torch.tensor([1.0, 10.0]))
        noise = torch.randn(8, 2, generator=generator(4)) * torch.tensor([0.05, 5.0])
        y = torch.cat([torch.sin(X), 20.0 - 3.0 * X], dim=1) + noise
        target = infer(None, X, y, units, torch.tensor([0.05, 5.0]))
        points = self.query.repeat(10, 1)
        distilled = distil(target, points, replace(SETTINGS, steps=800))
        mean, std = mean_and_scale(target.predict(self.query))
        prediction = distilled.predict(self.query)
        assert ((prediction.mean - mean).abs() < 0.3 * std).all()
        assert torch.allclose(prediction.std, std, rtol=0.25)
        assert torch.allclose(distilled.noise_std, target.noise_std, rtol=0.4)

    def test_warm_start_from_fitted_particles_converges_within_20_steps(self, target, points, particles):
        warm = distil(target, points, replace(SETTINGS, steps=20, learning_rate=1e-4), start=particles.parameters)
        fresh = distil(target, points, replace(SETTINGS, steps=20, learning_rate=1e-4))
        mean, std = mean_and_scale(target.predict(self.query))
        assert ((warm.predict(self.query).mean - mean).abs() < 0.25 * std).all()
        assert ((fresh.predict(self.query).mean - mean).abs() > 0.25 * std).any()

    def test_start_parameters_are_not_modified(self, target, points, particles):
        start = particles.parameters.clone()
        moved = distil(target, points, replace(SETTINGS, steps=5), start=start)
        assert torch.equal(start, particles.parameters)
        assert not torch.equal(start, moved.parameters)

    def test_same_seed_gives_the_same_particles(self, target, points):
        few = replace(SETTINGS, steps=20)
        first, second, other = (distil(target, points, replace(few, seed=s)).parameters for s in (2, 2, 3))
        assert torch.equal(first, second)
        assert not torch.equal(first, other)

    @pytest.mark.parametrize("broken", ["rate", "start"])
    def test_divergence_is_reported(self, target, points, broken):
        settings = replace(SETTINGS, steps=30, learning_rate=1e12 if broken == "rate" else 1e-3)
        start = constant((0.0,), (float("nan"),), hidden=(32, 32)) if broken == "start" else None
        with pytest.raises(DataError, match="smaller learning rate"):
            distil(target, points, settings, start=start)


class TestMeasurementPoints:
    """The data lie near 100, far from the domain; one normalised input unit is 1.5."""

    rows = 100.0 + normal(30, 1).float()

    def test_half_of_the_points_are_near_the_data_and_half_in_the_domain(self):
        sampled_points = measurement_points(RandomLine(), self.rows, UNITS, generator(), count=1001)
        near = sampled_points[:, 0] > 50.0
        assert sampled_points.shape == (1001, 1)
        assert int(near.sum()) == 500
        distance = (sampled_points[near] - self.rows.T).abs().min(dim=1).values
        assert 0.0 < float(distance.max()) < 5.0 * MAX_NEIGHBOUR_DISTANCE * 1.5
        assert sampled_points[~near].min() >= -3.0
        assert sampled_points[~near].max() <= 4.0
        assert float(sampled_points[~near].std()) == pytest.approx(7.0 / np.sqrt(12.0), rel=0.1)

    def test_points_near_data_have_offsets_in_normalised_units(self):
        """Offsets are normal with a uniform scale up to 0.5: their standard deviation is 0.5 / sqrt(3)."""
        units = Normaliser(torch.zeros(4), torch.tensor([1.0, 100.0, 1.0, 1.0]), torch.zeros(1), torch.ones(1))
        row = torch.tensor([[3.0, -70.0, 0.0, 0.0]])
        sampled_points = measurement_points(Pendulum(), row.repeat(25, 1), units, generator(), count=8000)
        offsets = ((sampled_points - row) / units.input_std)[:4000]
        assert torch.allclose(offsets.mean(dim=0), torch.zeros(4), atol=0.02)
        assert torch.allclose(offsets.std(dim=0), torch.full((4,), MAX_NEIGHBOUR_DISTANCE / 3.0**0.5), rtol=0.05)

    @pytest.mark.parametrize("count", [0, 19])
    def test_all_points_are_in_the_domain_with_fewer_than_20_rows(self, count):
        sampled_points = measurement_points(RandomLine(), self.rows[:count], UNITS, generator(), count=64)
        assert sampled_points.shape == (64, 1)
        assert sampled_points.max() <= 4.0
