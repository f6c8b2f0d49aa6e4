"""Test FSVGD with the authors' settings: its world frame, its prior weight and its early stopping."""

from __future__ import annotations

import cmath
from dataclasses import replace

import numpy as np
import pytest
import torch

from carlab.core.episode_data import EpisodeData
from carlab.core.errors import DataError
from learning.evaluation import negative_log_likelihood
from learning.functional_svgd.authors_fsvgd import (
    WorldDynamics,
    authors_settings,
    fit_authors_fsvgd,
    in_world,
    simulated_changes,
    world_rows,
)
from learning.functional_svgd.fsvgd import FsvgdSettings, GaussianProcessPrior, fit_fsvgd
from learning.networks.normaliser import Normaliser
from learning.networks.particles import Network
from learning.posterior.particle_posterior import ParticlePosterior
from learning.priors.function_prior import RbfCovariance
from learning.priors.simulator_model import CarModel, known_ranges
from sim_backends.car_parameters import SimulatorConfig

HISTORY = 2


def circling(ticks: int = 80, seed: int = 0) -> EpisodeData:
    """Return a drive on a circle at 1.5 rad/s whose yaw is 0.2 rad ahead of its velocity direction."""
    times = np.arange(ticks + 1) / 30.0
    place = np.exp(1j * 1.5 * times) / 1.5j
    yaw = 1.5 * times + 0.2
    body = np.exp(1j * 1.5 * times) * np.exp(-1j * yaw)
    states = np.stack([place.real, place.imag, yaw, body.real, body.imag, np.full(ticks + 1, 1.5)], axis=1)
    sent = np.random.default_rng(seed).uniform(-1, 1, (ticks, 2))
    return EpisodeData(times, states, sent, sent, np.zeros(ticks))


def constant(change: list[float]) -> WorldDynamics:
    """Return dynamics that always predict this change."""
    width = 7 + 2 * (HISTORY + 1)
    network = Network(width, 7, (4,))
    parameters = torch.zeros(3, network.parameters)
    units = Normaliser(torch.zeros(width), torch.ones(width), torch.tensor(change), torch.ones(7))
    return WorldDynamics(ParticlePosterior(network, parameters, torch.zeros(7), units), HISTORY)


def test_rows_are_in_the_world_frame() -> None:
    episode = circling()
    inputs, changes = world_rows([episode], HISTORY)
    assert inputs.shape == (episode.ticks - HISTORY, 7 + 2 * (HISTORY + 1))
    for row in (0, 31, 77):
        tick = row + HISTORY
        t = episode.times_s[tick]
        velocity = cmath.exp(1.5j * t)
        expected = [velocity.imag / 1.5, -velocity.real / 1.5, np.sin(1.5 * t + 0.2), np.cos(1.5 * t + 0.2)]
        expected += [velocity.real, velocity.imag, 1.5, *episode.sent[tick - HISTORY : tick + 1].ravel()]
        assert np.allclose(inputs[row], expected, atol=1e-5)
        later = cmath.exp(1.5j * episode.times_s[tick + 1])
        assert np.allclose(changes[row, 4:6], [later.real - velocity.real, later.imag - velocity.imag], atol=1e-5)


def test_step_adds_the_change_in_the_world_frame() -> None:
    """A car facing y with velocity (1.0, 0.5) in its body frame is moved and rotated to face -x."""
    features = torch.tensor([[2.0, 1.0, 1.0, 0.0, 1.0, 0.5, 0.1, 0.1, 0.2, 0.3, 0.4]])
    assert np.allclose(in_world(features)[0, 4:6], [-0.5, 1.0], atol=1e-6)
    world = constant([0.1, -0.2, -1.0, -1.0, 0.3, 0.0, 0.05])
    after = world.step(features, torch.tensor([[0.5, 0.6]]), torch.Generator().manual_seed(0))[0]
    assert np.allclose(after[:4], [2.1, 0.8, 0.0, -1.0], atol=1e-6)
    assert np.allclose(after[4:6], [0.2, -1.0], atol=1e-6), (
        "world velocity (-0.2, 1.0) in the frame of a body facing -x"
    )
    assert np.allclose(after[6:], [0.15, 0.3, 0.4, 0.5, 0.6], atol=1e-6)


def test_fit_improves_the_held_out_score_and_starts_from_initial_networks() -> None:
    episodes = [circling(seed=s) for s in range(3)]
    unfitted = fit_authors_fsvgd([], HISTORY, seed=1)
    fitted = fit_authors_fsvgd(episodes[:2], HISTORY, 400, seed=1)
    assert torch.equal(
        unfitted.posterior.parameters,
        unfitted.posterior.network.initial(10, torch.Generator().manual_seed(1)),
    )
    before, after = unfitted.score_episode(episodes[2])[0], fitted.score_episode(episodes[2])[0]
    assert after < before - 5.0


def test_too_few_rows_for_a_validation_split_are_refused() -> None:
    with pytest.raises(DataError, match="too few for a validation split"):
        fit_authors_fsvgd([circling(ticks=HISTORY + 3)], HISTORY, 10)


