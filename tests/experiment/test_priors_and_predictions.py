"""Prior simulators of a learning run, and predicted windows of a model with known dynamics."""

from __future__ import annotations

import tomllib
from dataclasses import replace

import numpy as np
import pytest
import tomli_w
import torch

from carlab.cars import choose_car
from carlab.core.episode_data import EpisodeData
from carlab.core.safety import SafetyEnvelope
from carlab.experiment.campaign import predicted_return
from carlab.experiment.campaign.campaign import prior_simulator
from carlab.experiment.campaign.figures import predict_windows
from carlab.experiment.campaign.predicted_return import predicted_figures
from carlab.experiment.campaign.training_plan import TrainingPlan
from learning.networks.normaliser import Normaliser
from learning.networks.particles import Network
from learning.policy.sac_agent import SacAgent, SacSettings
from learning.posterior.particle_posterior import ParticlePosterior
from learning.world.car_dynamics import CarDynamics
from learning.world.model_env import RolloutEpisodes
from sim_backends.car_parameters import SimulatorConfig, preset_names


@pytest.mark.parametrize("name", preset_names())
def test_prior_ranges_contain_the_parameters_of_the_car(name: str) -> None:
    car = choose_car(name).simulator
    for kind in ("kinematic", "nominal"):
        prior = prior_simulator(car, kind)
        assert prior.kind == ("kinematic" if kind == "kinematic" else car.kind)
        assert prior.parameters == car.parameters
        assert prior.priors
        for key, (low, high) in prior.priors.items():
            value = car.values()[key]
            assert low < value < high
            if key in car.priors:
                assert (low, high) == car.priors[key], "the kinematic prior keeps the ranges of the car file, too"
            else:
                assert sorted([low / value, high / value]) == pytest.approx([0.7, 1.3])
        assert SimulatorConfig.from_tables(tomllib.loads(tomli_w.dumps(prior.to_tables()))) == prior


def test_kinematic_prior_has_no_effects_and_no_tyre_ranges() -> None:
    ranges = {"tyre.front.mu": (0.2, 1.1), "motor.drive_gain": (1.0, 50.0)}
    car = replace(SimulatorConfig(), effects={"steering_lag": {}}, priors=ranges)
    prior = prior_simulator(car, "kinematic")
    assert prior.effects == {}
    assert not [name for name in prior.priors if name.startswith("tyre")]
    assert prior.priors["motor.drive_gain"] == (1.0, 50.0)
    assert prior.priors["motor.damping"][1] == pytest.approx(1.3 * car.values()["motor.damping"])


def test_nominal_prior_has_the_ranges_of_the_car_file_and_30_percent_for_other_uncertain_parameters() -> None:
    ranges = {"tyre.front.mu": (0.2, 1.1), "vehicle.mass": (1.0, 2.0)}
    car = replace(SimulatorConfig(), effects={"steering_lag": {}}, priors=ranges)
    prior = prior_simulator(car, "nominal")
    assert replace(prior, priors=ranges) == car
    assert {name: prior.priors[name] for name in ranges} == ranges
    assert prior.priors["tyre.rear.mu"] == pytest.approx(np.array([0.7, 1.3]) * car.values()["tyre.rear.mu"])
    assert "vehicle.front_axle" not in prior.priors


def test_nominal_prior_of_a_diagnosed_car_is_its_file() -> None:
    car = replace(SimulatorConfig(), priors={}, parameter_std={"tyre.front.mu": 0.02})
    assert prior_simulator(car, "nominal") == car


def recording_of(ticks: int) -> EpisodeData:
    """A recording at 30 Hz with independent random states and commands."""
    rng = np.random.default_rng(0)
    sent = rng.uniform(-1.0, 1.0, (ticks, 2))
    return EpisodeData(np.arange(ticks + 1) / 30.0, rng.normal(size=(ticks + 1, 6)), sent, sent, sent[:, 0])


