"""The posterior over functions against Gaussian processes in numpy, which it is for a linear simulator."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from gaussian_process_reference import discrepancy_alone, raw_noise, simulator_and_discrepancy
from linear_simulator import EMPTY, NOISE, UNITS, Linear, features, rows, tensors, truth
from scipy.stats import multivariate_normal, norm
from scipy.stats import t as student

from learning.evaluation import negative_log_likelihood
from learning.posterior import inference
from learning.posterior.discrepancy import PRIOR_DISCREPANCY_STD, PRIOR_LENGTHSCALE
from learning.posterior.inference import PARAMETER_DRAWS, infer


@pytest.fixture(scope="module")
def found():
    """Without a simulator."""
    return infer(None, TestWithoutSimulator.x, TestWithoutSimulator.y, UNITS, NOISE)


class TestWithoutSimulator:
    """The exact Gaussian process with the covariance that was found."""

    x, y = rows(30)

    def test_predictions_are_the_gaussian_processs(self, found):
        at, _ = rows(1500, seed=1)
        mean, std = found.predict(at)
        theirs, exact, _ = discrepancy_alone(self.x, self.y, at, found.discrepancy, raw_noise(found))
        assert np.allclose(mean, theirs, atol=2e-5)
        assert np.allclose(std, exact, rtol=1e-5)

    def test_marginals_are_the_gaussian_processs(self, found):
        at, _ = rows(35, seed=2)
        means, covariances = found.marginals(at.view(7, 5, 2))
        units = UNITS.output_std.numpy()
        for k in range(7):
            mean, _, exact = discrepancy_alone(
                self.x, self.y, at[5 * k : 5 * k + 5], found.discrepancy, raw_noise(found)
            )
            assert np.allclose(means[k].numpy().T * units + UNITS.output_mean.numpy(), mean, atol=2e-5)
            assert np.allclose(covariances[k], exact / units[:, None, None] ** 2, atol=2e-5)

    def test_its_prediction_is_near_the_truth_where_there_are_rows(self, found):
        """A function of size 2 and 0.6, seen through noise of 0.2 and 0.1."""
        at, _ = rows(200, seed=3)
        error = found.predict(at)[0].numpy() - truth(at)
        assert (np.sqrt((error**2).mean(axis=0)) < [0.4, 0.15]).all()


def over_seeds(x, y, at, count, **settings):
    """Errors of mean (count, M, 2) in exact standard deviations of the function, and ratios of the variances."""
    off, ratios = [], []
    for seed in range(count):
        found = infer(Linear(), x, y, UNITS, NOISE, seed=seed, **settings)
        mean, std = found.predict(at)
        theirs, exact, _ = simulator_and_discrepancy(x, y, at, found.discrepancy, raw_noise(found), found.parameters)
        own, wanted = (v**2 - raw_noise(found) ** 2 for v in (std.double().numpy(), exact))
        off.append((mean.numpy() - theirs) / np.sqrt(wanted))
        ratios.append(own / wanted)
    return np.stack(off), np.stack(ratios)


class TestWithSimulator:
    at, _ = rows(40, seed=1)

    @pytest.mark.parametrize(
        "settings",
        [{}, {"discrepancy_std": torch.tensor([0.1, 0.03])}, {"with_discrepancy": False, "noise_known": True}],
    )
    def test_it_is_the_gaussian_process_of_simulator_and_discrepancy(self, settings):
        """Within the error of 128 draws of the parameters, and closer on the average of six seeds."""
        off, ratios = over_seeds(*rows(12), self.at, 6, **settings)
        assert np.abs(off).max() < 4.0 / math.sqrt(PARAMETER_DRAWS)
        assert np.abs(ratios - 1.0).max() < 4.5 * math.sqrt(2.0 / PARAMETER_DRAWS)
        assert np.abs(off.mean(axis=0)).max() < 2.0 / math.sqrt(PARAMETER_DRAWS)
        assert np.abs(ratios.mean(axis=0) - 1.0).max() < 2.0 * math.sqrt(2.0 / PARAMETER_DRAWS)

    def test_marginals_are_those_of_the_same_process(self):
        x, y = rows(12)
        found = infer(Linear(), x, y, UNITS, NOISE)
        means, covariances = found.marginals(self.at[:20].view(4, 5, 2))
        units = UNITS.output_std.numpy()
        for k in range(4):
            mean, _, exact = simulator_and_discrepancy(
                x, y, self.at[5 * k : 5 * k + 5], found.discrepancy, raw_noise(found), found.parameters
            )
            exact = exact / units[:, None, None] ** 2
            std = np.sqrt(exact.diagonal(axis1=1, axis2=2))
            assert (np.abs(means[k].numpy().T * units + UNITS.output_mean.numpy() - mean) / units < 0.35 * std.T).all()
            scaled = (covariances[k].numpy() - exact) / (std[:, :, None] * std[:, None, :])
            assert np.abs(scaled).max() < 0.5

    def test_known_noise_without_discrepancy_stays(self):
        found = infer(Linear(), *rows(12), UNITS, NOISE, with_discrepancy=False, noise_known=True)
        assert found.discrepancy is None
        assert np.allclose(raw_noise(found), NOISE)
        assert math.isinf(found.dof)

    def test_without_a_gap_what_no_parameters_explain_is_noise(self):
        """Least squares' own estimate of it, on rows with waves that the simulator cannot make, and on rows without."""
        x, wrong = rows(30)
        (right,) = tensors((features(x) @ np.array([0.8, -1.1, 0.4])).T)
        right += NOISE * torch.randn(right.shape, generator=torch.Generator().manual_seed(1))
        for y in (right, wrong):
            found = infer(Linear(), x, y, UNITS, NOISE, with_discrepancy=False)
            a, b = features(x).reshape(-1, 3), y.double().numpy().T.reshape(-1)
            left = (b - a @ np.linalg.lstsq(a, b, rcond=None)[0]).reshape(2, -1)
            theirs = np.sqrt((left**2).sum(axis=1) / (30 - 1.5))
            assert np.allclose(raw_noise(found), theirs, rtol=0.35)

    def test_every_one_of_many_rows_tells_of_the_parameters(self):
        """Of 700 rows the linear simulator's posterior is the conjugate one: with fewer it would be wider."""
        x, _ = rows(700)
        rng = np.random.default_rng(6)
        shape = features(x)
        y = (shape @ np.array([0.8, -1.1, 0.4])).T + NOISE.numpy() * rng.normal(size=(700, 2))
        parameters = [
            infer(Linear(), x, *tensors(y), UNITS, NOISE, with_discrepancy=False, noise_known=True, seed=s).parameters
            for s in range(3)
        ]
        scaled = np.concatenate([shape[k] / NOISE.double().numpy()[k] for k in range(2)])
        wanted = np.concatenate([y[:, k] / NOISE.double().numpy()[k] for k in range(2)])
        covariance = np.linalg.inv(np.eye(3) + scaled.T @ scaled)
        draws = torch.cat(parameters).double().numpy()
        std = np.sqrt(np.diag(covariance))
        assert np.allclose(draws.std(axis=0), std, rtol=0.2)
        assert np.allclose((draws.mean(axis=0) - covariance @ scaled.T @ wanted) / std, 0.0, atol=0.3)

    def test_of_a_right_simulator_the_gap_is_smaller(self):
        """Rows of the simulator itself, and rows with waves that it cannot make."""
        x, wrong = rows(100)
        (right,) = tensors((features(x) @ np.array([0.8, -1.1, 0.4])).T)
        right += NOISE * torch.randn(right.shape, generator=torch.Generator().manual_seed(1))
        small, large = (infer(Linear(), x, y, UNITS, NOISE).discrepancy.scales for y in (right, wrong))
        assert (small < 0.7 * large).all()
        assert (small < PRIOR_DISCREPANCY_STD).all()


