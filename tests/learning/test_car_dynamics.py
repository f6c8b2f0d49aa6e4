"""A learned car: exact kinematics against a recorded drive, draws against a mixture in closed form, and its file."""

from __future__ import annotations

import math
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
from learning.world.car_fit import FILE_VERSION, CarFitSettings, fit_car, load_car, save_car
from sim_backends.car_parameters import SimulatorConfig

HISTORY = 3
INPUTS = 3 + 2 * (HISTORY + 1)


class Circling:
    """Random commands that turn the car through more than a full circle."""

    name = "circling"

    def reset(self) -> None: ...

    def act(self, view: PolicyInput) -> Action:
        rng = np.random.default_rng(view.step)
        return Action(float(rng.uniform(0.4, 1.0)), float(rng.uniform(0.3, 0.7)))


@pytest.fixture(scope="module")
def drive() -> tuple[EpisodeData, list[Transition]]:
    """A drive of the simulated car, and each of its transitions as the control loop saw it."""
    choice = choose_car("sim", seed=0)
    seen: list[Document] = []
    with choice.car as car:
        car.place(CarState(yaw_rad=3.0))
        driven = run_episode(
            car, Circling(), replace(ParkingTask(), history_length=HISTORY), choice.envelope,
            period_s=choice.control_period_s, max_ticks=90, hooks=EpisodeHooks(emit=seen.append),
        )  # fmt: skip
    return driven, [d for d in seen if isinstance(d, Transition)]


def test_a_drive_is_carried_on_exactly(drive: tuple[EpisodeData, list[Transition]]) -> None:
    driven, transitions = drive
    rows = transitions_of([driven], HISTORY)
    own = [transitions[k] for k in rows.tick]
    assert len(own) > 60
    assert np.ptp(driven.states[:, 2]) > 6.0, "yaw jumps from pi to -pi on the way"
    features = torch.from_numpy(np.array([t.features for t in own]))
    action = torch.from_numpy(np.array([t.action.to_array() for t in own]))
    after = advance(features, action, torch.from_numpy(rows.targets)).numpy()
    np.testing.assert_allclose(after, [t.next_features for t in own], atol=1e-12)
    wanted = driven.states[rows.tick + 1]
    np.testing.assert_allclose(after[:, [0, 1, 4, 5, 6]], wanted[:, [0, 1, 3, 4, 5]], atol=1e-12)
    yaw = np.arctan2(after[:, 2], after[:, 3])
    np.testing.assert_allclose(np.exp(1j * yaw), np.exp(1j * wanted[:, 2]), atol=1e-12)


def test_inputs_at_a_step_are_those_of_the_recorded_rows(drive: tuple[EpisodeData, list[Transition]]) -> None:
    driven, transitions = drive
    rows = transitions_of([driven], HISTORY)
    features = torch.from_numpy(np.array([transitions[k].features for k in rows.tick]))
    sent = torch.from_numpy(driven.sent[rows.tick])
    inputs = inputs_of(features, sent).numpy()
    np.testing.assert_array_equal(inputs, rows.inputs)
    np.testing.assert_array_equal(inputs[:, -2:], [transitions[k].action.to_array() for k in rows.tick])


def test_without_a_history_a_step_forgets_the_command() -> None:
    features = torch.tensor([[1.0, 2.0, 1.0, 0.0, 0.5, 0.0, 0.0]])  # heading along y
    after = advance(features, torch.tensor([[0.3, 0.4]]), torch.tensor([[0.2, 0.1, math.pi / 2, 0.1, 0.0, -0.2]]))
    assert after[0].tolist() == pytest.approx([0.9, 2.2, 0.0, -1.0, 0.6, 0.0, -0.2], abs=1e-6)


