"""Test that learning on CUDA gives the results of the CPU, on a stand-in for CUDA and on real CUDA if present.

The stand-in (``tests/stand_in_device.py``) computes on the CPU and raises the errors of CUDA.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from decaying_car import PERIOD_S, decaying_car, driven_windows
from torch import Tensor

from carlab.core.episode_data import EpisodeData
from carlab.core.observation import feature_size
from carlab.core.path_tasks import LapTask
from carlab.core.task import ObstacleParkingTask
from carlab.studies.regression.methods import METHODS
from carlab.studies.regression.study import run_study
from learning.baselines import system_identification
from learning.devices import synchronise
from learning.evaluation import Mixture, calibration_error, negative_log_likelihood
from learning.functional_svgd.authors_fsvgd import fit_authors_fsvgd
from learning.functional_svgd.fsvgd import FsvgdSettings, GaussianProcessPrior, fit_fsvgd
from learning.networks.normaliser import Normaliser
from learning.networks.particles import Network
from learning.policy.sac_agent import SacAgent, SacSettings
from learning.posterior import averaging, discrepancy, parameter_posterior
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
from learning.world.disturbance import DisturbanceProcess
from learning.world.model_env import ModelEnv
from learning.world.rollout_fit import RolloutFitSettings, fit_rollouts
from sim_backends.car_parameters import SimulatorConfig

ROWS, HISTORY = 42, 1
TRUE = Pendulum(frictions=(0.4, 0.6), drags=(0.4, 0.6))
STDS = (torch.tensor([1.0, 1.0, 3.5, 2.0]), torch.tensor([0.158, 0.150, 0.951]))
PENDULUM_UNITS, NOISE = Normaliser(torch.zeros(4), STDS[0], torch.zeros(3), STDS[1]), torch.full((3,), 0.02)
RANGES = {"motor.drive_gain": (6.0, 10.0), "steering.max_angle": (0.3, 0.7)}


@pytest.fixture(autouse=True)
def few_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reduce the numbers of steps, because operations on the stand-in are slow."""
    for name, value in (
        *(("posterior.discrepancy.STEPS", 4), ("baselines.system_identification.STEPS", 4)),
        *(("posterior.residuals.SCALE_ITERATIONS", 5), ("posterior.inference.ITERATIONS", 2)),
        *(("posterior.inference.PRIOR_DRAWS", 64), ("posterior.inference.PARAMETER_DRAWS", 16)),
        *(("posterior.parameter_posterior." + part, 2) for part in ("MAX_TEMPERING_STEPS", "RANDOM_WALK_STEPS")),
    ):
        monkeypatch.setattr(f"learning.{name}", value)


def assert_close(found: Any, expected: Any, tolerance: float = 1e-4) -> None:
    """Assert that ``found`` is on CUDA, ``expected`` on the CPU, and their values are close."""
    assert found.device.type == "cuda"
    assert expected.device.type == "cpu"
    torch.testing.assert_close(found.cpu(), expected, rtol=tolerance, atol=tolerance)


def pendulum() -> tuple[Tensor, Tensor]:
    """Return rows of a pendulum with friction and two outliers."""
    generator = torch.Generator().manual_seed(0)
    inputs = TRUE.inputs(ROWS, generator)
    outputs = TRUE(inputs, draw_parameters(TRUE, 1, generator))[0]
    outputs = outputs + NOISE * torch.randn(outputs.shape, generator=generator)
    outputs[[5, 20]] += 2.0
    return inputs, outputs


def on_both(work: Callable[[str], Any], device: str) -> tuple[Any, Any]:
    """Return the result on the device and on the CPU."""
    return work(device), work("cpu")


def inferred(model: DomainModel | None, device: str) -> FunctionPosterior:
    inputs, outputs = (v.to(device) for v in pendulum())
    return infer(model, inputs, outputs, PENDULUM_UNITS.to(device), NOISE.to(device))