class TestWithoutRows:
    at, _ = rows(10, seed=1)

    @pytest.mark.parametrize("expected", [None, torch.tensor([0.3, 0.7])])
    def test_it_is_the_simulators_draws_and_the_prior_discrepancy(self, expected):
        found = infer(Linear(), EMPTY, EMPTY, UNITS, NOISE, discrepancy_std=expected)
        means, covariances = found.marginals(self.at.view(2, 5, 2))
        assert found.parameters.shape == (PARAMETER_DRAWS, 3)
        drawn = np.einsum("onk,pk->pon", features(self.at), found.parameters.double().numpy())
        drawn = (drawn - UNITS.output_mean.numpy()[:, None]) / UNITS.output_std.numpy()[:, None]
        size = [PRIOR_DISCREPANCY_STD] * 2 if expected is None else (expected / UNITS.output_std).tolist()
        x = (self.at.double().numpy() - UNITS.input_mean.numpy()) / UNITS.input_std.numpy()
        distance = ((x[:, None] - x[None]) ** 2).sum(axis=2)
        for k in range(2):
            near, own = np.exp(-0.5 * distance / PRIOR_LENGTHSCALE**2), drawn[:, k].mean(axis=0)
            of_discrepancy = size[k] ** 2 * (near + x @ x.T / 2 + 1.0 + own[:, None] * own * near)
            exact = np.cov(drawn[:, k].T, bias=True) + of_discrepancy
            assert np.allclose(means[:, k].flatten(), drawn[:, k].mean(axis=0), atol=1e-5)
            for b in range(2):
                some = slice(5 * b, 5 * b + 5)
                assert np.allclose(covariances[b, k], exact[some, some], atol=1e-4)

    def test_draws_of_the_parameters_are_the_priors(self):
        mean, std = infer(Linear(), EMPTY, EMPTY, UNITS, NOISE, with_discrepancy=False).predict(self.at)
        exact = np.sqrt((features(self.at) ** 2).sum(axis=2).T + NOISE.numpy() ** 2)
        assert np.abs(mean.numpy() / exact).max() < 4.0 / math.sqrt(PARAMETER_DRAWS)
        assert np.allclose(std, exact, rtol=4.0 / math.sqrt(2.0 * PARAMETER_DRAWS))