def known_car(values: Tensor, dof: float = math.inf, noise: float = 0.5) -> CarDynamics:
    """Particles that each say one value (L, 6), whatever the input."""
    network = Network(INPUTS, 6, (4,))
    parameters = torch.zeros(len(values), network.parameters)
    parameters[:, -6:] = values
    units = Normaliser(torch.zeros(INPUTS), torch.ones(INPUTS), torch.full((6,), 0.3), torch.arange(1.0, 7.0))
    return CarDynamics(ParticlePosterior(network, parameters, torch.full((6,), noise), units, dof), HISTORY)


@pytest.mark.parametrize("dof", [math.inf, 5.0])
def test_draws_are_those_of_the_mixture(dof: float) -> None:
    """Equal shares of four Gaussians: mean and variance by the law of total variance, kurtosis by their moments.

    Of Student noise each has a scale of its own: the root of 5 over the middle of a quarter of chi square.
    """
    values = torch.randn(4, 6, generator=torch.Generator().manual_seed(2))
    car = known_car(values, dof, noise=0.85)
    count = 40_000
    drawn = car.sample(torch.zeros(count, INPUTS), torch.Generator().manual_seed(0)).double()
    unit = torch.arange(1.0, 7.0).double()
    means = 0.3 + values.double() * unit
    scales = np.ones(4) if math.isinf(dof) else np.sqrt(dof / chi2.ppf([0.125, 0.375, 0.625, 0.875], dof))
    stds = 0.85 * unit * torch.from_numpy(scales)[:, None]
    mean = means.mean(dim=0)
    away = means - mean
    variance = (away**2 + stds**2).mean(dim=0)
    fourth = (away**4 + 6 * away**2 * stds**2 + 3 * stds**4).mean(dim=0)
    assert torch.all((drawn.mean(dim=0) - mean).abs() < 4 * (variance / count).sqrt())
    found = ((drawn - mean) ** 2).mean(dim=0)
    assert torch.all((found - variance).abs() < 4 * ((fourth - variance**2) / count).sqrt())
    predicted = car.predict(torch.zeros(1, INPUTS))
    torch.testing.assert_close(predicted.mean[0].double(), mean, rtol=1e-5, atol=1e-5)
    variance = (away**2).mean(dim=0) + (0.85 * unit) ** 2 * (1.0 if math.isinf(dof) else 5.0 / 3.0)
    torch.testing.assert_close(predicted.std[0].double(), variance.sqrt(), rtol=1e-5, atol=1e-5)


def test_every_particle_gets_its_share_and_every_row_a_particle_of_its_own() -> None:
    car = known_car(torch.arange(5.0)[:, None].expand(5, 6), noise=1e-6)
    drawn = car.sample(torch.zeros(200, INPUTS), torch.Generator().manual_seed(0))
    said = (drawn[:, 0] - 0.3).round().int()
    assert torch.bincount(said).tolist() == [40] * 5
    assert len(said.unique_consecutive()) > 100, "they are not assigned in order"


@pytest.mark.parametrize("count", [1, 3, 7, 64])
def test_every_row_meets_every_particle_equally_often_however_many_rows_there_are(count: int) -> None:
    car = known_car(torch.arange(5.0)[:, None].expand(5, 6), noise=1e-6)
    generator, inputs = torch.Generator().manual_seed(0), torch.zeros(count, INPUTS)
    said = torch.stack([(car.sample(inputs, generator)[:, 0] - 0.3).round() for _ in range(1500)])
    for row in {0, count - 1}:
        often = torch.bincount(said[:, row].int(), minlength=5)
        assert torch.all((often - 300).abs() < 5 * math.sqrt(1500 * 0.2 * 0.8)), (row, often)