@pytest.mark.parametrize(
    "operation",
    [
        lambda t: t + torch.zeros(3),
        lambda t: torch.zeros(3).add_(t),
        lambda t: torch.cat([t, torch.zeros(1)]),
        lambda t: torch.zeros(3)[t > 0],
        lambda t: t.numpy(),
        np.asarray,
        lambda t: torch.randn(3, generator=torch.Generator(), device=t.device),
    ],
)
def test_operations_that_cuda_refuses_raise_errors(device: str, operation: Callable[[Tensor], Any]) -> None:
    """The stand-in must raise where CUDA raises."""
    with pytest.raises((RuntimeError, TypeError)):
        operation(torch.ones(3, device=device))


def test_operations_without_a_cuda_kernel_are_listed(stand_in_device: ModuleType) -> None:
    """torch's operator list decides which operations of the stand-in CUDA supports."""
    known = ("mul.Tensor", "add.Tensor", "linalg_cholesky_ex", "cov", "mkldnn_linear")
    assert stand_in_device.without_cuda(known) == ["mkldnn_linear"]


def test_transfer_between_devices_copies(device: str) -> None:
    on_cpu = torch.ones(3)
    on_device = on_cpu.to(device)
    on_device.mul_(2.0)[1:].add_(1.0)
    on_cpu.add_(10.0)
    assert on_device.cpu().tolist() == [2.0, 3.0, 3.0]
    assert on_cpu.tolist() == [11.0, 11.0, 11.0]
    weight = torch.nn.Parameter(torch.zeros(3, device=device))
    weight.data = on_device
    on_device.add_(1.0)
    assert weight.tolist() == [3.0, 4.0, 4.0]
    (slope,) = torch.autograd.grad((weight**2).sum(), weight)
    assert slope.tolist() == [6.0, 8.0, 8.0]


@pytest.mark.parametrize("model", [Sinusoids(), Pendulum(), KinematicCar(), CarModel(SimulatorConfig(), 1, RANGES)])
def test_simulator_outputs_are_equal_on_the_device(device: str, model: DomainModel) -> None:
    generator = torch.Generator().manual_seed(0)
    inputs, drawn = model.inputs(6, generator), draw_parameters(model, 4, generator)
    assert_close(*on_both(lambda at: model(inputs.to(at), drawn.to(at)), device))


@pytest.mark.parametrize("model", [None, Pendulum()])
def test_function_posterior_is_equal_on_the_device(device: str, model: DomainModel | None) -> None:
    at = TRUE.inputs(12, torch.Generator().manual_seed(3))
    on_device, on_cpu = on_both(lambda at: inferred(model, at), device)
    assert on_device.dof == on_cpu.dof < 10.0, "the branch with outliers must be used"
    assert_close(on_device.noise_std, on_cpu.noise_std)
    found, expected = on_device.predict(at.to(device)), on_cpu.predict(at)
    assert_close(found.means, expected.means)
    assert_close(found.stds, expected.stds)
    for found, expected in zip(
        on_device.marginals(at.view(4, 3, 4).to(device)), on_cpu.marginals(at.view(4, 3, 4)), strict=True
    ):
        assert_close(found, expected)


def test_parameter_draws_are_equal_on_the_device(device: str) -> None:
    inputs, outputs = pendulum()

    def drawn(at: str) -> Tensor:
        factor = torch.eye(ROWS, dtype=torch.float64).expand(3, -1, -1).to(at)
        units, generator = PENDULUM_UNITS.to(at), torch.Generator().manual_seed(1)
        return posterior_parameters(TRUE, inputs.to(at), outputs.to(at), factor, units, 64, generator)

    assert_close(*on_both(drawn, device))
    prior = posterior_parameters(
        TRUE, inputs[:0].to(device), outputs[:0].to(device), torch.eye(0, device=device), PENDULUM_UNITS.to(device), 8,
        torch.Generator(),
    )  # fmt: skip
    assert prior.device.type == "cuda"


def test_distilled_particles_are_equal_on_the_device(device: str) -> None:
    def fitted(at: str) -> ParticlePosterior:
        inputs = pendulum()[0].to(at)
        points = measurement_points(Pendulum(), inputs, PENDULUM_UNITS.to(at), torch.Generator().manual_seed(2), 256)
        settings = DistillationSettings(particles=6, hidden=(16, 16), steps=40, sets=4)
        return distil(inferred(None, at), points, settings)

    on_device, on_cpu = on_both(fitted, device)
    assert_close(on_device.parameters, on_cpu.parameters)
    assert_close(on_device.noise_scales, on_cpu.noise_scales)
    assert_close(
        on_device.to("cpu").to(device).predict(pendulum()[0].to(device)).means,
        on_cpu.predict(pendulum()[0]).means,
        1e-3,
    )


