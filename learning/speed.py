"""Speed of learning: training and prediction of particles and gradient steps of SAC, each relative to a reference.

Also absolute durations: the fit of a car to its rows, predictions in raw units, steps of the learned car.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import SAC
from stable_baselines3.common.logger import Logger
from torch import Tensor

from carlab.core.clock import MonotonicClock
from carlab.core.state_estimator import StateEstimator
from learning.devices import synchronise
from learning.networks.normaliser import Normaliser
from learning.networks.particles import Network
from learning.policy.sac import FastSac
from learning.posterior.distillation import DistillationSettings, distil
from learning.posterior.inference import infer
from learning.posterior.particle_posterior import MIN_INPUT_CLIP, ParticlePosterior
from learning.priors.domain_models import draw_parameters
from learning.priors.simulator_model import CarModel
from learning.transitions import Transitions
from learning.world.car_dynamics import CarDynamics
from learning.world.car_fit import NOISE_STD, CarFitSettings, fit_car
from sim_backends.car_parameters import SimulatorConfig

AUTHORS_STEPS_PER_S = 10.0
"""Training steps per second of the authors' code on two cores (7 to 10)."""
STEPS = 1500
SIZES = {
    "online RL: 10 particles, 48 points, 15 inputs": (10, 12, 15),
    "regression: 20 particles, 40 points": (20, 10, 9),
}
CAR_FIT = CarFitSettings()
FITTED_ROWS, FITTED_HISTORY = 100, 3
KINEMATIC = ("motor.drive_gain", "motor.damping", "steering.max_angle")
"""Uncertain parameters of the kinematic prior."""
DIFFERENCE_DELAY_S = 0.5 * StateEstimator().window_s
"""Delay of velocities from differences of poses."""
SAC_SIZES = {"64 x 64, batch 64": ([64, 64], 64), "64 x 64, batch 256": ([64, 64], 256)}


def training_speed(device: str = "cpu") -> dict[str, Any]:
    """Steps of the particles' optimiser per second at the sizes of the paper, and duration of the fit of a car."""
    found: dict[str, Any] = {}
    for name, (particles, sets, width) in SIZES.items():
        generator = torch.Generator().manual_seed(0)
        inputs = torch.randn((100, width), generator=generator).to(device)
        outputs = torch.tanh(inputs[:, :7]) + 0.02 * torch.randn((100, 7), generator=generator).to(device)
        units = Normaliser(torch.zeros(width), torch.ones(width), torch.zeros(7), torch.ones(7)).to(device)
        clock = MonotonicClock()
        began_s = clock.now_s()
        target = infer(None, inputs, outputs, units, torch.full((7,), 0.02).to(device))
        synchronise(device)
        inferred_s = clock.now_s()
        points = torch.randn((4096, width), generator=generator).to(device)
        steps = [0.0, 0.0]

        def note_time(done: int, at: list[float] = steps, clock: MonotonicClock = clock) -> None:
            synchronise(device)
            at[0] = at[0] or clock.now_s()
            at[1] = clock.now_s()

        distil(target, points, DistillationSettings(particles=particles, sets=sets, steps=STEPS), note_time)
        between = STEPS // 200 * 200 - 200
        rate = between / (steps[1] - steps[0])
        found[name] = {
            "steps_per_s": rate,
            "over_authors": rate / AUTHORS_STEPS_PER_S,
            "inference_s": inferred_s - began_s,
            "40000_steps_s": 40_000 / rate,
        }
    found["a car from 100 rows, as carlab learn"] = {"whole_fit_s": _whole_fit_s(device)}
    return found


def _whole_fit_s(device: str) -> float:
    """Duration of the fit of a car [s]: units, inference with the kinematic prior, and particles."""
    car = SimulatorConfig.from_preset()
    ranges = {name: car.priors[name] for name in KINEMATIC}
    truth = CarModel(car, FITTED_HISTORY, {}, velocity_delay_s=DIFFERENCE_DELAY_S)
    prior = CarModel(replace(car, kind="kinematic"), FITTED_HISTORY, ranges, velocity_delay_s=DIFFERENCE_DELAY_S)
    generator = torch.Generator().manual_seed(0)
    inputs = truth.inputs(FITTED_ROWS, generator)
    outputs = truth(inputs, draw_parameters(truth, 1, generator))[0]
    measured = outputs + 0.5 * torch.tensor(NOISE_STD) * torch.randn(outputs.shape, generator=generator)
    number = np.arange(FITTED_ROWS)
    rows = Transitions(inputs.double().numpy(), measured.double().numpy(), 0 * number, number, FITTED_HISTORY)
    clock = MonotonicClock()
    began_s = clock.now_s()
    fit_car(rows, prior, CAR_FIT, device=device)
    synchronise(device)
    return clock.now_s() - began_s


