"""Test the noise of consecutive steps against differences of measurements, automatic derivatives and a known system."""

import numpy as np
import pytest
import torch

from carlab.core.episode_data import EpisodeData
from learning.networks.normaliser import Normaliser
from learning.posterior.inference import infer
from learning.posterior.row_noise import BLOCK_ROWS, MAX_SHARE, RowNoise, random_rows
from learning.priors.simulator_model import CarModel
from learning.transitions import transitions_of
from learning.world import car_fit
from sim_backends.car_parameters import SimulatorConfig

STEPS = torch.tensor([3, 4, 5, 6, 9, 10, 20])
"""Steps of drives with four, two and one consecutive rows."""


def noise(share=0.6, steps=STEPS):
    return RowNoise(torch.tensor([0.5, 2.0]).double(), torch.tensor([share, 0.0]).double(), steps)


def test_covariance_equals_that_of_differences_of_measurements():
    """Measurements 3 to 7, 9 to 11, 20 and 21 have variance r, and each step has a disturbance of variance q."""
    r, q = 0.03, 0.04
    times = [3, 4, 5, 6, 7, 9, 10, 11, 20, 21]
    difference = np.array([[(t == s + 1) * 1.0 - (t == s) for t in times] for s in STEPS.tolist()])
    expected = r * difference @ difference.T + q * np.eye(len(STEPS))
    total = 2 * r + q
    found = RowNoise(torch.tensor([total**0.5]), torch.tensor([2 * r / total]), STEPS).covariance(torch.ones(7))
    assert np.allclose(found[0], expected, atol=1e-7)


def test_order_of_rows_does_not_matter():
    order = torch.tensor([5, 0, 3, 6, 2, 1, 4])
    weights = torch.linspace(0.2, 1.0, 7).double()
    whole = noise().covariance(weights)
    assert torch.equal(noise().take(order).covariance(weights[order]), whole[:, order][:, :, order])


def test_gradients_equal_automatic_derivatives():
    generator = torch.Generator().manual_seed(0)
    weights = torch.rand(7, generator=generator).double()
    gradient = torch.randn((2, 7, 7), generator=generator).double()
    gradient = gradient + gradient.mT
    logs = [torch.randn(2, generator=generator).double().requires_grad_() for _ in range(2)]
    model = RowNoise.of_logs(logs, STEPS)
    expected = torch.autograd.grad((gradient * model.covariance(weights)).sum(), logs)
    for found, derivative in zip(model.log_gradients(gradient, weights), expected, strict=True):
        assert torch.allclose(found, derivative)


def smooth_covariance(n):
    """Covariances (2, n, n) of smooth functions at random places."""
    x = np.random.default_rng(1).uniform(-2, 2, n)
    shape = np.exp(-0.5 * (x[:, None] - x) ** 2)
    return np.stack([shape, 0.3 * shape**4])


@pytest.mark.parametrize("steps", [STEPS, None])
@pytest.mark.parametrize("equal_weights", [True, False])
def test_leave_one_out_errors_equal_predictions_from_the_other_rows(steps, equal_weights):
    """The conditional mean of the function given the other rows, and the variance of the error from joint Gaussians.

    The row itself has weight 1 in the variance.
    """
    n, model = len(STEPS), noise(steps=steps)
    rng = np.random.default_rng(2)
    weights = np.ones(n) if equal_weights else rng.uniform(0.2, 1.0, n)
    function, residual = smooth_covariance(n), rng.normal(size=(n, 2))
    of_noise = model.covariance(torch.tensor(weights)).numpy()
    found, variances = model.leave_one_out(
        torch.tensor(residual), torch.tensor(function + of_noise), torch.tensor(weights)
    )
    for k in range(2):
        for row in range(n):
            others = np.arange(n) != row
            at_one = weights.copy()
            at_one[row] = 1.0
            noise_at_one = model.covariance(torch.tensor(at_one)).numpy()[k]
            gain = np.linalg.solve((function + of_noise)[k][np.ix_(others, others)], function[k][others, row])
            # The error is a combination of function and noise at all rows.
            combination = np.zeros(n)
            combination[row], combination[others] = 1.0, -gain
            variance = combination @ (function[k] + noise_at_one) @ combination
            assert float(variances[row, k]) == pytest.approx(variance, rel=1e-9)
            error = combination @ residual[:, k]
            assert float(found[row, k]) == pytest.approx(error / np.sqrt(variance))


