"""Particles that correct a simulator: moments against the posterior, steps, files, and fit to rollouts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from carlab.core.errors import DataError
from learning.networks.normaliser import Normaliser
from learning.networks.particles import Network
from learning.posterior.distillation import DistillationSettings, distil
from learning.posterior.function_posterior import FunctionPosterior, simulate
from learning.posterior.inference import infer
from learning.posterior.particle_posterior import MAX_SIMULATED, ParticlePosterior, ParticleSimulator
from learning.posterior.sampler import Assignment, PosteriorSampler
from learning.priors.domain_models import draw_parameters
from learning.priors.simulator_model import CarModel
from learning.world.car_dynamics import CarDynamics
from learning.world.car_fit import NOISE_STD, car_units, load_car, load_car_arrays, save_car, save_car_arrays
from sim_backends.car_parameters import SimulatorConfig
from tests.helpers.seeded import generator

HISTORY, PARTICLES = 2, 6
GAIN = "motor.drive_gain"
CAR = SimulatorConfig(kind="kinematic")
MODEL = CarModel(CAR, HISTORY, {GAIN: (4.0, 12.0), "motor.damping": (1.0, 3.0)}, velocity_delay_s=0.01)
EXTRA_MPS = 0.05
"""Change of vx in a step that the simulator lacks."""


def rows(count: int = 60) -> tuple[torch.Tensor, torch.Tensor]:
    """Inputs and outputs of the simulator with another gain and an additional change of vx, with noise."""
    inputs = MODEL.inputs(count, generator(1))
    outputs = MODEL(inputs, torch.tensor([[6.0, 1.5]]))[0]
    outputs = outputs + 0.2 * torch.tensor(NOISE_STD) * torch.randn(outputs.shape, generator=generator(2))
    outputs[:, 3] += EXTRA_MPS
    return inputs, outputs


@pytest.fixture(scope="module")
def posterior() -> FunctionPosterior:
    """Posterior over functions given the rows."""
    inputs, outputs = rows()
    units = car_units(MODEL, generator())
    return infer(MODEL, inputs, outputs, units, torch.tensor(NOISE_STD), restart_scales=(1.0,))


@pytest.fixture(scope="module")
def particles(posterior: FunctionPosterior) -> ParticlePosterior:
    """Particles that correct the simulator."""
    points = torch.cat([rows()[0].repeat(8, 1), MODEL.inputs(480, generator(4))])
    settings = DistillationSettings(PARTICLES, (16, 16), steps=600, correct_simulator=True)
    return distil(posterior, points, settings)


def random_particles(model: CarModel = MODEL) -> ParticlePosterior:
    """Networks with random parameters around a simulator with random draws."""
    width = 3 + 2 * (HISTORY + 1)
    network = Network(width, 6, (8,), "silu")
    units = Normaliser(
        torch.full((width,), 0.1), torch.full((width,), 2.0), torch.full((6,), 0.3), torch.full((6,), 0.5)
    )
    units = units.decorrelated(torch.eye(6) + 0.1 * torch.rand(6, 6, generator=generator(1)))
    trend = 0.1 * torch.randn(1 + width, 6, generator=generator(2))
    draws = draw_parameters(model, PARTICLES, generator(3))
    return ParticlePosterior(
        network, network.initial(PARTICLES, generator()), torch.full((6,), 0.1), units, 5.0, trend,
        simulator=ParticleSimulator(model, draws),
    )  # fmt: skip


def test_steps_of_draws_are_those_of_each_draw_alone() -> None:
    inputs = MODEL.inputs(12, generator()).view(3, 4, -1)
    draws = draw_parameters(MODEL, 3, generator(1))
    found = MODEL.steps_of_draws(inputs, draws)
    for own, draw, step in zip(inputs, draws, found, strict=True):
        torch.testing.assert_close(step, MODEL(own, draw[None])[0])


def test_discrepancy_and_simulator_have_the_moments_of_the_posterior(posterior: FunctionPosterior) -> None:
    """Law of total covariance over the draws of the parameters."""
    assert posterior.parameters is not None
    sets = MODEL.inputs(20, generator(5)).view(5, 4, -1)
    draws = torch.arange(len(posterior.parameters))
    means, covariance = posterior.discrepancy_marginals(sets, draws)
    simulated = simulate(MODEL, sets.flatten(0, 1), posterior.parameters, posterior.normaliser)
    totals = means + simulated.view(len(draws), 5, 4, 6).transpose(2, 3)
    deviation = (totals - totals.mean(dim=0)).double()
    expected_mean, expected_covariance = posterior.marginals(sets)
    torch.testing.assert_close(totals.mean(dim=0).float(), expected_mean, rtol=1e-4, atol=1e-4)
    total = covariance + torch.einsum("pbon,pbom->bonm", deviation, deviation) / len(draws)
    torch.testing.assert_close(total, expected_covariance, rtol=1e-3, atol=1e-5)


def test_discrepancy_without_rows_has_a_zero_mean() -> None:
    empty = torch.zeros(0, 9), torch.zeros(0, 6)
    prior = infer(MODEL, *empty, car_units(MODEL, generator()), torch.tensor(NOISE_STD))
    means, _ = prior.discrepancy_marginals(MODEL.inputs(8, generator()).view(2, 4, -1), torch.arange(3))
    assert torch.equal(means, torch.zeros(3, 2, 6, 4))


def test_particles_are_the_simulator_and_the_discrepancy_of_their_draws(
    posterior: FunctionPosterior, particles: ParticlePosterior
) -> None:
    """At the rows; the simulator alone lacks the change of vx."""
    inputs, outputs = rows()
    assert particles.simulator is not None
    normal = particles.normaliser.inputs(inputs)
    predicted = particles.normaliser.raw_outputs(particles.values(normal)).mean(dim=0)
    alone = particles.simulated(normal).mean(dim=0)
    assert float((alone - outputs)[:, 3].abs().mean()) > 0.5 * EXTRA_MPS
    assert float((predicted - outputs)[:, 3].abs().mean()) < 0.3 * EXTRA_MPS
    mean = posterior.predict(inputs).mean
    assert float((predicted - mean)[:, 3].square().mean().sqrt()) < 0.2 * EXTRA_MPS
    assert {tuple(draw.tolist()) for draw in particles.simulator.parameters} <= {
        tuple(draw.tolist()) for draw in posterior.parameters
    }


def test_posterior_without_a_simulator_has_no_simulator_to_correct(posterior: FunctionPosterior) -> None:
    without = replace(posterior, model=None, parameters=None)
    with pytest.raises(ValueError, match="no simulator to correct"):
        distil(without, rows()[0], DistillationSettings(PARTICLES, steps=1, correct_simulator=True))


def test_sampler_and_prediction_are_networks_plus_simulator() -> None:
    """Also for inputs beyond the clip, at which the simulator has the clipped inputs."""
    particles = random_particles()
    assert particles.simulator is not None
    inputs = MODEL.inputs(40, generator(6))
    inputs[0, 0] = 1e3
    clipped = particles.normaliser.raw_inputs(particles.clipped_inputs(inputs))
    networks = replace(particles, simulator=None).predict(inputs).means
    expected = networks - particles.normaliser.output_mean + MODEL(clipped, particles.simulator.parameters)
    torch.testing.assert_close(particles.predict(inputs).means, expected, rtol=1e-4, atol=1e-4)
    particle = torch.arange(40) % PARTICLES
    assignment = Assignment.of_particles(particle, PARTICLES)
    found = PosteriorSampler.of(particles).without_noise(inputs, assignment)
    torch.testing.assert_close(found, expected[particle, torch.arange(40)], rtol=1e-4, atol=1e-4)


def test_diverged_simulator_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    particles = random_particles()
    steps = torch.tensor([torch.nan, torch.inf, -torch.inf, 1e9, -1e9, 0.2])
    monkeypatch.setattr(CarModel, "steps_of_draws", lambda self, inputs, parameters: steps.expand(*inputs.shape[:2], 6))
    bound = MAX_SIMULATED * 0.5
    found = particles.simulated(torch.zeros(1, 9))[0, 0]
    torch.testing.assert_close(found, torch.tensor([0.0, 0.0, 0.0, 0.3 + bound, 0.3 - bound, 0.2]))


@pytest.mark.parametrize("model", [MODEL, replace(MODEL, ranges={}, at_s=3.5)], ids=["ranges", "fixed"])
def test_files_contain_the_simulator(model: CarModel, tmp_path: Path) -> None:
    car = CarDynamics(random_particles(model), HISTORY)
    save_car(car, tmp_path / "car.pt")
    save_car_arrays(car, tmp_path / "car.npz")
    inputs = MODEL.inputs(10, generator(7))
    for read in (load_car(tmp_path / "car.pt"), load_car_arrays(tmp_path / "car.npz")):
        assert isinstance(read, CarDynamics)
        assert read.posterior.simulator is not None
        assert read.posterior.simulator.model == model
        assert torch.equal(read.predict(inputs).means, car.predict(inputs).means)


def _with_text(old: bytes, new: bytes) -> Callable[[dict[str, np.ndarray]], object]:
    def damage(arrays: dict[str, np.ndarray]) -> None:
        text = arrays["simulator"].tobytes()
        assert old in text
        arrays["simulator"] = np.frombuffer(text.replace(old, new), np.uint8)

    return damage


DAMAGES: dict[str, Callable[[dict[str, np.ndarray]], object]] = {
    "no draws": lambda arrays: arrays.pop("simulator_parameters"),
    "no simulator": lambda arrays: arrays.pop("simulator"),
    "other particles": lambda arrays: arrays.update(simulator_parameters=np.zeros((2, 2), np.float32)),
    "other parameters": lambda arrays: arrays.update(simulator_parameters=np.zeros((PARTICLES, 3), np.float32)),
    "not finite": lambda arrays: arrays["simulator_parameters"].fill(np.nan),
    "no text": lambda arrays: arrays.update(simulator=np.array([255, 254], np.uint8)),
    "no JSON": _with_text(b"{", b"["),
    "unknown parameter": _with_text(GAIN.encode(), b"motor.drive_pain"),
    "impossible car": _with_text(b'"mass": ', b'"mass": -'),
    "infinite time": _with_text(b'"at_s": 0.0', b'"at_s": Infinity'),
    "long delay": _with_text(b'"velocity_delay_s": 0.01', b'"velocity_delay_s": 60.0'),
    "list of tables": _with_text(b'"tables": {', b'"tables": 3, "other": {'),
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES.keys())
def test_file_with_a_damaged_simulator_is_refused(
    damage: Callable[[dict[str, np.ndarray]], object], tmp_path: Path
) -> None:
    path = tmp_path / "car.npz"
    save_car_arrays(CarDynamics(random_particles(), HISTORY), path)
    with np.load(path) as opened:
        arrays = {name: opened[name].copy() for name in opened.files}
    damage(arrays)
    np.savez(path, **arrays)
    with pytest.raises(DataError, match=r"car\.npz cannot be read \(.+\); remove its folder to train again\.$"):
        load_car_arrays(path)


def test_draws_in_fewer_stored_numbers_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "car.pt"
    save_car(CarDynamics(random_particles(), HISTORY), path)
    content = torch.load(path, weights_only=True)
    torch.save(content | {"simulator_parameters": torch.zeros(1).expand_as(content["simulator_parameters"])}, path)
    with pytest.raises(DataError, match="simulator_parameters has fewer numbers than its shape"):
        load_car(path)


def test_file_of_networks_alone_has_the_earlier_version(tmp_path: Path) -> None:
    """Earlier programs read it; they refuse a file with a simulator, whose networks alone would be a wrong car."""
    for particles, version in ((random_particles(), 7), (replace(random_particles(), simulator=None), 6)):
        save_car_arrays(CarDynamics(particles, HISTORY), tmp_path / "car.npz")
        with np.load(tmp_path / "car.npz") as opened:
            assert int(opened["version"]) == version
            assert ("simulator" in opened.files) == (version == 7)
