"""Test networks, Stein directions and function priors by autograd, finite differences and closed forms."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.distance import cdist
from torch.distributions import MultivariateNormal

from learning.networks.particles import LEAKY_RELU_SLOPE, Network
from learning.priors.function_prior import RbfCovariance, gaussian_process, simulator_marginal
from learning.stein import RbfKernel, median_bandwidth, natural_direction, stein_direction
from tests.helpers.seeded import generator, normal


class TestNetwork:
    network = Network(3, 2, (8, 5))
    smooth = Network(3, 2, (8, 5), "silu")

    @pytest.mark.parametrize(
        ("network", "activation"), [(network, torch.nn.LeakyReLU(LEAKY_RELU_SLOPE)), (smooth, torch.nn.SiLU())]
    )
    def test_each_particle_equals_a_torch_network(self, network, activation):
        parameters, inputs = network.initial(4, generator()).double(), normal(6, 3)
        outputs, inputs_before = network(parameters, inputs), inputs.clone()
        with torch.no_grad():  # Without autograd the network works in place.
            assert torch.equal(network(parameters, inputs), outputs)
        assert torch.equal(inputs, inputs_before)
        for particle in range(4):
            layers, begin = [], 0
            for fan_in, fan_out in ((3, 8), (8, 5), (5, 2)):
                layer = torch.nn.Linear(fan_in, fan_out).double()
                weights = parameters[particle, begin : begin + fan_in * fan_out].reshape(fan_in, fan_out)
                begin += fan_in * fan_out
                with torch.no_grad():
                    layer.weight.copy_(weights.T)
                    layer.bias.copy_(parameters[particle, begin : begin + fan_out])
                begin += fan_out
                layers += [layer, activation]
            expected = torch.nn.Sequential(*layers[:-1])(inputs)
            assert torch.allclose(outputs[particle], expected, atol=1e-12)
        assert begin == self.network.parameters

    def test_particles_accept_separate_inputs(self):
        parameters, inputs = self.network.initial(4, generator()).double(), normal(4, 6, 3)
        outputs = self.network(parameters, inputs)
        for particle in range(4):
            alone = self.network(parameters[particle : particle + 1], inputs[particle])
            assert torch.allclose(outputs[particle], alone[0], atol=1e-12)

    @pytest.mark.parametrize("network", [network, smooth])
    def test_explicit_gradient_equals_autograd(self, network):
        parameters = network.initial(4, generator()).double().requires_grad_()
        inputs, direction = normal(6, 3).requires_grad_(), normal(4, 6, 2, seed=1)
        (network(parameters, inputs) * direction).sum().backward()
        with torch.no_grad():
            outputs, pullback = network.values_and_pullback(parameters, inputs)
            by_parameters, by_parameters_first = pullback(direction), pullback.of_first(2)(direction[:, :2])
            by_input = pullback.on_inputs(direction).sum(dim=0)
        assert torch.allclose(outputs, network(parameters, inputs), atol=1e-12)
        assert torch.allclose(by_parameters, parameters.grad, atol=1e-12)
        assert torch.allclose(by_input, inputs.grad, atol=1e-12)
        parameters.grad = None
        (network(parameters, inputs[:2]) * direction[:, :2]).sum().backward()
        assert torch.allclose(by_parameters_first, parameters.grad, atol=1e-12)

    def test_initial_particles_differ_and_are_reproducible(self):
        first, second = self.network.initial(3, generator(4)), self.network.initial(3, generator(4))
        assert torch.equal(first, second)
        assert not torch.equal(first[0], first[1])

    def test_initial_weights_preserve_the_variance_through_layers(self):
        """He et al. 2015: the variance of a layer's output is that of its input."""
        deep = Network(64, 64, (64,) * 8)
        out = deep(deep.initial(20, generator()), torch.randn(256, 64, generator=generator(1)))
        assert 0.3 < float(out.std()) < 3.0