def test_a_row_is_answered_for_its_own_inputs() -> None:
    """A network that says vx back: the draw of a row must be near that of the row, whichever particle it met."""
    network = Network(INPUTS, 6, (2,), slope=1.0)
    parameters = torch.zeros(3, network.parameters)
    (first, _), (last, _) = network.split(parameters)
    first[:, 0, 0] = last[:, 0, :] = 1.0
    units = Normaliser(torch.zeros(INPUTS), torch.ones(INPUTS), torch.zeros(6), torch.ones(6))
    car = CarDynamics(ParticlePosterior(network, parameters, torch.full((6,), 1e-4), units), HISTORY)
    inputs = torch.zeros(100, INPUTS)
    inputs[:, 0] = torch.arange(100.0) / 20.0
    drawn = car.sample(inputs, torch.Generator().manual_seed(0))
    assert torch.allclose(drawn, inputs[:, :1].expand(100, 6), atol=1e-3)


def test_a_world_that_feeds_on_itself_does_not_run_away() -> None:
    """A yaw rate that doubles at each step is that of the edge from there on: it grows by as much, and no more."""
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
    """The same numbers in decorrelated units."""
    return replace(car, posterior=replace(car.posterior, normaliser=car.posterior.normaliser.decorrelated(by)))


def test_noise_of_one_draw_is_correlated_as_the_turn_says() -> None:
    car = decorrelated(known_car(torch.zeros(4, 6)))
    drawn = car.sample(torch.zeros(40_000, INPUTS), torch.Generator().manual_seed(0)).double().numpy()
    unit = np.arange(1.0, 7.0)
    back = np.linalg.inv(DECORRELATION.numpy())
    shape = 0.25 * unit[:, None] * (back @ back.T) * unit
    assert np.allclose(np.cov(drawn.T), shape, atol=0.03 * np.sqrt(np.outer(np.diag(shape), np.diag(shape))))
    predicted = car.predict(torch.zeros(1, INPUTS))
    assert np.allclose(predicted.marginal_scales[0, 0], np.sqrt(np.diag(shape)), rtol=1e-4)
    assert np.allclose(predicted.mean, 0.3, atol=1e-5)


def test_particles_taken_over_into_other_units_are_the_same_functions() -> None:
    inputs = torch.randn(50, INPUTS, generator=torch.Generator().manual_seed(1))
    for car in (some_car(), decorrelated(some_car(), DECORRELATION.T)):
        for normaliser in (
            car.posterior.normaliser.without_decorrelation().decorrelated(DECORRELATION),
            car.posterior.normaliser.without_decorrelation(),
        ):
            parameters = car.posterior.parameters_for(normaliser)
            there = replace(car.posterior, parameters=parameters, normaliser=normaliser).predict(inputs)
            torch.testing.assert_close(there.means, car.predict(inputs).means, rtol=1e-4, atol=1e-5)


def some_car(dof: float = math.inf) -> CarDynamics:
    generator = torch.Generator().manual_seed(5)
    network = Network(INPUTS, 6, (8, 4), "silu")
    units = Normaliser(*(torch.rand(n, generator=generator) + 0.5 for n in (INPUTS, INPUTS, 6, 6)))
    noise = torch.rand(6, generator=generator)
    return CarDynamics(ParticlePosterior(network, network.initial(3, generator), noise, units, dof), HISTORY)


def whole_car() -> CarDynamics:
    """A car as learned from many rows: with a trend, decorrelated and correlated errors, and an input clip."""
    generator = torch.Generator().manual_seed(8)
    car = decorrelated(some_car())
    root = torch.eye(6) + 0.3 * torch.randn((6, 6), generator=generator)
    shape = root @ root.T
    scale = shape.diagonal().rsqrt()
    trend = 0.5 * torch.randn((1 + INPUTS, 6), generator=generator)
    input_clip = 0.5 + torch.rand(INPUTS, generator=generator)
    posterior = replace(car.posterior, trend=trend, correlation=scale[:, None] * shape * scale, input_clip=input_clip)
    return replace(car, posterior=posterior)


