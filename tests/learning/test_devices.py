"""All of learning on another device gives what it gives on the CPU: on a stand-in for CUDA, and on CUDA where it is.

The stand-in (``tests/stand_in_device.py``) has the CPU's numbers and CUDA's refusals.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from carlab.core.episode_data import EpisodeData
from carlab.core.observation import feature_size
from carlab.core.task import ParkingTask, PathTask
from carlab.studies.regression.methods import METHODS, Way
from carlab.studies.regression.study import run_study
from learning.baselines import system_identification
from learning.baselines.system_identification import grey_box, identify
from learning.devices import synchronise
from learning.evaluation import Mixture, calibration_error, negative_log_likelihood
from learning.functional_svgd.authors_fsvgd import fit_authors_fsvgd
from learning.functional_svgd.fsvgd import FsvgdSettings, GaussianProcessPrior, fit_fsvgd
from learning.networks.normaliser import Normaliser
from learning.networks.particles import Network
from learning.policy.sac_agent import SacAgent, SacSettings
from learning.posterior.distillation import DistillationSettings, distil, measurement_points
from learning.posterior.function_posterior import FunctionPosterior
from learning.posterior.inference import infer
from learning.posterior.parameter_posterior import posterior_parameters
from learning.posterior.particle_posterior import ParticlePosterior
from learning.priors.domain_models import DomainModel, KinematicCar, Pendulum, Sinusoids, draw_parameters
from learning.priors.function_prior import RbfCovariance
from learning.priors.simulator_model import CarModel
from learning.transitions import Transitions
from learning.world.car_dynamics import CarDynamics
from learning.world.car_fit import CarFitSettings, fit_car, load_car, save_car
from learning.world.model_env import ModelEnv
from sim_backends.car_parameters import SimulatorConfig

ROWS, HISTORY = 48, 1
TRUE = Pendulum(frictions=(0.4, 0.6), drags=(0.4, 0.6))
PENDULUM_UNITS = Normaliser(
    torch.zeros(4), torch.tensor([1.0, 1.0, 3.5, 2.0]), torch.zeros(3), torch.tensor([0.158, 0.150, 0.951])
)
NOISE = torch.tensor([0.02, 0.02, 0.02])
RANGES = {"motor.drive_gain": (6.0, 10.0), "steering.max_angle": (0.3, 0.7)}


@pytest.fixture(autouse=True)
def brief(monkeypatch: pytest.MonkeyPatch) -> None:
    """The stand-in takes its time for an operation; nothing here is to be learned well."""
    monkeypatch.setattr("learning.posterior.discrepancy.STEPS", 10)
    monkeypatch.setattr("learning.baselines.system_identification.STEPS", 10)
    monkeypatch.setattr("learning.posterior.inference.PRIOR_DRAWS", 64)
    monkeypatch.setattr("learning.posterior.inference.PARAMETER_DRAWS", 16)
    monkeypatch.setattr("learning.posterior.parameter_posterior.MAX_TEMPERING_STEPS", 3)
    monkeypatch.setattr("learning.posterior.parameter_posterior.RANDOM_WALK_STEPS", 2)


def close(found: Any, wanted: Any, tolerance: float = 1e-4) -> None:
    """Equal numbers, the first of which are not on the CPU."""
    assert found.device.type == "cuda"
    assert wanted.device.type == "cpu"
    torch.testing.assert_close(found.cpu(), wanted, rtol=tolerance, atol=tolerance)


def pendulum() -> tuple[Tensor, Tensor]:
    """Rows of a pendulum with friction, two of them spoilt."""
    generator = torch.Generator().manual_seed(0)
    inputs = TRUE.inputs(ROWS, generator)
    outputs = TRUE(inputs, draw_parameters(TRUE, 1, generator))[0]
    outputs = outputs + NOISE * torch.randn(outputs.shape, generator=generator)
    outputs[[5, 20]] += 2.0
    return inputs, outputs


def everywhere(work: Callable[[str], Any], device: str) -> tuple[Any, Any]:
    """The same there and on the CPU."""
    return work(device), work("cpu")


def inferred(model: DomainModel | None, device: str) -> FunctionPosterior:
    inputs, outputs = (v.to(device) for v in pendulum())
    return infer(model, inputs, outputs, PENDULUM_UNITS.to(device), NOISE.to(device))


@pytest.mark.parametrize(
    "what",
    [
        lambda t: t + torch.zeros(3),
        lambda t: torch.zeros(3).add_(t),
        lambda t: torch.cat([t, torch.zeros(1)]),
        lambda t: t[torch.arange(2)],
        lambda t: torch.zeros(3)[t > 0],
        lambda t: t.numpy(),
        np.asarray,
        lambda t: torch.randn(3, generator=torch.Generator(), device=t.device),
    ],
)
def test_what_does_not_work_on_a_device_is_refused(device: str, what: Callable[[Tensor], Any]) -> None:
    """Of the stand-in, that it can fail."""
    with pytest.raises((RuntimeError, TypeError)):
        what(torch.ones(3, device=device))


def test_what_cuda_has_is_known(stand_in_device: ModuleType) -> None:
    """Of the list that the stand-in's operations are held to."""
    known = ("mul.Tensor", "add.Tensor", "linalg_cholesky_ex", "cov", "mkldnn_linear")
    assert stand_in_device.without_cuda(known) == ["mkldnn_linear"]