class TestOutliers:
    """Four rows of a hundred are off by some thirty, or three hundred, times the noise."""

    noise = torch.tensor([0.1, 0.05])
    x, y = rows(100, noise=noise)
    at, _ = rows(200, seed=5)

    def spoilt(self, size):
        off = torch.tensor([[1.0, 0.3], [-1.0, 0.25], [1.2, -0.25], [0.9, -0.3]])
        return self.y.index_add(0, torch.tensor([3, 30, 60, 90]), size * off)

    def error(self, mean):
        return np.sqrt(((np.asarray(mean) - truth(self.at)) ** 2).mean(axis=0))

    @pytest.mark.parametrize("model", [None, Linear()])
    @pytest.mark.parametrize("size", [3.0, 30.0])
    def test_they_hardly_move_the_prediction(self, model, size):
        """An ordinary Gaussian process with the same covariance follows them."""
        y = self.spoilt(size)
        found, clean = (infer(model, self.x, v, UNITS, self.noise) for v in (y, self.y))
        ours = self.error(found.predict(self.at)[0])
        assert (ours < self.error(clean.predict(self.at)[0]) + 0.2 * self.noise.numpy()).all()
        assert found.dof < 10.0
        assert np.allclose(raw_noise(found), self.noise, rtol=0.5)
        ordinary = simulator_and_discrepancy if model else discrepancy_alone
        theirs = ordinary(self.x, y, self.at, found.discrepancy, raw_noise(found))[0]
        assert (self.error(theirs) > 3.0 * ours).all()

    def test_few_rows_keep_gaussian_weights_with_outliers(self):
        found, clean = (infer(None, self.x[:39], v[:39], UNITS, self.noise) for v in (self.spoilt(3.0), self.y))
        assert found.dof == clean.dof


class TestCorrelatedErrors:
    """Errors of the second output follow those of the first, as a step's do the velocity's at its end."""

    def both(self, count, seed, tied):
        rng = np.random.default_rng(seed)
        x = np.stack([rng.uniform(-3, 4, count), rng.uniform(-2, 0, count)], axis=1)
        first, second = rng.normal(size=(2, count))
        second = tied * first + math.sqrt(1.0 - tied**2) * second
        return tensors(x, truth(x) + 2.0 * NOISE.numpy() * np.stack([first, second], axis=1))

    def gained(self, monkeypatch, model, tied, count=300):
        """Nats a row of others by knowing, and the prediction."""
        x, y = self.both(count, 0, tied)
        found = infer(model, x, y, UNITS, 2.0 * NOISE)
        monkeypatch.setattr(inference, "output_correlation", lambda w: (torch.eye(2).double(), torch.ones(2)))
        apart = infer(model, x, y, UNITS, 2.0 * NOISE)
        at, seen = self.both(500, 1, tied)
        joint, independent = (float(f.prediction(at).log_density(seen).mean()) for f in (found, apart))
        return joint - independent, found.prediction(at)

    @pytest.mark.slow
    @pytest.mark.parametrize("count", [300, 600])
    def test_held_out_rows_gain_the_mutual_information_of_the_outputs(self, monkeypatch, count):
        """Mutual information of two Gaussians, ``-log(1 - r^2) / 2``, less what the function's uncertainty hides.

        Of as many rows as a step of the search sees, and of twice as many.
        """
        tied = 0.98
        shared = -0.5 * math.log(1.0 - tied**2)
        gained, prediction = self.gained(monkeypatch, Linear(), tied, count)
        assert 0.7 * shared < gained < 1.1 * shared
        back = np.linalg.inv(prediction.decorrelation.double().numpy())
        scale = prediction.stds[0].median(dim=0).values.double().numpy()
        shape = back @ (scale[:, None] * prediction.correlation.double().numpy() * scale) @ back.T
        assert shape[0, 1] / np.sqrt(shape[0, 0] * shape[1, 1]) == pytest.approx(tied, abs=0.03)

    @pytest.mark.slow
    def test_errors_that_are_independent_cost_next_to_nothing(self, monkeypatch):
        gained, _ = self.gained(monkeypatch, None, 0.0)
        assert abs(gained) < 0.03