@pytest.mark.parametrize("natural", [True, False])
@pytest.mark.parametrize("interacting", [True, False])
def test_fsvgd_particles_are_equal_on_the_device(device: str, natural: bool, interacting: bool) -> None:
    inputs, outputs = pendulum()
    pool = TRUE.inputs(40, torch.Generator().manual_seed(4))
    settings = FsvgdSettings(
        particles=4, hidden=(8,), steps=20, batch=16, measurement_points=8, natural=natural, interacting=interacting,
        noise_rows=2.0,
    )  # fmt: skip

    def fitted(at: str) -> ParticlePosterior:
        units = PENDULUM_UNITS.to(at)
        all_inputs = units.inputs(torch.cat([inputs, pool]).to(at))
        prior = GaussianProcessPrior(all_inputs, RbfCovariance((1.0,) * 3, (0.8,)))
        return fit_fsvgd(inputs.to(at), outputs.to(at), pool.to(at), prior, units, settings)

    on_device, on_cpu = on_both(fitted, device)
    assert_close(on_device.parameters, on_cpu.parameters, 1e-3)
    assert_close(on_device.noise_std, on_cpu.noise_std)


def test_figures_of_merit_are_equal_on_the_device(device: str) -> None:
    generator = torch.Generator().manual_seed(5)
    means, stds = torch.randn((4, 30, 3), generator=generator), 0.1 + torch.rand((4, 1, 3), generator=generator)
    targets = torch.randn((30, 3), generator=generator)
    on_device = Mixture(means.to(device), stds.to(device), 3.0).smoothed()
    on_cpu = Mixture(means, stds, 3.0).smoothed()
    assert_close(on_device.std, on_cpu.std)
    for figure in (negative_log_likelihood, calibration_error):
        assert figure(on_device, targets.to(device)) == pytest.approx(figure(on_cpu, targets), rel=1e-5)


@pytest.fixture(scope="module")
def car_rows() -> Transitions:
    """Return transitions of a simulated car."""
    generator = torch.Generator().manual_seed(0)
    car = CarModel(SimulatorConfig(), HISTORY, {"motor.drive_gain": (8.0, 9.0)})
    inputs = car.inputs(24, generator)
    outputs = car(inputs, draw_parameters(car, 1, generator))[0]
    outputs = outputs + 0.002 * torch.randn(outputs.shape, generator=generator)
    return Transitions(inputs.double().numpy(), outputs.double().numpy(), np.zeros(24), np.arange(24), HISTORY)


def test_fit_to_rollouts_is_equal_on_the_device(device: str) -> None:
    windows = driven_windows(DisturbanceProcess((0.1,) * 3, (0.1,) * 3, PERIOD_S), 12)
    windows = replace(windows, commands=windows.commands[:, :4], motion=windows.motion[:, :4])
    inputs = np.random.default_rng(0).normal(size=(20, 5))
    rows = Transitions(inputs, 0.1 * inputs @ np.ones((5, 6)), np.zeros(20, int), np.arange(20), 0)
    settings = RolloutFitSettings(updates=3, windows=2, rows=8)

    def fitted(at: str) -> ParticlePosterior:
        car = decaying_car(torch.full((3,), 0.05))
        return fit_rollouts(CarDynamics(car.posterior.to(at), 0), windows, rows, settings).posterior

    on_device, on_cpu = on_both(fitted, device)
    assert_close(on_device.parameters, on_cpu.parameters, 1e-4)


