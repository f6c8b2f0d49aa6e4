"""Rollouts with a disturbance, on a linear car whose errors have a closed form."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from decaying_car import DECAY, PERIOD_S, STEPS, decaying_car, driven_windows
from scipy.stats import norm
from torch import Tensor

from carlab.core.errors import DataError
from carlab.core.observation import decode_state, encode
from carlab.core.planar import to_body
from carlab.prediction.learned import sample_paths
from learning.posterior.sampler import Assignment
from learning.world import disturbance_fit
from learning.world.car_dynamics import CarDynamics
from learning.world.disturbance import DisturbanceProcess, DisturbedCar
from learning.world.disturbance_fit import (
    MAX_SCALE,
    fit_disturbance,
    pooled,
    rollout_errors,
)


@pytest.fixture(autouse=True)
def few_candidates(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the shortest and the longest correlation time, and every second number of degrees of freedom."""
    monkeypatch.setattr(disturbance_fit, "DOF_CANDIDATES", disturbance_fit.DOF_CANDIDATES[::2])
    monkeypatch.setattr(disturbance_fit, "CORRELATION_TIMES_S", disturbance_fit.CORRELATION_TIMES_S[1:-1])


def vx_std(scale: float, correlation_s: float, steps: int) -> float:
    """Standard deviation of vx after a number of steps by an AR(1) acceleration."""
    rho = math.exp(-PERIOD_S / correlation_s)
    gain = (1.0 - DECAY) ** np.arange(steps - 1, -1, -1) * PERIOD_S
    lag = np.abs(np.subtract.outer(np.arange(steps), np.arange(steps)))
    return scale * math.sqrt(gain @ rho**lag @ gain)


def sampled(model: DisturbedCar | CarDynamics, count: int, steps: int = STEPS) -> Tensor:
    """Return states (count, 6) after rollouts from rest."""
    generator = torch.Generator().manual_seed(0)
    features = encode(torch.zeros(count, 6), torch.zeros(count, 0, 2))
    rollouts = model.rollouts(count, generator)
    for _ in range(steps):
        features = rollouts.step(features, torch.zeros(count, 2), generator)
    states: Tensor = decode_state(features)
    return states


@pytest.mark.parametrize("correlation_s", [0.05, 0.4, 100.0])
def test_sampled_velocity_has_the_closed_form_variance(correlation_s: float) -> None:
    process = DisturbanceProcess((1.0, 0.5, 2.0), (correlation_s,) * 3, PERIOD_S)
    states = sampled(DisturbedCar(decaying_car(torch.zeros(4)), process), 8000)
    for channel, scale in enumerate(process.scale):
        expected = vx_std(scale, correlation_s, STEPS)
        if channel < 2:  # The yaw turns the body axes, but a car at rest has small velocities.
            assert float(states[:, 3 + channel].std()) == pytest.approx(expected, rel=0.05)
    assert float(states[:, 5].std()) == pytest.approx(vx_std(2.0, correlation_s, STEPS), rel=0.05)


def test_independent_steps_are_overconfident_by_the_closed_form_factor() -> None:
    """The same variance in one step, redrawn in each step, has less variance after a second."""
    car = decaying_car(torch.zeros(4))
    processes = [DisturbanceProcess((1.0,) * 3, (t,) * 3, PERIOD_S) for t in (0.8, 1e-3)]
    correlated, redrawn = (float(sampled(DisturbedCar(car, p), 8000)[:, 3].std()) for p in processes)
    expected = vx_std(1.0, 0.8, STEPS) / vx_std(1.0, 1e-3, STEPS)
    assert expected > 2.5
    assert correlated / redrawn == pytest.approx(expected, rel=0.06)


def test_each_rollout_keeps_its_particle() -> None:
    """vx drifts by the offset of one particle: after 30 steps, rollouts have as many values as particles."""
    offsets = torch.tensor([-0.1, 0.0, 0.1])
    quiet = DisturbanceProcess((1e-9,) * 3, (1.0,) * 3, PERIOD_S)
    vx = sampled(DisturbedCar(decaying_car(offsets, 1e-9), quiet), 300)[:, 3]
    total = (1.0 - (1.0 - DECAY) ** STEPS) / DECAY
    nearest = (vx[:, None] - offsets * total).abs()
    assert float(nearest.min(dim=1).values.max()) < 1e-4
    assert torch.bincount(nearest.argmin(dim=1)).min() >= 99
    stepwise = sampled(decaying_car(offsets, 1e-9), 300)[:, 3]
    assert float(stepwise.std()) < 0.4 * float(vx.std()), "with steps of random particles the offsets average out"


@pytest.mark.parametrize("yaw_rad", [0.0, 0.5 * math.pi])
def test_measurement_noise_of_the_position_is_along_the_body_axes(yaw_rad: float) -> None:
    posterior = replace(decaying_car(torch.zeros(2)).posterior, noise_std=torch.tensor([0.1, *(0.001,) * 5]))
    process = DisturbanceProcess((1e-6,) * 3, (1.0,) * 3, PERIOD_S)
    start = np.array([[0.0, 0.0, yaw_rad, 0.0, 0.0, 0.0]])
    none = np.zeros((1, 0, 2))
    car = DisturbedCar(CarDynamics(posterior, 0), process)
    paths = sample_paths(car, start, none, np.zeros((1, 1, 2)), n_samples=2000)
    ahead, left = to_body(*np.moveaxis(paths[0, -1, :, :2], -1, 0), np.array(yaw_rad))
    assert ahead.std() == pytest.approx(0.1, rel=0.05)
    assert left.std() == pytest.approx(0.001, rel=0.05)