def test_draws_of_a_whole_car_have_the_moments_of_its_parts() -> None:
    car = whole_car()
    posterior, units = car.posterior, car.posterior.normaliser
    assert posterior.trend is not None
    assert posterior.correlation is not None
    assert posterior.input_clip is not None
    row = 3.0 * torch.randn((1, INPUTS), generator=torch.Generator().manual_seed(1))
    seen = (row - units.input_mean) / units.input_std
    assert bool((seen.abs() > posterior.input_clip).any()), "some of it is clipped"
    seen = seen.clamp(-posterior.input_clip, posterior.input_clip)
    network = posterior.network(posterior.parameters, seen)[:, 0].double()
    line = (posterior.trend[0] + seen[0] @ posterior.trend[1:]).double()
    back = units.output_std.double()[:, None] * torch.linalg.inv(DECORRELATION.double())
    centres = units.output_mean.double() + (network + line) @ back.T
    noise = posterior.noise_std.double()
    own = back @ (noise[:, None] * posterior.correlation.double() * noise) @ back.T
    covariance = own + torch.cov(centres.T, correction=0)
    drawn = car.sample(row.expand(60_000, -1), torch.Generator().manual_seed(2)).double()
    spread = covariance.diagonal().sqrt()
    assert torch.allclose(drawn.mean(dim=0), centres.mean(dim=0), atol=0.02 * float(spread.max()))
    assert torch.allclose(torch.cov(drawn.T), covariance, atol=0.03 * float((spread[:, None] * spread).max()))
    predicted = car.predict(row)
    assert torch.allclose(predicted.mean[0].double(), centres.mean(dim=0), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("dof", [math.inf, 2.5, None])
def test_a_car_from_its_file_predicts_alike(tmp_path: Path, dof: float | None) -> None:
    car = whole_car() if dof is None else some_car(dof)
    if dof == 2.5:
        car = decorrelated(car)
    save_car(car, tmp_path / "car.pt")
    again = load_car(tmp_path / "car.pt")
    assert again.history == HISTORY
    inputs = torch.randn(50, INPUTS, generator=torch.Generator().manual_seed(1))
    ours, theirs = car.predict(inputs), again.predict(inputs)
    assert torch.equal(ours.means, theirs.means)
    assert torch.equal(ours.stds, theirs.stds)
    assert (ours.decorrelation is None) == (theirs.decorrelation is None) == (dof == math.inf)
    assert ours.dof == theirs.dof == (math.inf if dof is None else dof)
    densities = [negative_log_likelihood(predicted, torch.zeros(50, 6)) for predicted in (ours, theirs)]
    assert densities[0] == densities[1]
    first, second = (c.sample(inputs, torch.Generator().manual_seed(3)) for c in (car, again))
    assert torch.equal(first, second)


def damaged(path: Path, kind: str) -> None:
    save_car(some_car(), path)
    whole = path.read_bytes()
    content: dict[str, Any] = torch.load(path, weights_only=True)
    if kind == "of another version":
        torch.save(content | {"version": 99}, path)
    elif kind == "a particle short of a number":
        torch.save(content | {"parameters": content["parameters"][:, :-1]}, path)
    elif kind == "one particle alone":
        torch.save(content | {"parameters": content["parameters"][0]}, path)
    elif kind == "of another network":
        torch.save(content | {"network": [INPUTS + 2, 6, 8, 4]}, path)
    elif kind == "of an unknown activation":
        torch.save(content | {"activation": "tanh"}, path)
    elif kind == "without a part":
        del content["units"]
        torch.save(content, path)
    elif kind == "a list":
        torch.save([1, 2], path)
    elif kind == "not there":
        path.unlink()
    else:
        path.write_bytes({"cut short": whole[: len(whole) // 2], "empty": b"", "text": b"rubbish\n"}[kind])


def test_a_file_of_an_earlier_version_is_called_that(tmp_path: Path) -> None:
    """Such a file lacks what came later."""
    path = tmp_path / "car.pt"
    save_car(some_car(), path)
    content: dict[str, Any] = torch.load(path, weights_only=True)
    del content["activation"]
    torch.save(content | {"version": 2}, path)
    with pytest.raises(
        DataError, match=rf"^[^ ]*car\.pt has version 2, this program reads version {FILE_VERSION}; remove its folder"
    ):
        load_car(path)


KINDS = (
    *("of another version", "a particle short of a number", "of another network", "without a part", "a list"),
    "of an unknown activation",
    *("not there", "cut short", "empty", "one particle alone", "text"),
)


@pytest.mark.parametrize("kind", KINDS)
def test_a_file_that_is_no_learned_car_is_refused_with_what_to_do(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "car.pt"
    damaged(path, kind)
    with pytest.raises(DataError, match=r"remove its folder to train again\.$") as said:
        load_car(path)
    assert str(said.value).count("to train again") == 1
    assert "car.pt" in str(said.value)


def test_without_rows_the_learned_car_is_its_simulator() -> None:
    """Mean and spread of its particles against cars drawn from the ranges."""
    model = CarModel(SimulatorConfig(kind="kinematic"), 1, {"motor.drive_gain": (5.0, 12.0)})
    steps_done: list[int] = []
    car = fit_car(None, model, CarFitSettings(steps=600, particles=12), progress=steps_done.append)
    inputs = model.inputs(300, torch.Generator().manual_seed(9))
    gains = torch.linspace(5.0, 12.0, 101)[:, None]
    truth = model(inputs, gains)
    found = car.predict(inputs)
    away = (found.mean - truth.mean(dim=0)).square().mean(dim=0).sqrt()
    assert torch.all(away < 0.25 * truth.flatten(0, 1).std(dim=0))
    assert steps_done == [200, 400, 600]


def test_rows_with_another_history_are_refused(drive: tuple[EpisodeData, list[Transition]]) -> None:
    model = CarModel(SimulatorConfig(), 2, {"motor.drive_gain": (5.0, 12.0)})
    with pytest.raises(DataError, match="3 past commands, the model 2"):
        fit_car(transitions_of([drive[0]], HISTORY), model, CarFitSettings(steps=1))


class Breaking(CarModel):
    """A simulator that runs away for strong motors: to where no car has been, or to no number."""

    too_strong: ClassVar[float] = 11.0

    def _roll(
        self, start: Tensor, commands: Tensor, past: Tensor | None, parameters: Tensor, each: int
    ) -> torch.Tensor:
        states = CarModel._roll(self, start, commands, past, parameters, each)
        strong = parameters[:, 0].repeat_interleave(each)
        states[strong > self.too_strong] *= 1e30
        states[strong > self.too_strong + 0.5] = math.nan
        return states


class Broken(Breaking):
    too_strong: ClassVar[float] = 5.0


def kinematic(kind: type[CarModel]) -> CarModel:
    config = choose_car("sim").simulator
    ranges = {"motor.drive_gain": (4.0, 12.0), "steering.max_angle": (0.2, 0.6)}
    return kind(replace(config, kind="kinematic", priors={}), HISTORY, ranges)


def test_a_prior_that_breaks_down_for_some_draws_is_learned_from_the_others() -> None:
    settings = CarFitSettings(steps=40, particles=6)
    whole, partly = (fit_car(None, kinematic(kind), settings) for kind in (CarModel, Breaking))
    ours, theirs = whole.posterior.normaliser, partly.posterior.normaliser
    assert torch.allclose(ours.output_std, theirs.output_std, rtol=0.2)
    assert torch.allclose(ours.input_std, theirs.input_std, rtol=0.2)
    inputs = kinematic(Breaking).inputs(500, torch.Generator().manual_seed(0))
    assert len(inputs) == 500
    assert float(inputs.abs().max()) < 100.0
    said = partly.predict(inputs)
    assert bool(torch.isfinite(said.means).all())


def test_a_prior_that_cannot_be_integrated_is_said() -> None:
    with pytest.raises(DataError, match="simulator gives no finite outputs") as error:
        fit_car(None, kinematic(Broken), CarFitSettings(steps=5))
    assert "\n" not in str(error.value)
