"""Priors of a run of learning from a car file, and predictions of a model that is known."""

from __future__ import annotations

import tomllib
from dataclasses import replace

import numpy as np
import pytest
import tomli_w
import torch

from carlab.cars import choose_car
from carlab.core.episode_data import EpisodeData
from carlab.experiment.campaign.campaign import prior_simulator
from carlab.experiment.campaign.figures import predict_windows
from learning.networks.normaliser import Normaliser
from learning.networks.particles import Network
from learning.posterior.particle_posterior import ParticlePosterior
from learning.world.car_dynamics import CarDynamics
from sim_backends.car_parameters import SimulatorConfig, preset_names


@pytest.mark.parametrize("name", preset_names())
def test_a_prior_has_ranges_about_the_numbers_of_the_car(name: str) -> None:
    car = choose_car(name).simulator
    for kind in ("kinematic", "nominal"):
        found = prior_simulator(car, kind)
        assert found.kind == ("kinematic" if kind == "kinematic" else car.kind)
        assert found.parameters == car.parameters
        assert found.priors
        for key, (low, high) in found.priors.items():
            value = car.values()[key]
            assert low < value < high
            if key in car.priors:
                assert (low, high) == car.priors[key], "ranges of the file hold for wheels that do not slip, too"
            else:
                assert sorted([low / value, high / value]) == pytest.approx([0.7, 1.3])
        assert SimulatorConfig.from_tables(tomllib.loads(tomli_w.dumps(found.to_tables()))) == found


def test_a_prior_whose_wheels_do_not_slip_has_neither_effects_nor_ranges_of_tyres() -> None:
    ranges = {"tyre.front.mu": (0.2, 1.1), "motor.drive_gain": (1.0, 50.0)}
    car = replace(SimulatorConfig(), effects={"steering_lag": {}}, priors=ranges)
    assert prior_simulator(car, "nominal") == car, "ranges of the file are those to be had"
    found = prior_simulator(car, "kinematic")
    assert found.effects == {}
    assert not [name for name in found.priors if name.startswith("tyre")]
    assert found.priors["motor.drive_gain"] == (1.0, 50.0)
    assert found.priors["motor.damping"][1] == pytest.approx(1.3 * car.values()["motor.damping"])


def recording_of(ticks: int) -> EpisodeData:
    """A recording at 30 Hz whose states and commands have nothing to do with each other."""
    rng = np.random.default_rng(0)
    sent = rng.uniform(-1.0, 1.0, (ticks, 2))
    return EpisodeData(np.arange(ticks + 1) / 30.0, rng.normal(size=(ticks + 1, 6)), sent, sent, sent[:, 0])


@pytest.mark.parametrize("history", [0, 1, 3])
def test_predictions_follow_the_model_and_the_recorded_commands(history: int) -> None:
    """It goes ahead by the oldest throttle that it sees and turns by 0.05 rad, from each stretch's recorded start."""
    width = 3 + 2 * (history + 1)
    network = Network(width, 6, (1,), slope=1.0)
    parameters = torch.zeros(4, network.parameters)
    (first, _), (last, bias) = network.split(parameters)
    first[:, 4, 0] = last[:, 0, 0] = 1.0
    bias[:, 0, 2] = 0.05
    units = Normaliser(*(f(n) for n in (width, 6) for f in (torch.zeros, torch.ones)))
    car = CarDynamics(ParticlePosterior(network, parameters, torch.full((6,), 1e-7), units), history)
    driven = recording_of(100)
    found = predict_windows(car, driven)
    assert found.ticks[:, 0].tolist() == [history, history + 30, history + 60]
    assert found.mean.shape == found.std.shape == (3, 31, 6)
    for (start, *_), path in zip(found.ticks, found.mean, strict=True):
        x, y, yaw = driven.states[start, :3]
        headings = yaw + 0.05 * np.arange(31)
        ahead = driven.sent[start - history : start - history + 30, 1]
        np.testing.assert_allclose(path[1:, 0], x + np.cumsum(ahead * np.cos(headings[:-1])), atol=1e-4)
        np.testing.assert_allclose(path[1:, 1], y + np.cumsum(ahead * np.sin(headings[:-1])), atol=1e-4)
        np.testing.assert_allclose(np.exp(1j * path[:, 2]), np.exp(1j * headings), atol=1e-4)
        np.testing.assert_allclose(path[:, 3:], np.tile(driven.states[start, 3:], (31, 1)), atol=1e-4)
    assert found.std.max() < 1e-4
    assert predict_windows(car, recording_of(20)).mean.shape == (0, 31, 6)