def test_learned_car_is_equal_on_the_device_and_can_be_saved_and_refitted(
    device: str, car_rows: Transitions, tmp_path: Path
) -> None:
    model = CarModel(SimulatorConfig(kind="kinematic"), HISTORY, RANGES)
    settings = CarFitSettings(steps=20, particles=6)
    on_cpu = fit_car(car_rows, model, settings)
    on_device = fit_car(car_rows, model, settings, device=device)
    assert_close(on_device.posterior.parameters, on_cpu.posterior.parameters, 1e-3)
    save_car(on_device, tmp_path / "car.pt")
    content = torch.load(tmp_path / "car.pt", weights_only=True)
    assert content["parameters"].device.type == content["units"][0].device.type == "cpu"
    loaded = load_car(tmp_path / "car.pt")
    assert loaded.posterior.parameters.device.type == "cpu"
    assert torch.equal(loaded.posterior.parameters, on_device.posterior.parameters.cpu())
    assert_close(load_car(tmp_path / "car.pt", device).posterior.noise_std, loaded.posterior.noise_std, 0.0)
    refitted = fit_car(car_rows, model, settings, earlier=loaded, device=device)
    refitted_on_cpu = fit_car(car_rows, model, settings, earlier=on_device)
    assert_close(refitted.posterior.parameters, refitted_on_cpu.posterior.parameters, 1e-3)
    assert torch.equal(refitted.posterior.normaliser.output_std.cpu(), on_cpu.posterior.normaliser.output_std)


def test_authors_fsvgd_is_equal_on_the_device(device: str) -> None:
    rng = np.random.default_rng(3)
    states, sent = 0.1 * rng.normal(size=(41, 6)).cumsum(axis=0), rng.uniform(-1, 1, (40, 2))
    episode = EpisodeData(np.arange(41) / 30.0, states, sent, sent, np.zeros(40))
    on_device, on_cpu = on_both(lambda at: fit_authors_fsvgd([episode], HISTORY, 30, device=at), device)
    assert_close(on_device.posterior.parameters, on_cpu.posterior.parameters, 1e-3)
    assert on_device.score_episode(episode) == pytest.approx(on_cpu.score_episode(episode), rel=1e-3)
    unfitted = fit_authors_fsvgd([], HISTORY, device=device)
    assert unfitted.posterior.parameters.device.type == "cuda"


def random_car(device: str) -> CarDynamics:
    """Return a learned car with random particles and small state changes."""
    width = 3 + 2 * (HISTORY + 1)
    network = Network(width, 6, (16,))
    units = Normaliser(torch.zeros(width), torch.ones(width), torch.zeros(6), torch.full((6,), 0.05))
    numbers = network.initial(5, torch.Generator().manual_seed(6))
    return CarDynamics(ParticlePosterior(network, numbers, torch.full((6,), 0.1), units, 3.0).to(device), HISTORY)


TASKS = [ObstacleParkingTask(history_length=HISTORY, max_ticks=6), LapTask(history_length=HISTORY, max_ticks=6)]


@pytest.mark.parametrize("task", TASKS, ids=lambda t: t.name)
def test_model_env_is_equal_on_the_device(device: str, task: ObstacleParkingTask | LapTask) -> None:
    recorded = np.random.default_rng(0).normal(size=(9, feature_size(HISTORY)))
    commands = np.random.default_rng(1).uniform(-1.0, 1.0, (12, 16, 2)).astype(np.float32)
    on_device, on_cpu = (ModelEnv(random_car(at), task, 16, recorded=recorded, device=at) for at in (device, "cpu"))
    np.testing.assert_allclose(on_device.reset(), on_cpu.reset(), atol=1e-6)
    ended = 0
    for action in commands:
        found, expected = on_device.step(action), on_cpu.step(action)
        for a, b in zip(found[:3], expected[:3], strict=True):
            np.testing.assert_allclose(a, b, atol=1e-4)
        assert [i.keys() for i in found[3]] == [i.keys() for i in expected[3]]
        ended += int(found[2].sum())
    assert ended > 10
    assert_close(on_device.features, on_cpu.features)
    for a, b in zip(
        *(env.roll_out(lambda observations: -0.5 * observations[:, :2]) for env in (on_device, on_cpu)), strict=True
    ):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-4)


SMALL = SacSettings(hidden=(16, 16), cars=16, warm_up=64, batch=32, updates=8, replay=4096)