class TestRestarts:
    """The evidence has several optima; the leave-one-out density chooses."""

    @pytest.mark.parametrize(
        ("model", "expected"), [(None, 0.01), (None, PRIOR_DISCREPANCY_STD), (Linear(), PRIOR_DISCREPANCY_STD)], ids=str
    )
    def test_restarts_raise_the_density_of_held_out_rows(self, model, expected):
        """Over three draws of sixty rows, and lower in none of them."""
        gained = []
        for seed in range(3):
            at, y = rows(300, 100 + seed)
            one, several = (
                infer(
                    model,
                    *rows(60, seed),
                    UNITS,
                    NOISE,
                    discrepancy_std=expected * UNITS.output_std,
                    seed=seed,
                    **restart_scales,
                )
                for restart_scales in ({"restart_scales": (1.0,)}, {})
            )
            before, after = (negative_log_likelihood(found.prediction(at), y) for found in (one, several))
            gained.append(before - after)
        assert min(gained) > -0.02
        assert np.mean(gained) > 0.3

    def test_densities_of_decorrelated_outputs_differ_by_the_log_determinant(self):
        """Errors of a normal distribution and the same ones transformed twice, by scipy."""
        rng = np.random.default_rng(4)
        first, second, root = rng.normal(size=(3, 2, 2))
        units = UNITS.decorrelated(torch.tensor(first)).decorrelated(torch.tensor(second))
        decorrelation, spread = second @ first, root @ root.T + np.eye(2)
        alone = rng.normal(size=(5, 2))
        joint = multivariate_normal(cov=spread).logpdf(alone)
        there = multivariate_normal(cov=decorrelation @ spread @ decorrelation.T).logpdf(alone @ decorrelation.T)
        assert np.allclose(there + units.decorrelation_log_det, joint)
        assert UNITS.decorrelation_log_det == 0.0

    def test_a_restart_without_a_computable_covariance_is_skipped(self):
        x, y = rows(50)
        at, _ = rows(5, seed=1)
        first, both = (infer(None, x, y, UNITS, NOISE, restart_scales=s).predict(at) for s in ((1.0,), (1.0, math.nan)))
        assert torch.equal(first[0], both[0])
        assert torch.equal(first[1], both[1])


class TestFewRows:
    """A covariance fitted to few rows is uncertain."""

    def test_predictions_have_heavy_tails_where_it_is_learned(self):
        x, y = rows(15)
        assert infer(None, x, y, UNITS, NOISE).dof < 10.0
        assert infer(Linear(), x, y, UNITS, NOISE, with_discrepancy=False).dof < 10.0
        assert math.isinf(infer(Linear(), x, y, UNITS, NOISE, with_discrepancy=False, noise_known=True).dof)
        assert math.isinf(infer(Linear(), EMPTY, EMPTY, UNITS, NOISE).dof)

    def test_heavy_tails_raise_the_density_of_held_out_rows(self):
        """Over eight draws of twelve rows, of their marginal densities by scipy."""
        gained = []
        for seed in range(8):
            found = infer(None, *rows(12, seed), UNITS, NOISE, seed=seed)
            x, y = rows(200, 100 + seed)
            mean, std = (v.double().numpy() for v in found.predict(x))
            off = (y.double().numpy() - mean) / std
            gained.append((student(found.dof).logpdf(off) - norm.logpdf(off)).mean())
        assert np.mean(gained) > 0.02


def test_the_same_seed_gives_the_same_numbers():
    at, _ = rows(5, seed=1)
    first, second, other = (infer(Linear(), *rows(8), UNITS, NOISE, seed=s).predict(at) for s in (2, 2, 3))
    assert torch.equal(first[0], second[0])
    assert torch.equal(first[1], second[1])
    assert not torch.equal(first[0], other[0])


def test_of_too_many_rows_some_are_taken(monkeypatch):
    monkeypatch.setattr(inference, "MAX_ROWS", 25)
    x, y = rows(60)
    found = infer(None, x, y, UNITS, NOISE)
    places = UNITS.inputs(x).double()
    taken = [int((places == row).all(dim=1).nonzero().item()) for row in found.inputs]
    assert len(set(taken)) == 25
    at, _ = rows(10, seed=1)
    theirs, _, _ = discrepancy_alone(x[taken], y[taken], at, found.discrepancy, raw_noise(found))
    assert np.allclose(found.predict(at)[0], theirs, atol=2e-5)