def test_fit_recovers_scale_and_correlation_time() -> None:
    truth = DisturbanceProcess((0.8, 0.4, 3.0), (0.4,) * 3, PERIOD_S)
    found = fit_disturbance(rollout_errors(decaying_car(torch.zeros(2)), driven_windows(truth, 160)))
    assert found.dof >= 10.0, "the planted disturbance is Gaussian"
    np.testing.assert_allclose(found.scale, truth.scale, rtol=0.25)
    assert set(found.correlation_s) <= {0.2, 0.4, 0.8}


def test_fitted_bands_cover_new_windows_at_their_nominal_level() -> None:
    """Sampled bands of 90 % cover 90 % after 0.5 and 1 s; the closed form gives the level of step noise alone."""
    truth = DisturbanceProcess((0.8, 0.4, 3.0), (0.8,) * 3, PERIOD_S)
    car = decaying_car(torch.zeros(2))
    process = fit_disturbance(rollout_errors(car, driven_windows(truth, 160)))
    new = driven_windows(truth, 2000, seed=2)
    for steps in (15, 30):
        undisturbed = (1.0 - DECAY) ** steps * new.velocities[:, 0]
        error = (new.motion[:, steps - 1, 3] - undisturbed).abs()
        band = float(sampled(DisturbedCar(car, process), 8000, steps)[:, 3].abs().quantile(0.9))
        assert float((error < band).float().mean()) == pytest.approx(0.9, abs=0.03)
        # A model that redraws the same variance in each step has the coverage of a smaller standard deviation.
        ratio = vx_std(0.8, 1e-3, steps) / vx_std(0.8, 0.8, steps)
        redrawn_band = norm.ppf(0.95) * vx_std(0.8, 1e-3, steps)
        expected = 2.0 * norm.cdf(norm.ppf(0.95) * ratio) - 1.0
        assert float((error < redrawn_band).float().mean()) == pytest.approx(expected, abs=0.04)
        assert expected < 0.65


def test_fit_finds_heavy_tails() -> None:
    truth = DisturbanceProcess((0.8, 0.4, 3.0), (0.4,) * 3, PERIOD_S, dof=3.0)
    found = fit_disturbance(rollout_errors(decaying_car(torch.zeros(2)), driven_windows(truth, 160)))
    assert found.dof <= 6.0
    np.testing.assert_allclose(found.scale, truth.scale, rtol=0.35)


def test_spread_of_the_particles_is_not_counted_as_disturbance() -> None:
    """Errors as large as the particles' spread need no disturbance; the same errors of equal particles do."""
    quiet = DisturbanceProcess((1e-6,) * 3, (1.0,) * 3, PERIOD_S)
    parts = [driven_windows(quiet, 20, seed=k, offset=o) for k, o in enumerate((-0.02, -0.005, 0.005, 0.02))]
    spread, equal = (
        fit_disturbance(pooled([rollout_errors(decaying_car(offsets), part) for part in parts]))
        for offsets in (torch.tensor([-0.02, -0.007, 0.007, 0.02]), torch.zeros(4))
    )
    assert equal.scale[0] > 0.2
    assert spread.scale[0] < 0.25 * equal.scale[0]


def test_few_or_infinite_errors_are_refused() -> None:
    windows = driven_windows(DisturbanceProcess((1.0,) * 3, (1.0,) * 3, PERIOD_S), 10)
    errors = rollout_errors(decaying_car(torch.zeros(2)), windows.take(torch.arange(7)))
    with pytest.raises(DataError, match="record a longer drive"):
        fit_disturbance(errors)


def test_error_far_beyond_the_bounds_gives_the_largest_scale() -> None:
    windows = driven_windows(DisturbanceProcess((1e4,) * 3, (1.0,) * 3, PERIOD_S), 10)
    assert max(fit_disturbance(rollout_errors(decaying_car(torch.zeros(2)), windows)).scale) <= 1.001 * MAX_SCALE


@pytest.mark.parametrize("count", [1, 6, 7])
def test_restarted_rollouts_have_free_slots_and_others_keep_theirs(count: int) -> None:
    generator = torch.Generator().manual_seed(0)
    assignment = Assignment.random(count, 3, generator, spare=1)
    found = set()
    for _ in range(60):
        after = assignment.reassigned(torch.tensor([0]), 3, generator)
        assert torch.equal(after.slot[1:], assignment.slot[1:])
        assert len(set(after.slot.tolist())) == count
        found.add(int(after.slot[0]))
        assignment = after
    assert len(found) > 1


def test_rows_are_assigned_to_the_given_particles() -> None:
    particle = torch.tensor([2, 0, 2, 1, 2, 0])
    assignment = Assignment.of_particles(particle, 4)
    assert torch.equal(assignment.slot // assignment.share, particle)
    assert len(set(assignment.slot.tolist())) == len(particle)