def test_agent_is_equal_on_the_device_and_can_be_saved_and_retrained(device: str, tmp_path: Path) -> None:
    agents = []
    for at in (device, "cpu"):
        agent = SacAgent(SMALL, 0, at)
        agent.train(
            ModelEnv(random_car(at), TASKS[0], SMALL.cars, device=at), 24, evaluate=lambda agent: 1.0, n_evaluations=2
        )
        agents.append(agent)
    observations = np.random.default_rng(2).normal(size=(50, feature_size(HISTORY))).astype(np.float32)
    on_device, on_cpu = (agent.act(observations) for agent in agents)
    if not torch.cuda.is_available():  # Real CUDA draws exploration noise from its own generator.
        np.testing.assert_allclose(on_device, on_cpu, atol=1e-3)
    agents[0].save(tmp_path)
    loaded = SacAgent.load(tmp_path, SMALL, 0, device)
    assert loaded.policy().sac.device.type == "cpu", "a policy drives the car on the CPU"
    np.testing.assert_allclose(loaded.act(observations), on_device, atol=1e-6)
    loaded.train(ModelEnv(random_car(device), TASKS[0], SMALL.cars, device=device), 8)
    assert next(loaded.policy().sac.policy.parameters()).device.type == "cuda"
    assert not np.allclose(loaded.act(observations), on_device, atol=1e-6)


def test_sac_gradient_steps_are_equal_on_the_device(device: str) -> None:
    """Both devices take forty steps from equal networks, transitions and noise."""
    agents = []
    for at in (device, "cpu"):
        agent = SacAgent(SMALL, 0, at)
        agent.train(ModelEnv(random_car(at), TASKS[0], SMALL.cars, device=at), 0)
        agents.append(agent.policy().sac)
    on_device, on_cpu = agents
    on_device.load_learned_state(on_cpu.learned_state())
    on_device.replay_buffer = copy.copy(on_cpu.replay_buffer)
    on_device.replay_buffer.device = on_device.device
    for agent in agents:
        agent.set_random_seed(0)
        agent.train(40, 32)
    for (name, found), expected in zip(
        on_device.policy.state_dict().items(), on_cpu.policy.state_dict().values(), strict=True
    ):
        assert found.device.type == "cuda", name
        torch.testing.assert_close(found.cpu(), expected, rtol=1e-3, atol=1e-3)
    assert_close(on_device.log_ent_coef, on_cpu.log_ent_coef)


def test_regression_study_is_equal_on_the_device(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for module, name, value in (
        (system_identification, "STEPS", 2),
        (system_identification, "REFINEMENT_STEPS", 2),
        (system_identification, "N_RESTARTS", 2),
        (averaging, "MAX_FOLDS", 2),
        (discrepancy, "STEPS", 2),
        (parameter_posterior, "RANDOM_WALK_STEPS", 1),
        (parameter_posterior, "MAX_TEMPERING_STEPS", 2),
    ):
        monkeypatch.setattr(module, name, value)
    on_device = None
    for on_device, on_cpu in zip(
        *(run_study("1d", rows=(5,), seeds=1, steps=4, device=at) for at in (device, "cpu")),
        strict=True,
    ):
        assert on_device.method == on_cpu.method
        assert (on_device.nll, on_device.rmse, on_device.calibration) == pytest.approx(
            (on_cpu.nll, on_cpu.rmse, on_cpu.calibration), rel=2e-2
        ), on_device.method
    assert on_device.method == list(METHODS)[-1]


@pytest.mark.slow
def test_speed_is_measured_there(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    from learning import speed

    monkeypatch.setattr(speed, "STEPS", 400)
    monkeypatch.setattr(speed, "FITTED_ROWS", 12)
    monkeypatch.setattr(speed, "SIZES", {"small": (4, 2, 9)})
    monkeypatch.setattr(speed, "CAR_FIT", CarFitSettings(steps=5))
    monkeypatch.setattr(speed, "infer", partial(infer, restart_scales=(1.0,)))
    monkeypatch.setattr(speed, "_seconds", partial(speed._seconds, times=5))
    synchronise(device)
    training = speed.training_speed(device)
    assert training["small"]["steps_per_s"] > 0.0
    assert training["a car from 100 rows, as carlab learn"]["whole_fit_s"] > 0.0
    prediction = speed.prediction_speed(device)
    assert min(prediction[name] for name in ("batch_ms", "posterior_ms", "learned_car_ms")) > 0.0