def test_what_crosses_is_a_copy(device: str) -> None:
    here = torch.ones(3)
    there = here.to(device)
    there.mul_(2.0)[1:].add_(1.0)
    here.add_(10.0)
    assert there.cpu().tolist() == [2.0, 3.0, 3.0]
    assert here.tolist() == [11.0, 11.0, 11.0]
    weight = torch.nn.Parameter(torch.zeros(3, device=device))
    weight.data = there
    there.add_(1.0)
    assert weight.tolist() == [3.0, 4.0, 4.0]
    (slope,) = torch.autograd.grad((weight**2).sum(), weight)
    assert slope.tolist() == [6.0, 8.0, 8.0]


@pytest.mark.parametrize("model", [Sinusoids(), Pendulum(), KinematicCar(), CarModel(SimulatorConfig(), 1, RANGES)])
def test_simulators(device: str, model: DomainModel) -> None:
    generator = torch.Generator().manual_seed(0)
    inputs, drawn = model.inputs(6, generator), draw_parameters(model, 4, generator)
    close(*everywhere(lambda at: model(inputs.to(at), drawn.to(at)), device))


@pytest.mark.parametrize("model", [None, Pendulum()])
def test_what_data_and_simulator_say(device: str, model: DomainModel | None) -> None:
    at = TRUE.inputs(12, torch.Generator().manual_seed(3))
    there, here = everywhere(lambda at: inferred(model, at), device)
    assert there.dof == here.dof < 10.0, "the branch of outliers was taken"
    close(there.noise_std, here.noise_std)
    for found, wanted in zip(there.predict(at.to(device)), here.predict(at), strict=True):
        close(found, wanted)
    for found, wanted in zip(
        there.marginals(at.view(4, 3, 4).to(device)), here.marginals(at.view(4, 3, 4)), strict=True
    ):
        close(found, wanted)


def test_draws_of_parameters(device: str) -> None:
    inputs, outputs = pendulum()

    def drawn(at: str) -> Tensor:
        factor = torch.eye(ROWS, dtype=torch.float64).expand(3, -1, -1).to(at)
        units, generator = PENDULUM_UNITS.to(at), torch.Generator().manual_seed(1)
        return posterior_parameters(TRUE, inputs.to(at), outputs.to(at), factor, units, 64, generator)

    close(*everywhere(drawn, device))
    prior = posterior_parameters(
        TRUE, inputs[:0].to(device), outputs[:0].to(device), torch.eye(0, device=device), PENDULUM_UNITS.to(device), 8,
        torch.Generator(),
    )  # fmt: skip
    assert prior.device.type == "cuda"