def test_prior_exponent_is_that_of_the_authors() -> None:
    published, simulator, corrected = (
        authors_settings(1000, 0, with_simulator=s, corrected=m)
        for s, m in ((False, False), (True, False), (True, True))
    )
    assert (published.prior_exponent, published.repulsion) == (pytest.approx(1 / 480), 0.1)
    assert (simulator.prior_exponent, simulator.repulsion) == (1.0, 0.1)
    assert (corrected.prior_exponent, corrected.repulsion, corrected.bandwidth) == (1.0, 1.0, None)
    assert published.bandwidth == simulator.bandwidth == 0.2


@pytest.fixture(scope="module")
def noisy() -> tuple[torch.Tensor, ...]:
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(212, 1, generator=generator)
    y = 0.5 * x + torch.randn(212, 1, generator=generator)
    return x[:12], y[:12], x[12:], y[12:]


class TestHeldOutRows:
    """Early stopping by held-out rows, on twelve noisy rows that the networks overfit."""

    SETTINGS = FsvgdSettings(
        particles=4, steps=1500, hidden=(64, 64), learning_rate=3e-3, noise_std=0.3, fit_noise=False, natural=False,
        anneal_rate=False, validation_period=100, bandwidth=0.1,
    )  # fmt: skip
    UNITS = Normaliser(torch.zeros(1), torch.ones(1), torch.zeros(1), torch.ones(1))

    def test_networks_with_the_best_validation_score_are_kept(self, noisy: tuple[torch.Tensor, ...]) -> None:
        x, y, others, truth = noisy
        last = fit_fsvgd(x, y, x, None, self.UNITS, self.SETTINGS)
        best = fit_fsvgd(x, y, x, None, self.UNITS, self.SETTINGS, held_out=(others, truth))
        nll = [negative_log_likelihood(p.predict(others), truth) for p in (best, last)]
        assert nll[0] < nll[1] - 0.5

    def test_patience_stops_early_with_the_same_networks(self, noisy: tuple[torch.Tensor, ...]) -> None:
        x, y, others, truth = noisy
        steps_done: list[int] = []
        full = fit_fsvgd(x, y, x, None, self.UNITS, self.SETTINGS, held_out=(others, truth))
        stopped = fit_fsvgd(
            x, y, x, None, self.UNITS, replace(self.SETTINGS, patience=3), steps_done.append, held_out=(others, truth)
        )
        assert max(steps_done, default=0) < 1500
        assert torch.equal(stopped.parameters, full.parameters)

    def test_prior_exponent_scales_the_prior(self, noisy: tuple[torch.Tensor, ...]) -> None:
        """A change of the prior has no effect with exponent zero and an effect with exponent one."""
        x, y, others, _ = noisy
        found = {}
        for exponent in (0.0, 1.0):
            for length in (0.1, 3.0):
                prior = GaussianProcessPrior(torch.cat([x, others]), RbfCovariance((1.0,), (length,)))
                settings = replace(self.SETTINGS, steps=60, prior_exponent=exponent)
                found[exponent, length] = fit_fsvgd(x, y, others, prior, self.UNITS, settings).parameters
        assert torch.equal(found[0.0, 0.1], found[0.0, 3.0])
        assert not torch.allclose(found[1.0, 0.1], found[1.0, 3.0], atol=1e-3)


def test_changes_of_a_simulator_are_rotated_to_the_world() -> None:
    """A simulator that predicts the recorded change in the body frame has the recorded change in the world."""
    episode = circling()
    inputs, changes = world_rows([episode], HISTORY)
    body = cmath.exp(1j * 0.2).conjugate()  # The velocity in the frame of the car, constant on the circle.
    place = (cmath.exp(1j * 1.5 / 30.0) - 1.0) / 1.5j * cmath.exp(-0.2j)
    change = torch.tensor([place.real, place.imag, 1.5 / 30.0, 0.0, 0.0, 0.0])
    seen = []

    def simulator(rows: torch.Tensor, parameters: torch.Tensor) -> torch.Tensor:
        seen.append(rows)
        return change.expand(len(parameters), len(rows), 6)

    found = simulated_changes(simulator, inputs, torch.zeros(2, 1))
    assert found.shape == (2, len(inputs), 7)
    assert torch.allclose(found[1], changes, atol=1e-5)
    assert torch.allclose(seen[0][:, :3], torch.tensor([body.real, body.imag, 1.5]), atol=1e-5)
    assert torch.equal(seen[0][:, 3:], inputs[:, 7:])


def test_simulator_prior_changes_the_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("SIMULATOR_POOL_POINTS", 40), ("SIMULATOR_DRAWS", 16)):
        monkeypatch.setattr(f"learning.functional_svgd.authors_fsvgd.{name}", value)
    config = SimulatorConfig(kind="kinematic")
    model = CarModel(config, HISTORY, known_ranges(config))
    without, published, corrected = (
        fit_authors_fsvgd([circling()], HISTORY, 3, simulator=simulator, corrected=is_corrected)
        for simulator, is_corrected in ((None, False), (model, False), (model, True))
    )
    parameters = [fit.posterior.parameters for fit in (without, published, corrected)]
    assert all(torch.isfinite(p).all() for p in parameters)
    assert not torch.equal(parameters[0], parameters[1])
    assert not torch.equal(parameters[1], parameters[2])