class TestStein:
    def test_kernel_equals_scipy(self):
        values = normal(5, 7)
        expected = np.exp(-0.5 * cdist(values, values, "sqeuclidean") / 1.7**2)
        assert np.allclose(RbfKernel(1.7)(values), expected, atol=1e-12)

    def test_repulsion_equals_finite_differences_of_the_kernel(self):
        values, kernel, step = normal(4, 3), RbfKernel(1.3), 1e-6
        repulsion = kernel.repulsion(values, kernel(values))
        for which in range(4):
            for k in range(3):
                total = 0.0
                for i in range(4):
                    up, down = values[i].clone(), values[i].clone()
                    up[k] += step
                    down[k] -= step
                    kernel_values = [
                        math.exp(-0.5 * float(((v - values[which]) ** 2).sum()) / 1.3**2) for v in (up, down)
                    ]
                    total += (kernel_values[0] - kernel_values[1]) / (2 * step)
                assert float(repulsion[which, k]) == pytest.approx(total, abs=1e-7)

    def test_kernel_of_close_particles_is_exact_in_single_precision(self):
        """The distances are a thousandth of the common value."""
        values, kernel = 10.0 + 0.01 * normal(10, 336), RbfKernel(0.1)
        single, matrix = values.float(), kernel(values.float())
        exact = kernel(single.double())
        assert torch.allclose(matrix.double(), exact, rtol=1e-4, atol=1e-6)
        repulsion = kernel.repulsion(single, matrix).double()
        assert torch.allclose(repulsion, kernel.repulsion(single.double(), exact), rtol=1e-3, atol=1e-4)

    def test_direction_of_one_particle_is_its_score(self):
        values, score = normal(1, 4, 2), normal(1, 4, 2, seed=1)
        assert torch.allclose(stein_direction(values, score, RbfKernel(0.7)), score)

    def test_natural_direction_of_one_particle_is_a_newton_step(self):
        """One step reaches the mean of an ill-conditioned Gaussian."""
        root = torch.tensor([[1.0, 0, 0], [0.9, 1e-3, 0], [-0.3, 0.4, 0.7]], dtype=torch.float64)
        precision = torch.linalg.inv(root @ root.T)
        values, mean = normal(1, 3, 1), normal(3, 1, seed=1)
        score = -(precision @ (values - mean)[0])[None]
        step = natural_direction(values, score, precision[None], RbfKernel(1.0))
        assert torch.allclose(values + step, mean[None], atol=1e-6)

    def test_particles_converge_to_the_moments_of_a_gaussian(self):
        """The target is a correlated Gaussian in three dimensions."""
        root = torch.tensor([[1.0, 0, 0], [0.8, 0.6, 0], [-0.3, 0.4, 0.7]], dtype=torch.float64)
        covariance, mean = root @ root.T, torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
        values = 0.3 * normal(150, 3)
        precision = torch.linalg.inv(covariance)
        for _ in range(1500):
            kernel = RbfKernel(median_bandwidth(values))
            values = values + 0.3 * stein_direction(values, -(values - mean) @ precision, kernel)
        assert torch.allclose(values.mean(dim=0), mean, atol=0.02)
        assert torch.allclose(torch.cov(values.T), covariance, atol=0.12)


class TestPriors:
    inputs = normal(6, 2)
    covariance = RbfCovariance((0.7, 1.9), (0.8, 1.5))

    def test_gaussian_process_prior_has_the_score_of_its_marginal(self):
        values = normal(3, 6, 2, seed=2).requires_grad_()
        prior = gaussian_process(self.inputs, self.covariance, jitter=1e-3)
        scaled = (self.inputs / torch.tensor([0.8, 1.5])).numpy()
        shape = torch.from_numpy(np.exp(-0.5 * cdist(scaled, scaled, "sqeuclidean")))
        for k, scale in enumerate((0.7, 1.9)):
            marginal = MultivariateNormal(torch.zeros(6).double(), scale**2 * shape + 1e-3 * torch.eye(6))
            marginal.log_prob(values[:, :, k]).sum().backward()
        assert torch.allclose(prior.score(values.detach()), values.grad, atol=1e-8)

    def test_linear_simulator_prior_has_its_closed_form_score(self):
        """For y = a x + b with Gaussian a, b the marginal has covariance ``x x' s_a^2 + s_b^2``."""
        draws = normal(40_000, 2) * torch.tensor([0.5, 0.2]) + torch.tensor([1.0, -0.3])
        x = self.inputs[:, :1]
        outputs = (draws[:, None, :1] * x + draws[:, None, 1:]).view(-1, 6, 1)
        discrepancy = RbfCovariance((0.3,), (1.0, 1.0))
        prior = simulator_marginal(outputs, self.inputs, discrepancy, jitter=0.05)
        distance = cdist(self.inputs, self.inputs, "sqeuclidean")
        exact = 0.25 * (x @ x.T).numpy() + 0.04 + 0.09 * np.exp(-0.5 * distance) + 0.05 * np.eye(6)
        values = normal(3, 6, 1, seed=3)
        centred = values[:, :, 0].numpy() - (1.0 * x[:, 0].numpy() - 0.3)
        assert np.allclose(prior.score(values)[:, :, 0], -np.linalg.solve(exact, centred.T).T, rtol=0.05, atol=0.05)

    def test_particles_reach_the_posterior_of_bayesian_linear_regression(self):
        """Function-space particles with the exact prior score converge to the conjugate posterior."""
        x = torch.linspace(-1, 1, 5, dtype=torch.float64)[:, None]
        features = torch.cat([x, torch.ones_like(x)], dim=1)
        noise, observed = 0.3, torch.tensor([-0.9, 0.2, 1.4], dtype=torch.float64)
        measured = [0, 2, 4]
        prior = features @ features.T + 0.3**2 * torch.eye(5, dtype=torch.float64)
        pick = torch.eye(5, dtype=torch.float64)[measured]
        gain = prior @ pick.T @ torch.linalg.inv(pick @ prior @ pick.T + noise**2 * torch.eye(3, dtype=torch.float64))
        mean, covariance = gain @ observed, prior - gain @ pick @ prior
        values = normal(120, 5)
        precision = torch.linalg.inv(prior)
        for _ in range(1500):
            score = -values @ precision
            score[:, measured] += (observed - values[:, measured]) / noise**2
            kernel = RbfKernel(median_bandwidth(values))
            values = values + 0.03 * stein_direction(values[:, :, None], score[:, :, None], kernel)[:, :, 0]
        assert torch.allclose(values.mean(dim=0), mean, atol=0.05)
        assert torch.allclose(values.var(dim=0), covariance.diagonal(), rtol=0.35)