@pytest.mark.parametrize("history", [0, 1, 3])
def test_predicted_windows_follow_the_model_and_the_recorded_commands(history: int) -> None:
    """The model moves ahead by the oldest throttle of its input and turns by 0.05 rad a tick, from a recorded state."""
    width = 3 + 2 * (history + 1)
    network = Network(width, 6, (1,), slope=1.0)
    parameters = torch.zeros(4, network.parameters)
    (first, _), (last, bias) = network.split(parameters)
    first[:, 4, 0] = last[:, 0, 0] = 1.0
    bias[:, 0, 2] = 0.05
    normaliser = Normaliser(*(f(n) for n in (width, 6) for f in (torch.zeros, torch.ones)))
    car = CarDynamics(ParticlePosterior(network, parameters, torch.full((6,), 1e-7), normaliser), history)
    episode = recording_of(100)
    predicted = predict_windows(car, episode)
    assert predicted.ticks[:, 0].tolist() == [history, history + 30, history + 60]
    assert predicted.mean.shape == predicted.std.shape == (3, 31, 6)
    for (start, *_), mean in zip(predicted.ticks, predicted.mean, strict=True):
        x, y, yaw = episode.states[start, :3]
        headings = yaw + 0.05 * np.arange(31)
        ahead = episode.sent[start - history : start - history + 30, 1]
        np.testing.assert_allclose(mean[1:, 0], x + np.cumsum(ahead * np.cos(headings[:-1])), atol=1e-4)
        np.testing.assert_allclose(mean[1:, 1], y + np.cumsum(ahead * np.sin(headings[:-1])), atol=1e-4)
        np.testing.assert_allclose(np.exp(1j * mean[:, 2]), np.exp(1j * headings), atol=1e-4)
        np.testing.assert_allclose(mean[:, 3:], np.tile(episode.states[start, 3:], (31, 1)), atol=1e-4)
    assert predicted.std.max() < 1e-4
    assert predict_windows(car, recording_of(20)).mean.shape == (0, 31, 6)


@pytest.mark.parametrize(("episodes", "low", "median"), [(1, 0.0, 58.0), (2, 0.0, 59.0), (3, 50.0, 59.0)])
def test_weight_of_drawn_cars_falls_with_the_number_of_episodes(
    episodes: int, low: float, median: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The learned car predicts returns of 50 to 69, each drawn car 0: weights of 1/8, 1/18 and 1/32."""

    class Cars:
        """Cars whose drives have given returns and end at the goal."""

        def __init__(self, returns: torch.Tensor) -> None:
            self._returns = returns

        def roll_out(self, act: object, max_ticks: int | None = None) -> RolloutEpisodes:
            count = len(self._returns)
            return RolloutEpisodes(self._returns, torch.zeros(count), torch.zeros(count, 13))

    monkeypatch.setattr(predicted_return, "ModelEnv", lambda *args, **options: Cars(torch.zeros(64)))
    plan = TrainingPlan(tomli_w.dumps(SimulatorConfig().to_tables()))
    agent = SacAgent(SacSettings(), 0)
    recordings = [recording_of(60)] * episodes
    figures = predicted_figures(plan, agent, Cars(torch.arange(50.0, 70.0)), recordings, SafetyEnvelope(), 0)  # type: ignore[arg-type]
    assert (figures["predicted_low"], figures["predicted_return"]) == (low, median)
    assert figures["predicted_high"] == 68.0


@pytest.mark.parametrize("history", [0, 4, 8, 9, 12])
def test_policy_observes_its_own_past_commands_in_drawn_cars(history: int) -> None:
    """A policy whose commands count the ticks observes state features and its newest ``history`` commands."""
    observed: list[np.ndarray] = []

    class CountingPolicy:
        def act(self, seen: np.ndarray) -> np.ndarray:
            observed.append(seen)
            return np.full((len(seen), 2), 0.001 * len(observed), dtype=np.float32)

    class LearnedCar:
        def roll_out(self, act: object, max_ticks: int | None = None) -> RolloutEpisodes:
            return RolloutEpisodes(torch.zeros(4), torch.zeros(4), torch.zeros(4, 7 + 2 * history))

    plan = TrainingPlan(tomli_w.dumps(SimulatorConfig().to_tables()), history=history, ticks=history + 3)
    predicted_figures(plan, CountingPolicy(), LearnedCar(), [recording_of(60)], SafetyEnvelope(), 0)  # type: ignore[arg-type]
    assert [seen.shape for seen in observed] == [(64, 7 + 2 * history)] * (history + 3)
    assert np.allclose(np.hypot(observed[-1][:, 2], observed[-1][:, 3]), 1.0, atol=1e-5), "sine and cosine of the yaw"
    sent = 0.001 * np.repeat(np.arange(3, history + 3), 2)
    np.testing.assert_allclose(observed[-1][:, 7:], np.tile(sent, (64, 1)), atol=1e-6)
