"""Test the learned car: kinematics of a recorded drive, draws of a mixture with known moments, and its file."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from scipy.stats import chi2
from torch import Tensor

from carlab.cars import choose_car
from carlab.core.documents import Document, Transition
from carlab.core.episode_data import EpisodeData
from carlab.core.errors import DataError
from carlab.core.policy import PolicyInput
from carlab.core.quantities import Action, CarState
from carlab.core.task import ParkingTask
from carlab.experiment.episodes.episode import EpisodeHooks, run_episode
from learning.evaluation import negative_log_likelihood
from learning.networks.normaliser import Normaliser
from learning.networks.particles import Network
from learning.posterior.particle_posterior import MIN_INPUT_CLIP, ParticlePosterior
from learning.priors.simulator_model import CarModel
from learning.transitions import transitions_of
from learning.world.car_dynamics import CarDynamics, advance, inputs_of
from learning.world.car_fit import CarFitSettings, fit_car, load_car, save_car
from sim_backends.car_parameters import SimulatorConfig

HISTORY = 3
INPUTS = 3 + 2 * (HISTORY + 1)


class CirclingPolicy:
    """A policy of random left turns, for more than a full circle."""

    name = "circling"

    def reset(self) -> None: ...

    def act(self, view: PolicyInput) -> Action:
        rng = np.random.default_rng(view.step)
        return Action(float(rng.uniform(0.4, 1.0)), float(rng.uniform(0.3, 0.7)))


@pytest.fixture(scope="module")
def drive() -> tuple[EpisodeData, list[Transition]]:
    """Drive the simulated car; return the episode and the transitions of the control loop."""
    choice = choose_car("sim", seed=0)
    emitted: list[Document] = []
    with choice.car as car:
        car.place(CarState(yaw_rad=3.0))
        driven = run_episode(
            car, CirclingPolicy(), replace(ParkingTask(), history_length=HISTORY), choice.envelope,
            period_s=choice.control_period_s, max_ticks=90, hooks=EpisodeHooks(emit=emitted.append),
        )  # fmt: skip
    return driven, [d for d in emitted if isinstance(d, Transition)]


def test_advance_reproduces_a_recorded_drive(drive: tuple[EpisodeData, list[Transition]]) -> None:
    driven, transitions = drive
    rows = transitions_of([driven], HISTORY)
    row_transitions = [transitions[k] for k in rows.tick]
    assert len(row_transitions) > 60
    assert np.ptp(driven.states[:, 2]) > 6.0, "the drive must wrap yaw from pi to -pi"
    features = torch.from_numpy(np.array([t.features for t in row_transitions]))
    action = torch.from_numpy(np.array([t.action.to_array() for t in row_transitions]))
    after = advance(features, action, torch.from_numpy(rows.targets)).numpy()
    np.testing.assert_allclose(after, [t.next_features for t in row_transitions], atol=1e-12)
    expected = driven.states[rows.tick + 1]
    np.testing.assert_allclose(after[:, [0, 1, 4, 5, 6]], expected[:, [0, 1, 3, 4, 5]], atol=1e-12)
    yaw = np.arctan2(after[:, 2], after[:, 3])
    np.testing.assert_allclose(np.exp(1j * yaw), np.exp(1j * expected[:, 2]), atol=1e-12)


def test_inputs_of_a_step_equal_the_recorded_rows(drive: tuple[EpisodeData, list[Transition]]) -> None:
    driven, transitions = drive
    rows = transitions_of([driven], HISTORY)
    features = torch.from_numpy(np.array([transitions[k].features for k in rows.tick]))
    sent = torch.from_numpy(driven.sent[rows.tick])
    inputs = inputs_of(features, sent).numpy()
    np.testing.assert_array_equal(inputs, rows.inputs)
    np.testing.assert_array_equal(inputs[:, -2:], [transitions[k].action.to_array() for k in rows.tick])


def test_advance_without_history_drops_the_command() -> None:
    features = torch.tensor([[1.0, 2.0, 1.0, 0.0, 0.5, 0.0, 0.0]])  # heading along y
    after = advance(features, torch.tensor([[0.3, 0.4]]), torch.tensor([[0.2, 0.1, math.pi / 2, 0.1, 0.0, -0.2]]))
    assert after[0].tolist() == pytest.approx([0.9, 2.2, 0.0, -1.0, 0.6, 0.0, -0.2], abs=1e-6)


def constant_car(values: Tensor, dof: float = math.inf, noise: float = 0.5) -> CarDynamics:
    """Return a car whose particles predict constant values (L, 6)."""
    network = Network(INPUTS, 6, (4,))
    parameters = torch.zeros(len(values), network.parameters)
    parameters[:, -6:] = values
    units = Normaliser(torch.zeros(INPUTS), torch.ones(INPUTS), torch.full((6,), 0.3), torch.arange(1.0, 7.0))
    return CarDynamics(ParticlePosterior(network, parameters, torch.full((6,), noise), units, dof), HISTORY)


@pytest.mark.parametrize("dof", [math.inf, 5.0])
def test_draws_have_the_moments_of_the_mixture(dof: float) -> None:
    """The mixture has four equally weighted components with known mean, variance and fourth moment.

    With Student-t noise each component has the scale ``sqrt(dof / q)`` with q a chi-square quantile.
    """
    values = torch.randn(4, 6, generator=torch.Generator().manual_seed(2))
    car = constant_car(values, dof, noise=0.85)
    count = 40_000
    drawn = car.sampler(torch.zeros(count, INPUTS), torch.Generator().manual_seed(0)).double()
    unit = torch.arange(1.0, 7.0).double()
    means = 0.3 + values.double() * unit
    scales = np.ones(4) if math.isinf(dof) else np.sqrt(dof / chi2.ppf([0.125, 0.375, 0.625, 0.875], dof))
    stds = 0.85 * unit * torch.from_numpy(scales)[:, None]
    mean = means.mean(dim=0)
    mean_deviations = means - mean
    variance = (mean_deviations**2 + stds**2).mean(dim=0)
    fourth = (mean_deviations**4 + 6 * mean_deviations**2 * stds**2 + 3 * stds**4).mean(dim=0)
    assert torch.all((drawn.mean(dim=0) - mean).abs() < 4 * (variance / count).sqrt())
    found = ((drawn - mean) ** 2).mean(dim=0)
    assert torch.all((found - variance).abs() < 4 * ((fourth - variance**2) / count).sqrt())
    predicted = car.predict(torch.zeros(1, INPUTS))
    torch.testing.assert_close(predicted.mean[0].double(), mean, rtol=1e-5, atol=1e-5)
    variance = (mean_deviations**2).mean(dim=0) + (0.85 * unit) ** 2 * (1.0 if math.isinf(dof) else 5.0 / 3.0)
    torch.testing.assert_close(predicted.std[0].double(), variance.sqrt(), rtol=1e-5, atol=1e-5)


def test_rows_are_assigned_evenly_and_randomly_to_particles() -> None:
    car = constant_car(torch.arange(5.0)[:, None].expand(5, 6), noise=1e-6)
    drawn = car.sampler(torch.zeros(200, INPUTS), torch.Generator().manual_seed(0))
    particle_of_row = (drawn[:, 0] - 0.3).round().int()
    assert torch.bincount(particle_of_row).tolist() == [40] * 5
    assert len(particle_of_row.unique_consecutive()) > 100, "rows must not be assigned in order"


@pytest.mark.parametrize("count", [1, 3, 7, 64])
def test_each_row_draws_each_particle_equally_often_for_any_row_count(count: int) -> None:
    car = constant_car(torch.arange(5.0)[:, None].expand(5, 6), noise=1e-6)
    generator, inputs = torch.Generator().manual_seed(0), torch.zeros(count, INPUTS)
    drawn_particles = torch.stack([(car.sampler(inputs, generator)[:, 0] - 0.3).round() for _ in range(1500)])
    for row in {0, count - 1}:
        counts = torch.bincount(drawn_particles[:, row].int(), minlength=5)
        assert torch.all((counts - 300).abs() < 5 * math.sqrt(1500 * 0.2 * 0.8)), (row, counts)


def test_draws_stay_in_the_order_of_their_input_rows() -> None:
    """Every particle returns vx of its input row, so each draw must equal vx of the same row."""
    network = Network(INPUTS, 6, (2,), slope=1.0)
    parameters = torch.zeros(3, network.parameters)
    (first, _), (last, _) = network.split(parameters)
    first[:, 0, 0] = last[:, 0, :] = 1.0
    units = Normaliser(torch.zeros(INPUTS), torch.ones(INPUTS), torch.zeros(6), torch.ones(6))
    car = CarDynamics(ParticlePosterior(network, parameters, torch.full((6,), 1e-4), units), HISTORY)
    inputs = torch.zeros(100, INPUTS)
    inputs[:, 0] = torch.arange(100.0) / 20.0
    drawn = car.sampler(inputs, torch.Generator().manual_seed(0))
    assert torch.allclose(drawn, inputs[:, :1].expand(100, 6), atol=1e-3)


def test_unstable_model_grows_linearly_beyond_the_input_clip() -> None:
    """A yaw rate that doubles per step grows by a constant once the network input is clipped."""
    network = Network(INPUTS, 6, (2,), slope=1.0)
    parameters = torch.zeros(1, network.parameters)
    (first, _), (last, _) = network.split(parameters)
    first[:, 2, 0] = last[:, 0, 5] = 1.0
    units = Normaliser(torch.zeros(INPUTS), torch.full((INPUTS,), 2.0), torch.zeros(6), torch.full((6,), 2.0))
    car = CarDynamics(ParticlePosterior(network, parameters, torch.full((6,), 1e-6), units), HISTORY)
    features = torch.zeros(1, 7 + 2 * HISTORY)
    features[0, 3], features[0, 6] = 1.0, 0.75
    generator, rates = torch.Generator().manual_seed(0), []
    for _ in range(100):
        features = car.step(features, torch.zeros(1, 2), generator)
        rates.append(float(features[0, 6]))
    assert rates[:5] == pytest.approx([1.5, 3.0, 6.0, 12.0, 24.0], rel=1e-3)
    assert rates[-1] == pytest.approx(24.0 + 95 * 2.0 * MIN_INPUT_CLIP, rel=1e-3)


DECORRELATION = torch.eye(6).double() + 0.4 * torch.randn(6, 6, generator=torch.Generator().manual_seed(8)).double()


def decorrelated(car: CarDynamics, by: torch.Tensor = DECORRELATION) -> CarDynamics:
    """Return the car with the same network parameters in decorrelated output units."""
    return replace(car, posterior=replace(car.posterior, normaliser=car.posterior.normaliser.decorrelated(by)))


def test_noise_of_draws_has_the_covariance_of_the_decorrelation() -> None:
    car = decorrelated(constant_car(torch.zeros(4, 6)))
    drawn = car.sampler(torch.zeros(40_000, INPUTS), torch.Generator().manual_seed(0)).double().numpy()
    unit = np.arange(1.0, 7.0)
    back = np.linalg.inv(DECORRELATION.numpy())
    shape = 0.25 * unit[:, None] * (back @ back.T) * unit
    assert np.allclose(np.cov(drawn.T), shape, atol=0.03 * np.sqrt(np.outer(np.diag(shape), np.diag(shape))))
    predicted = car.predict(torch.zeros(1, INPUTS))
    assert np.allclose(predicted.marginal_scales[0, 0], np.sqrt(np.diag(shape)), rtol=1e-4)
    assert np.allclose(predicted.mean, 0.3, atol=1e-5)


def test_particles_converted_to_other_units_are_the_same_functions() -> None:
    inputs = torch.randn(50, INPUTS, generator=torch.Generator().manual_seed(1))
    for car in (random_car(), decorrelated(random_car(), DECORRELATION.T)):
        for normaliser in (
            car.posterior.normaliser.without_decorrelation().decorrelated(DECORRELATION),
            car.posterior.normaliser.without_decorrelation(),
        ):
            parameters = car.posterior.parameters_for(normaliser)
            converted = replace(car.posterior, parameters=parameters, normaliser=normaliser).predict(inputs)
            torch.testing.assert_close(converted.means, car.predict(inputs).means, rtol=1e-4, atol=1e-5)


def random_car(dof: float = math.inf) -> CarDynamics:
    generator = torch.Generator().manual_seed(5)
    network = Network(INPUTS, 6, (8, 4), "silu")
    units = Normaliser(*(torch.rand(n, generator=generator) + 0.5 for n in (INPUTS, INPUTS, 6, 6)))
    noise = torch.rand(6, generator=generator)
    return CarDynamics(ParticlePosterior(network, network.initial(3, generator), noise, units, dof), HISTORY)


def car_with_all_parts() -> CarDynamics:
    """Return a car with a trend, decorrelated and correlated errors, and an input clip."""
    generator = torch.Generator().manual_seed(8)
    car = decorrelated(random_car())
    root = torch.eye(6) + 0.3 * torch.randn((6, 6), generator=generator)
    shape = root @ root.T
    scale = shape.diagonal().rsqrt()
    trend = 0.5 * torch.randn((1 + INPUTS, 6), generator=generator)
    input_clip = 0.5 + torch.rand(INPUTS, generator=generator)
    posterior = replace(car.posterior, trend=trend, correlation=scale[:, None] * shape * scale, input_clip=input_clip)
    return replace(car, posterior=posterior)


def test_draws_of_a_car_with_all_parts_have_known_moments() -> None:
    car = car_with_all_parts()
    posterior, units = car.posterior, car.posterior.normaliser
    assert posterior.trend is not None
    assert posterior.correlation is not None
    assert posterior.input_clip is not None
    row = 3.0 * torch.randn((1, INPUTS), generator=torch.Generator().manual_seed(1))
    normalised = (row - units.input_mean) / units.input_std
    assert bool((normalised.abs() > posterior.input_clip).any()), "some inputs must be clipped"
    normalised = normalised.clamp(-posterior.input_clip, posterior.input_clip)
    network = posterior.network(posterior.parameters, normalised)[:, 0].double()
    line = (posterior.trend[0] + normalised[0] @ posterior.trend[1:]).double()
    back = units.output_std.double()[:, None] * torch.linalg.inv(DECORRELATION.double())
    centres = units.output_mean.double() + (network + line) @ back.T
    noise = posterior.noise_std.double()
    noise_covariance = back @ (noise[:, None] * posterior.correlation.double() * noise) @ back.T
    covariance = noise_covariance + torch.cov(centres.T, correction=0)
    drawn = car.sampler(row.expand(60_000, -1), torch.Generator().manual_seed(2)).double()
    spread = covariance.diagonal().sqrt()
    assert torch.allclose(drawn.mean(dim=0), centres.mean(dim=0), atol=0.02 * float(spread.max()))
    assert torch.allclose(torch.cov(drawn.T), covariance, atol=0.03 * float((spread[:, None] * spread).max()))
    predicted = car.predict(row)
    assert torch.allclose(predicted.mean[0].double(), centres.mean(dim=0), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("dof", [math.inf, 2.5, None])
def test_car_loaded_from_a_file_predicts_the_same(tmp_path: Path, dof: float | None) -> None:
    car = car_with_all_parts() if dof is None else random_car(dof)
    if dof == 2.5:
        car = decorrelated(car)
    save_car(car, tmp_path / "car.pt")
    loaded = load_car(tmp_path / "car.pt")
    assert loaded.history == HISTORY
    inputs = torch.randn(50, INPUTS, generator=torch.Generator().manual_seed(1))
    original_prediction, loaded_prediction = car.predict(inputs), loaded.predict(inputs)
    assert torch.equal(original_prediction.means, loaded_prediction.means)
    assert torch.equal(original_prediction.stds, loaded_prediction.stds)
    assert (original_prediction.decorrelation is None) == (dof == math.inf)
    assert (loaded_prediction.decorrelation is None) == (dof == math.inf)
    assert original_prediction.dof == loaded_prediction.dof == (math.inf if dof is None else dof)
    densities = [
        negative_log_likelihood(predicted, torch.zeros(50, 6)) for predicted in (original_prediction, loaded_prediction)
    ]
    assert densities[0] == densities[1]
    first, second = (c.sampler(inputs, torch.Generator().manual_seed(3)) for c in (car, loaded))
    assert torch.equal(first, second)


CHANGED_PARTS: dict[str, Callable[[dict[str, Any]], object]] = {
    "another version": lambda content: content | {"version": 99},
    "a particle without one parameter": lambda content: content | {"parameters": content["parameters"][:, :-1]},
    "one particle": lambda content: content | {"parameters": content["parameters"][0]},
    "another network": lambda content: content | {"network": [INPUTS + 2, 6, 8, 4]},
    "unknown activation": lambda content: content | {"activation": "tanh"},
    "missing key": lambda content: {name: part for name, part in content.items() if name != "units"},
    "a list": lambda content: [1, 2],
}
CHANGED_BYTES: dict[str, Callable[[bytes], bytes]] = {
    "cut short": lambda content: content[: len(content) // 2],
    "empty": lambda content: b"",
    "text": lambda content: b"rubbish\n",
}


def test_file_of_an_earlier_version_is_reported_with_its_version(tmp_path: Path) -> None:
    """An earlier file lacks parts that were added later."""
    path = tmp_path / "car.pt"
    save_car(random_car(), path)
    content: dict[str, Any] = torch.load(path, weights_only=True)
    del content["activation"]
    torch.save(content | {"version": 2}, path)
    with pytest.raises(
        DataError, match=r"^[^ ]*car\.pt has version 2, this program reads versions 6 and 7; remove its folder"
    ):
        load_car(path)


@pytest.mark.parametrize("kind", ["missing", *CHANGED_PARTS, *CHANGED_BYTES])
def test_invalid_car_file_is_refused_with_the_remedy(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "car.pt"
    save_car(random_car(), path)
    if kind == "missing":
        path.unlink()
    elif kind in CHANGED_PARTS:
        torch.save(CHANGED_PARTS[kind](torch.load(path, weights_only=True)), path)
    else:
        path.write_bytes(CHANGED_BYTES[kind](path.read_bytes()))
    with pytest.raises(DataError, match=r"remove its folder to train again\.$") as error:
        load_car(path)
    assert str(error.value).count("to train again") == 1
    assert "car.pt" in str(error.value)


def test_fit_without_rows_reproduces_the_simulator_prior() -> None:
    """The reference is the mean of cars with gains across the prior range."""
    model = CarModel(SimulatorConfig(kind="kinematic"), 1, {"motor.drive_gain": (5.0, 12.0)})
    steps_done: list[int] = []
    car = fit_car(None, model, CarFitSettings(steps=600, particles=12), progress=steps_done.append)
    inputs = model.inputs(300, torch.Generator().manual_seed(9))
    gains = torch.linspace(5.0, 12.0, 101)[:, None]
    truth = model(inputs, gains)
    found = car.predict(inputs)
    rms_error = (found.mean - truth.mean(dim=0)).square().mean(dim=0).sqrt()
    assert torch.all(rms_error < 0.25 * truth.flatten(0, 1).std(dim=0))
    assert steps_done == [200, 400, 600]


def test_rows_with_another_history_are_refused(drive: tuple[EpisodeData, list[Transition]]) -> None:
    model = CarModel(SimulatorConfig(), 2, {"motor.drive_gain": (5.0, 12.0)})
    with pytest.raises(DataError, match="3 past commands, the model 2"):
        fit_car(transitions_of([drive[0]], HISTORY), model, CarFitSettings(steps=1))


class PartlyFailingModel(CarModel):
    """A simulator that gives huge states for strong motors and NaN for stronger ones."""

    too_strong: ClassVar[float] = 11.0

    def _roll(
        self, start: Tensor, commands: Tensor, past: Tensor | None, parameters: Tensor, each: int
    ) -> torch.Tensor:
        states = CarModel._roll(self, start, commands, past, parameters, each)
        strong = parameters[:, 0].repeat_interleave(each)
        states[strong > self.too_strong] *= 1e30
        states[strong > self.too_strong + 0.5] = math.nan
        return states


class AlwaysFailingModel(PartlyFailingModel):
    too_strong: ClassVar[float] = 5.0


def kinematic(kind: type[CarModel]) -> CarModel:
    config = choose_car("sim").simulator
    ranges = {"motor.drive_gain": (4.0, 12.0), "steering.max_angle": (0.2, 0.6)}
    return kind(replace(config, kind="kinematic", priors={}), HISTORY, ranges)


def test_prior_draws_with_invalid_states_are_excluded() -> None:
    settings = CarFitSettings(steps=40, particles=6)
    reference, fitted = (fit_car(None, kinematic(kind), settings) for kind in (CarModel, PartlyFailingModel))
    reference_units, fitted_units = reference.posterior.normaliser, fitted.posterior.normaliser
    assert torch.allclose(reference_units.output_std, fitted_units.output_std, rtol=0.2)
    assert torch.allclose(reference_units.input_std, fitted_units.input_std, rtol=0.2)
    inputs = kinematic(PartlyFailingModel).inputs(500, torch.Generator().manual_seed(0))
    assert len(inputs) == 500
    assert float(inputs.abs().max()) < 100.0
    prediction = fitted.predict(inputs)
    assert bool(torch.isfinite(prediction.means).all())


def test_prior_without_finite_outputs_is_reported() -> None:
    with pytest.raises(DataError, match="simulator gives no finite outputs") as error:
        fit_car(None, kinematic(AlwaysFailingModel), CarFitSettings(steps=5))
    assert "\n" not in str(error.value)