def test_covariance_of_a_long_drive_is_positive_definite_at_the_largest_share():
    model = noise(MAX_SHARE, torch.arange(1000))
    assert float(torch.linalg.eigvalsh(model.covariance(torch.ones(1000).double())[0])[0]) > 0.01 * 0.25


class TestRandomRows:
    def test_are_blocks_of_consecutive_steps(self):
        steps = torch.randperm(400, generator=torch.Generator().manual_seed(1))
        rows = random_rows(400, 200, steps, torch.Generator().manual_seed(2))
        assert len(set(rows.tolist())) == 200
        for block in steps[rows].split(BLOCK_ROWS):
            assert torch.equal(block, block[0] + torch.arange(BLOCK_ROWS))

    def test_differ_by_seed(self):
        first, second = (random_rows(400, 50, torch.arange(400), torch.Generator().manual_seed(k)) for k in (0, 1))
        assert not torch.equal(first, second)

    def test_are_all_rows_if_these_are_few(self):
        assert sorted(random_rows(30, 200, torch.arange(30), torch.Generator()).tolist()) == list(range(30))


UNITS = Normaliser(torch.zeros(2), torch.ones(2), torch.zeros(1), torch.tensor([0.3]))


def slope(steps, seed):
    """Slope on the velocity that a regression finds for ``v' = v + 0.3 (u - v)``, from noisy v and commands near 0.3.

    The noise of v is five times its standard deviation.
    """
    rng = np.random.default_rng(seed)
    command = 0.3 + 0.05 * rng.standard_normal(300)
    velocity = [0.3]
    for u in command:
        velocity.append(velocity[-1] + 0.3 * (u - velocity[-1]))
    measured = np.array(velocity) + 0.1 * rng.standard_normal(301)
    inputs = torch.tensor(np.stack([measured[:-1], command], axis=1)).float()
    posterior = infer(
        None, inputs, torch.tensor(np.diff(measured)[:, None]).float(), UNITS, torch.tensor([0.1]),
        discrepancy_std=torch.tensor([0.3]), step_numbers=steps, restart_scales=(1.0,),
    )  # fmt: skip
    mean = posterior.predict(torch.tensor([[0.8, 0.3], [-0.2, 0.3]])).means[0, :, 0]
    return float(mean[0] - mean[1])


def test_noise_of_the_inputs_is_not_taken_for_a_slope():
    """The true slope is -0.3; a regression with independent noise finds a slope near -1."""
    with_steps = [slope(torch.arange(300), seed) for seed in range(3)]
    independent = [slope(None, seed) for seed in range(3)]
    assert np.mean(independent) < -0.75
    assert np.mean(with_steps) == pytest.approx(-0.3, abs=0.15)


class InferenceReached(Exception):
    """The fit of a car has called the inference."""


def test_fit_of_a_car_states_which_rows_are_consecutive_steps(monkeypatch):
    """Where step numbers differ by 1, the velocities after the first row are those before the second."""
    given = {}

    def infer_rows(model, inputs, outputs, *arguments, step_numbers, **options):
        given.update(inputs=inputs, outputs=outputs, step_numbers=step_numbers)
        raise InferenceReached

    monkeypatch.setattr(car_fit, "infer", infer_rows)
    rng = np.random.default_rng(4)
    drives = [
        EpisodeData(np.arange(601) / 30.0, rng.normal(size=(601, 6)), sent, sent, np.zeros(600))
        for sent in rng.uniform(-1.0, 1.0, (2, 600, 2))
    ]
    model = CarModel(SimulatorConfig(), 1, {"motor.drive_gain": (5.0, 12.0)})
    with pytest.raises(InferenceReached):
        car_fit.fit_car(transitions_of(drives, 1), model, car_fit.CarFitSettings())
    inputs, outputs, numbers = given["inputs"], given["outputs"], given["step_numbers"]
    assert len(numbers) == car_fit.MAX_ROWS
    order = numbers.argsort()
    consecutive = numbers[order].diff() == 1
    assert int(consecutive.sum()) >= car_fit.MAX_ROWS * (1 - 1 / BLOCK_ROWS) - 2
    before, after = order[:-1][consecutive], order[1:][consecutive]
    assert torch.allclose(inputs[before, :3] + outputs[before, 3:], inputs[after, :3], atol=1e-5)