def test_particles(device: str) -> None:
    def fitted(at: str) -> ParticlePosterior:
        inputs = pendulum()[0].to(at)
        points = measurement_points(Pendulum(), inputs, PENDULUM_UNITS.to(at), torch.Generator().manual_seed(2), 256)
        settings = DistillationSettings(particles=6, hidden=(16, 16), steps=40, sets=4)
        return distil(inferred(None, at), points, settings)

    there, here = everywhere(fitted, device)
    close(there.parameters, here.parameters)
    close(there.noise_scales, here.noise_scales)
    close(there.to("cpu").to(device).predict(pendulum()[0].to(device)).means, here.predict(pendulum()[0]).means, 1e-3)


@pytest.mark.parametrize("natural", [True, False])
@pytest.mark.parametrize("interacting", [True, False])
def test_particles_as_the_authors_fit_them(device: str, natural: bool, interacting: bool) -> None:
    inputs, outputs = pendulum()
    pool = TRUE.inputs(40, torch.Generator().manual_seed(4))
    settings = FsvgdSettings(
        particles=4, hidden=(8,), steps=20, batch=16, measurement_points=8, natural=natural, interacting=interacting,
        noise_rows=2.0,
    )  # fmt: skip

    def fitted(at: str) -> ParticlePosterior:
        units = PENDULUM_UNITS.to(at)
        everything = units.inputs(torch.cat([inputs, pool]).to(at))
        prior = GaussianProcessPrior(everything, RbfCovariance((1.0,) * 3, (0.8,)))
        return fit_fsvgd(inputs.to(at), outputs.to(at), pool.to(at), prior, units, settings)

    there, here = everywhere(fitted, device)
    close(there.parameters, here.parameters, 1e-3)
    close(there.noise_std, here.noise_std)