def prediction_speed(device: str = "cpu") -> dict[str, Any]:
    """Durations of 256 one-step predictions of 20 particles, relative to a matrix product with as many operations.

    ``batch_ms``: the networks alone. ``posterior_ms``: a complete prediction with clipping, trend, decorrelation and
    noise, in raw units. ``learned_car_ms``: 256 samples of the learned car, each row by one particle.
    """
    network = Network(15, 6, activation=DistillationSettings().activation)
    generator = torch.Generator().manual_seed(0)
    numbers = network.initial(20, generator, device)
    inputs = torch.randn((256, 15), generator=generator).to(device)
    operations = 20 * 256 * sum(a * b for a, b in network.layers)
    side = 256
    left, right = torch.randn((operations // side**2, side)).to(device), torch.randn((side, side)).to(device)
    posterior = _posterior(network, numbers)
    car = CarDynamics(posterior, history=5)
    with torch.no_grad():
        ours_s = _seconds(lambda: network(numbers, inputs), device)
        product_s = _seconds(lambda: left @ right, device)
    whole_s = _seconds(lambda: posterior.predict(inputs), device)
    drawn_s = _seconds(lambda: car.sampler(inputs, generator), device)
    return {
        "batch_ms": 1e3 * ours_s,
        "matrix_product_ms": 1e3 * product_s,
        "share_of_its_speed": product_s / ours_s,
        "posterior_ms": 1e3 * whole_s,
        "posterior_share_of_its_speed": product_s / whole_s,
        "learned_car_ms": 1e3 * drawn_s,
    }


def _posterior(network: Network, numbers: Tensor) -> ParticlePosterior:
    """Particles with decorrelation, trend, and correlated Student-t noise, like those of a fit."""
    generator = torch.Generator().manual_seed(1)
    width, outputs = network.inputs, network.outputs
    eye = torch.eye(outputs)
    units = Normaliser(torch.zeros(width), torch.ones(width), torch.zeros(outputs), torch.ones(outputs))
    decorrelation = eye + 0.1 * torch.randn((outputs, outputs), generator=generator)
    trend = 0.1 * torch.randn((1 + width, outputs), generator=generator)
    return ParticlePosterior(
        network, numbers.cpu(), torch.full((outputs,), 0.1), units.decorrelated(decorrelation), dof=5.0, trend=trend,
        correlation=0.9 * eye + 0.1, input_clip=torch.full((width,), MIN_INPUT_CLIP),
    ).to(numbers.device)  # fmt: skip


def sac_speed(device: str = "cpu") -> dict[str, Any]:
    """Gradient steps per second of ``FastSac`` and of stable-baselines3's SAC, at the same sizes."""
    found: dict[str, Any] = {}
    for name, (hidden, batch) in SAC_SIZES.items():
        rates = {}
        for label, kind in (("stable_baselines3", SAC), ("ours", FastSac)):
            agent = kind(
                "MlpPolicy", _NoiseEnv(), policy_kwargs={"net_arch": hidden}, learning_starts=1000, seed=0,
                device=device,
            )  # fmt: skip
            agent.set_logger(Logger(None, []))
            agent.learn(1000)
            agent.train(50, batch)
            rates[label] = 1.0 / (_seconds(lambda a=agent, b=batch: a.train(100, b), device, times=3) / 100.0)
        found[name] = {f"{k}_steps_per_s": v for k, v in rates.items()} | {
            "ratio": rates["ours"] / rates["stable_baselines3"]
        }
    return found


class _NoiseEnv(gym.Env[NDArray[np.float32], NDArray[np.float32]]):
    """An environment with the parking task's spaces and random observations."""

    observation_space = gym.spaces.Box(-5.0, 5.0, (13,), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        super().reset(seed=seed)
        return np.zeros(13, np.float32), {}

    def step(self, action: NDArray[np.float32]) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        seen = self.np_random.normal(size=13).astype(np.float32)
        return seen, float(action[0]), False, False, {}


def _seconds(work: Any, device: str, times: int = 50) -> float:
    """Median duration of a call after a warm-up [s]."""
    clock = MonotonicClock()
    for _ in range(max(times // 10, 1)):
        work()
    synchronise(device)
    taken = []
    for _ in range(times):
        began_s = clock.now_s()
        work()
        synchronise(device)
        taken.append(clock.now_s() - began_s)
    return float(np.median(taken))
