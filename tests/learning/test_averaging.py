"""Averaging of models by held-out density, against closed forms, quadrature and scipy."""

import numpy as np
import pytest
import torch
from scipy.integrate import quad
from scipy.special import expit
from scipy.stats import norm

from carlab.studies.regression.cases import CASES
from carlab.studies.regression.methods import FitTask
from learning.evaluation import Mixture, WeightedMixture, calibration_error, negative_log_likelihood
from learning.posterior import averaging
from learning.posterior.averaging import average, averaging_weights, held_out_log_densities
from learning.world.car_fit import PRIOR_FUNCTION


class Gaussian:
    """Normal outputs about a constant."""

    def __init__(self, mean, std=1.0):
        self.mean, self.std = mean, std

    def predict(self, inputs):
        return Mixture(torch.full((1, len(inputs), 1), self.mean), torch.full((1, 1, 1), self.std))


def test_weights_of_a_constant_difference_have_a_closed_form():
    """A difference of d in every row does not depend on the bootstrap: the odds are exp(n d)."""
    weights = averaging_weights(torch.tensor([[-1.0] * 4, [-1.3] * 4]))
    assert weights[0].item() == pytest.approx(expit(4 * 0.3), rel=1e-6)
    assert weights.sum().item() == pytest.approx(1.0)


def test_weights_of_two_rows_equal_a_quadrature_over_the_bootstrap():
    """The Dirichlet weight of the first of two rows is uniform."""
    first, second = 1.5, -0.9
    expected, _ = quad(lambda g: expit(2 * (g * first + (1 - g) * second)), 0.0, 1.0)
    weights = averaging_weights(torch.tensor([[first, second], [0.0, 0.0]]))
    assert weights[0].item() == pytest.approx(expected, abs=0.02)


def test_a_model_without_finite_density_has_no_weight():
    weights = averaging_weights(torch.tensor([[-1.0, -1.0], [-1.0, -torch.inf]]))
    assert weights[0].item() == pytest.approx(1.0)


def test_average_density_and_distribution_function_equal_scipy():
    means, stds, weights = (0.0, 2.0), (1.0, 0.5), (0.3, 0.7)
    parts = [Gaussian(m, s).predict(torch.zeros(5, 1)) for m, s in zip(means, stds, strict=True)]
    average_of_both = WeightedMixture(parts, torch.tensor(weights))
    at = np.linspace(-2.0, 3.0, 5)
    targets = torch.from_numpy(at).float()[:, None]
    density, below = (
        sum(w * f(at, m, s) for w, m, s in zip(weights, means, stds, strict=True)) for f in (norm.pdf, norm.cdf)
    )
    assert np.allclose(average_of_both.log_density(targets).numpy(), np.log(density), atol=1e-5)
    assert np.allclose(average_of_both.cdf(targets)[:, 0].numpy(), below, atol=1e-5)
    assert torch.allclose(average_of_both.mean, torch.tensor(1.4))
    assert negative_log_likelihood(average_of_both, targets) == pytest.approx(-np.log(density).mean(), rel=1e-5)
    assert 0.0 <= calibration_error(average_of_both, targets) <= 1.0


def test_rows_are_scored_by_models_that_have_not_seen_them():
    """The fit is the mean of its rows; leave-one-out means of n numbers have a closed form."""
    outputs = torch.randn((7, 1), generator=torch.Generator().manual_seed(0))
    found = held_out_log_densities([lambda x, y: Gaussian(float(y.mean()))], torch.zeros(7, 1), outputs)
    y = outputs[:, 0].numpy()
    assert np.allclose(found[0].numpy(), norm.logpdf(y, (y.sum() - y) / 6.0), atol=1e-5)


def test_average_drops_models_that_the_data_contradict():
    outputs = torch.randn((20, 1), generator=torch.Generator().manual_seed(1))
    fits = [lambda x, y, mean=mean: Gaussian(mean) for mean in (0.0, 9.0)]
    model = average(fits, torch.zeros(20, 1), outputs)
    assert [m.mean for m in model.models] == [0.0]
    assert model.weights.tolist() == [1.0]


@pytest.mark.slow
def test_wrong_structure_falls_back_to_other_models(monkeypatch):
    """A detent is outside the structured family: the average is better than the structured simulator alone."""
    monkeypatch.setattr(averaging, "MAX_FOLDS", 3)
    case = CASES["pendulum_detent"].structured()
    data = case.data(10, 100)
    task = FitTask(case, data, 100, None)
    averaged = negative_log_likelihood(task.average().predict(data.test_inputs), data.test_outputs)
    wrong, none = (
        negative_log_likelihood(
            task.posterior(simulator, data.inputs, data.outputs, size).predict(data.test_inputs), data.test_outputs
        )
        for simulator, size in ((case.prior, None), (None, PRIOR_FUNCTION))
    )
    assert averaged < min(wrong, none) + 0.3
    assert averaged < none - 1.0