def test_identification(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("STEPS", "REFINEMENT_STEPS"):
        monkeypatch.setattr(system_identification, name, 50)
    inputs, outputs = pendulum()
    pool = TRUE.inputs(40, torch.Generator().manual_seed(4))

    def found(at: str) -> Mixture:
        given = inputs.to(at), outputs.to(at)
        simulator = identify(Pendulum(), *given, NOISE.to(at))
        settings = FsvgdSettings(particles=2, hidden=(8,), steps=5)
        box = grey_box(
            simulator, *given, pool.to(at), RbfCovariance((1.0,) * 3, (0.8,)), PENDULUM_UNITS.to(at), settings
        )
        return box.predict(inputs.to(at))

    there, here = everywhere(found, device)
    close(there.means, here.means, 1e-3)
    close(there.stds, here.stds, 1e-3)


def test_figures_of_a_prediction(device: str) -> None:
    generator = torch.Generator().manual_seed(5)
    means, stds = torch.randn((4, 30, 3), generator=generator), 0.1 + torch.rand((4, 1, 3), generator=generator)
    targets = torch.randn((30, 3), generator=generator)
    there = Mixture(means.to(device), stds.to(device), 3.0).smoothed()
    here = Mixture(means, stds, 3.0).smoothed()
    close(there.std, here.std)
    for figure in (negative_log_likelihood, calibration_error):
        assert figure(there, targets.to(device)) == pytest.approx(figure(here, targets), rel=1e-5)


@pytest.fixture(scope="module")
def driven() -> Transitions:
    """Rows of a simulated car."""
    generator = torch.Generator().manual_seed(0)
    car = CarModel(SimulatorConfig(), HISTORY, {"motor.drive_gain": (8.0, 9.0)})
    inputs = car.inputs(24, generator)
    outputs = car(inputs, draw_parameters(car, 1, generator))[0]
    outputs = outputs + 0.002 * torch.randn(outputs.shape, generator=generator)
    return Transitions(inputs.double().numpy(), outputs.double().numpy(), np.zeros(24), np.arange(24), HISTORY)


def test_a_car_is_learned_kept_and_learned_on(device: str, driven: Transitions, tmp_path: Path) -> None:
    model = CarModel(SimulatorConfig(kind="kinematic"), HISTORY, RANGES)
    settings = CarFitSettings(steps=20, particles=6)
    here = fit_car(driven, model, settings)
    there = fit_car(driven, model, settings, device=device)
    close(there.posterior.parameters, here.posterior.parameters, 1e-3)
    save_car(there, tmp_path / "car.pt")
    kept = torch.load(tmp_path / "car.pt", weights_only=True)
    assert kept["parameters"].device.type == kept["units"][0].device.type == "cpu"
    read = load_car(tmp_path / "car.pt")
    assert read.posterior.parameters.device.type == "cpu"
    assert torch.equal(read.posterior.parameters, there.posterior.parameters.cpu())
    close(load_car(tmp_path / "car.pt", device).posterior.noise_std, read.posterior.noise_std, 0.0)
    on = fit_car(driven, model, settings, before=read, device=device)
    back = fit_car(driven, model, settings, before=there)
    close(on.posterior.parameters, back.posterior.parameters, 1e-3)
    assert torch.equal(on.posterior.normaliser.output_std.cpu(), here.posterior.normaliser.output_std)


def test_a_car_is_learned_as_the_authors_do(device: str) -> None:
    rng = np.random.default_rng(3)
    states, sent = 0.1 * rng.normal(size=(41, 6)).cumsum(axis=0), rng.uniform(-1, 1, (40, 2))
    episode = EpisodeData(np.arange(41) / 30.0, states, sent, sent, np.zeros(40))
    there, here = everywhere(lambda at: fit_authors_fsvgd([episode], HISTORY, 30, device=at), device)
    close(there.posterior.parameters, here.posterior.parameters, 1e-3)
    assert there.score_episode(episode) == pytest.approx(here.score_episode(episode), rel=1e-3)
    unfitted = fit_authors_fsvgd([], HISTORY, device=device)
    assert unfitted.posterior.parameters.device.type == "cuda"


def learned(device: str) -> CarDynamics:
    """Some particles of a car that moves a little."""
    width = 3 + 2 * (HISTORY + 1)
    network = Network(width, 6, (16,))
    units = Normaliser(torch.zeros(width), torch.ones(width), torch.zeros(6), torch.full((6,), 0.05))
    numbers = network.initial(5, torch.Generator().manual_seed(6))
    return CarDynamics(ParticlePosterior(network, numbers, torch.full((6,), 0.1), units, 3.0).to(device), HISTORY)


TASKS = [ParkingTask(history_length=HISTORY, max_ticks=6), PathTask(history_length=HISTORY, max_ticks=6)]


@pytest.mark.parametrize("task", TASKS, ids=lambda t: t.name)
def test_a_world_of_learned_cars(device: str, task: ParkingTask | PathTask) -> None:
    recorded = np.random.default_rng(0).normal(size=(9, feature_size(HISTORY)))
    commands = np.random.default_rng(1).uniform(-1.0, 1.0, (12, 16, 2)).astype(np.float32)
    there, here = (ModelEnv(learned(at), task, 16, recorded=recorded, device=at) for at in (device, "cpu"))
    np.testing.assert_allclose(there.reset(), here.reset(), atol=1e-6)
    ended = 0
    for action in commands:
        found, wanted = there.step(action), here.step(action)
        for a, b in zip(found[:3], wanted[:3], strict=True):
            np.testing.assert_allclose(a, b, atol=1e-4)
        assert [i.keys() for i in found[3]] == [i.keys() for i in wanted[3]]
        ended += int(found[2].sum())
    assert ended > 10
    close(there.features, here.features)
    for a, b in zip(*(env.roll_out(lambda seen: -0.5 * seen[:, :2]) for env in (there, here)), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-4)


SMALL = SacSettings(hidden=(16, 16), cars=16, warm_up=64, batch=32, updates=8, replay=4096)


def test_a_policy_is_trained_kept_and_trained_on(device: str, tmp_path: Path) -> None:
    agents = []
    for at in (device, "cpu"):
        agent = SacAgent(SMALL, 0, at)
        agent.train(
            ModelEnv(learned(at), TASKS[0], SMALL.cars, device=at), 24, evaluate=lambda agent: 1.0, n_evaluations=2
        )
        agents.append(agent)
    seen = np.random.default_rng(2).normal(size=(50, feature_size(HISTORY))).astype(np.float32)
    there, here = (agent.act(seen) for agent in agents)
    if not torch.cuda.is_available():  # A real one draws its exploration from a generator of its own.
        np.testing.assert_allclose(there, here, atol=1e-3)
    agents[0].save(tmp_path)
    again = SacAgent.load(tmp_path, SMALL, 0, device)
    assert again.policy().sac.device.type == "cpu", "what drives a car does so on the CPU"
    np.testing.assert_allclose(again.act(seen), there, atol=1e-6)
    again.train(ModelEnv(learned(device), TASKS[0], SMALL.cars, device=device), 8)
    assert next(again.policy().sac.policy.parameters()).device.type == "cuda"
    assert not np.allclose(again.act(seen), there, atol=1e-6)


def test_a_gradient_step_is_that_of_the_cpu(device: str) -> None:
    """From the same networks, transitions and noise, forty times."""
    agents = []
    for at in (device, "cpu"):
        agent = SacAgent(SMALL, 0, at)
        agent.train(ModelEnv(learned(at), TASKS[0], SMALL.cars, device=at), 0)
        agents.append(agent.policy().sac)
    there, here = agents
    there.load_learned_state(here.learned_state())
    there.replay_buffer = copy.copy(here.replay_buffer)
    there.replay_buffer.device = there.device
    for agent in agents:
        agent.set_random_seed(0)
        agent.train(40, 32)
    for (name, found), wanted in zip(there.policy.state_dict().items(), here.policy.state_dict().values(), strict=True):
        assert found.device.type == "cuda", name
        torch.testing.assert_close(found.cpu(), wanted, rtol=1e-3, atol=1e-3)
    close(there.log_ent_coef, here.log_ent_coef)


@pytest.mark.parametrize("way", ["ours", "authors"])
def test_a_regression_study(device: str, way: Way, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("STEPS", "REFINEMENT_STEPS"):
        monkeypatch.setattr(system_identification, name, 20)
    there = None
    for there, here in zip(
        *(run_study("pendulum", rows=(5,), seeds=1, way=way, steps=10, device=at) for at in (device, "cpu")),
        strict=True,
    ):
        assert there.method == here.method
        assert (there.nll, there.rmse, there.calibration) == pytest.approx(
            (here.nll, here.rmse, here.calibration), rel=2e-2
        ), there.method
    assert there.method == list(METHODS)[-1]


def test_speed_is_measured_there(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    from learning import speed

    monkeypatch.setattr(speed, "STEPS", 400)
    monkeypatch.setattr(speed, "SIZES", {"small": (4, 2, 9)})
    monkeypatch.setattr(speed, "CAR_FIT", CarFitSettings(steps=20))
    synchronise(device)
    training = speed.training_speed(device)
    assert training["small"]["steps_per_s"] > 0.0
    assert training["a car from 100 rows, as carlab learn"]["whole_fit_s"] > 0.0
    prediction = speed.prediction_speed(device)
    assert min(prediction[name] for name in ("batch_ms", "posterior_ms", "learned_car_ms")) > 0.0
