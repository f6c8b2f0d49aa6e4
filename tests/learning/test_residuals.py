"""Test residual distributions against scipy, and with few rows."""

import math

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_t, norm

from carlab.core.errors import DataError
from learning.evaluation import negative_log_likelihood
from learning.posterior.residuals import fit_residuals

SHAPE = np.array([[1.0, 0.9, 0.0], [0.9, 1.0, -0.3], [0.0, -0.3, 1.0]])
SIZE = np.array([0.5, 2.0, 0.01])
TRUE = SHAPE * SIZE[:, None] * SIZE


def drawn(rows, dof, seed=0):
    return torch.tensor(multivariate_t(np.zeros(3), TRUE, df=dof).rvs(rows, random_state=seed))


@pytest.mark.parametrize("dof", [3.0, 1e9])
def test_fit_recovers_the_true_distribution(dof):
    found = fit_residuals(drawn(4000, dof))
    assert found.scale.numpy() == pytest.approx(SIZE, rel=0.07)
    size = SIZE[:, None] * SIZE
    assert (found.factor @ found.factor.T).numpy() / size == pytest.approx(SHAPE, abs=0.1)
    assert found.dof == 3.0 if dof == 3.0 else found.dof >= 20.0


def test_likelihood_around_a_mean_equals_scipy():
    found = fit_residuals(drawn(200, 4.0))
    means, targets = torch.randn((1, 50, 3), generator=torch.Generator().manual_seed(0)).double(), drawn(50, 4.0, 1)
    expected = multivariate_t(np.zeros(3), (found.factor @ found.factor.T).numpy(), df=found.dof)
    nll = negative_log_likelihood(found.centred_at(means), targets)
    assert nll == pytest.approx(-expected.logpdf((targets - means[0]).numpy()).mean(), rel=1e-9)
    assert float(found.mahalanobis_sq(targets)[0]) == pytest.approx(
        float(targets[0] @ torch.linalg.inv(found.factor @ found.factor.T) @ targets[0])
    )


@pytest.mark.parametrize("rows", [30, 200])
def test_fit_loses_little_held_out_density_against_the_truth(rows):
    """The fit also has a much higher density than independent normal errors."""
    held_out, losses, gains = drawn(20_000, 3.0, 99), [], []
    truth = -multivariate_t(np.zeros(3), TRUE, df=3.0).logpdf(held_out.numpy()).mean()
    for seed in range(4):
        errors = drawn(rows, 3.0, seed)
        centred = fit_residuals(errors).centred_at(torch.zeros((1, len(held_out), 3)).double())
        nll = negative_log_likelihood(centred, held_out)
        losses.append(nll - truth)
        gains.append(-norm(0.0, errors.numpy().std(axis=0)).logpdf(held_out.numpy()).sum(axis=1).mean() - nll)
    assert 0.0 < np.mean(losses) < (0.4 if rows == 30 else 0.04)
    assert np.mean(gains) > 0.8


def test_few_rows_keep_the_prior_scale():
    """Two rows with zero residuals keep the expected noise, with heavy tails."""
    zero_residuals = torch.zeros((2, 3)).double()
    found = fit_residuals(zero_residuals, torch.tensor([0.1, 0.2, 0.3]))
    assert 2.5 <= found.dof <= 3.0
    assert found.scale.numpy() == pytest.approx(np.array([0.1, 0.2, 0.3]) / math.sqrt(3.0), rel=0.35)
    assert (fit_residuals(zero_residuals, torch.tensor([0.1, 0.2, 0.3]), fitted_rows=1.0).scale > found.scale).all()


def test_empty_and_nan_residuals_are_refused():
    for invalid in (torch.zeros((0, 2)), torch.full((4, 2), math.nan)):
        with pytest.raises(DataError, match="empty or not finite"):
            fit_residuals(invalid)


def test_constant_output_has_a_positive_scale():
    errors = torch.cat([drawn(50, 1e9), torch.zeros((50, 1)).double()], dim=1)
    for found in (fit_residuals(errors), fit_residuals(torch.zeros((5, 2)).double())):
        assert torch.isfinite(found.whitening).all()
        assert float(found.scale.min()) >= 0.99e-15
    assert fit_residuals(errors).scale[:3].numpy() == pytest.approx(SIZE, rel=0.4)
