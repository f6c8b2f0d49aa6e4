"""Benchmark of the simulator on one core, as ratios, for ``carlab bench speed``."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch

from carlab.core.quantities import Action
from sim_backends.batch.rollout import rollout
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.dynamics.plain_loop import rollout_one_by_one
from sim_backends.plant import Plant

TICKS = 30
"""Commands of a rollout: one second at 30 Hz."""


def _best_s(function: Callable[[], object], repeats: int) -> float:
    """Shortest time of several runs [s], which has the least disturbance by other processes."""
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        function()
        times.append(time.perf_counter() - begin)
    return min(times)


@contextmanager
def single_torch_thread() -> Iterator[None]:
    """Context in which torch uses one thread."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _drive(cars: int, dtype: torch.dtype = torch.float32) -> tuple[torch.Tensor, torch.Tensor]:
    rng = np.random.default_rng(0)
    start = np.zeros((cars, 6))
    start[:, 3] = 1.0
    return torch.tensor(start, dtype=dtype), torch.tensor(rng.uniform(-1.0, 1.0, (cars, TICKS, 2)), dtype=dtype)


def copy_bandwidth_bytes_per_s(megabytes: int = 256, repeats: int = 5) -> float:
    """Bytes read and written a second by copying an array much larger than the caches, on one core."""
    source = np.ones(megabytes * 2**20 // 8)
    target = np.empty_like(source)
    return 2.0 * source.nbytes / _best_s(lambda: np.copyto(target, source), repeats)


def simulation_speed(cars: int = 4096, repeats: int = 5, plain_cars: int = 40) -> dict[str, float]:
    """Car-steps per second of the batched simulator and of loops over single cars.

    A car-step is one control period of the default car (1/30 s) in four Runge-Kutta steps of at most 10 ms, which is
    ``16`` evaluations of the model. ``plain_numpy_loop`` is the straightforward NumPy form; ``plain_python_loop`` is
    the fastest that Python alone does (floats and ``math``: the plant of the simulated car). ``torch_operators`` is the
    same batch without compiled code.

    ``needed_bytes_per_car_step`` must move between memory and core (commands in, states out); it is also given as a
    share of what the core can copy in memory.
    """
    config = SimulatorConfig()
    found: dict[str, float] = {}
    with single_torch_thread():
        for count in (1, cars):
            start, commands = _drive(count)
            rollout(config, start, commands)
            seconds = _best_s(lambda s=start, c=commands: rollout(config, s, c), repeats)  # type: ignore[misc]
            found[f"batched_{count}_cars_car_steps_per_s"] = count * TICKS / seconds
        seconds = _best_s(lambda: rollout(config, start, commands, engine="operators"), repeats)
        found["torch_operators_car_steps_per_s"] = cars * TICKS / seconds
        plain_start, plain_commands = (v.double().numpy() for v in _drive(plain_cars))
        seconds = _best_s(lambda: rollout_one_by_one(config, plain_start, plain_commands), max(2, repeats // 2))
        found["plain_numpy_loop_car_steps_per_s"] = plain_cars * TICKS / seconds
        found["plain_python_loop_car_steps_per_s"] = (
            plain_cars * TICKS / _best_s(lambda: _plants(config, plain_commands), max(2, repeats // 2))
        )
        bandwidth = copy_bandwidth_bytes_per_s(64, 3)
    fast = found[f"batched_{cars}_cars_car_steps_per_s"]
    needed = 4.0 * (2 + 6)
    return {
        **found,
        "ratio_to_plain_numpy_loop": fast / found["plain_numpy_loop_car_steps_per_s"],
        "ratio_to_plain_python_loop": fast / found["plain_python_loop_car_steps_per_s"],
        "ratio_to_torch_operators": fast / found["torch_operators_car_steps_per_s"],
        "ratio_of_one_car": found["batched_1_cars_car_steps_per_s"] / found["plain_numpy_loop_car_steps_per_s"],
        "copy_bandwidth_bytes_per_s": bandwidth,
        "needed_bytes_per_car_step": needed,
        "needed_share_of_copy_bandwidth": fast * needed / bandwidth,
    }


def _plants(config: SimulatorConfig, commands: Any) -> None:
    for sequence in commands.tolist():
        plant = Plant(config)
        for k, (steering, throttle) in enumerate(sequence):
            plant.command(k * config.control_period_s, Action(steering, throttle))
            plant.advance((k + 1) * config.control_period_s)


def gradient_speed(cars: int = 2048, repeats: int = 3, batch: int = 4096) -> dict[str, float]:
    """Gradient of a 30-step rollout by start, commands and parameters against central differences.

    For each of ``cars`` cars: 6 start values, 60 commands and 13 parameters of its own. Central differences need two
    rollouts for each of these 79 numbers. They run without gradients, in batches of ``batch`` cars in one call (the
    size at which the simulator's throughput is highest), so they are as fast as this simulator makes them; their time
    for all cars is that of the calls measured, scaled to the number of rollouts. ``one_car`` is the same with a single
    car, where all of its 158 rollouts fit into one call: there central differences win.
    """
    config = SimulatorConfig()
    names = [n for n in config.values() if n.split(".")[0] in ("vehicle", "tyre", "motor", "steering")]
    numbers = 6 + 2 * TICKS + len(names)
    found: dict[str, float] = {"numbers": float(numbers), "cars": float(cars)}
    with single_torch_thread():
        for label, count in (("", cars), ("one_car_", 1)):
            by_gradient = _best_s(lambda count=count: _gradient(config, names, count), repeats + 1)  # type: ignore[misc]
            size = min(batch, 2 * numbers * count)
            start, commands = _drive(size)
            per_car = {n: torch.full((size,), config.values()[n]) for n in names}
            one_call = _best_s(
                lambda s=start, c=commands, v=per_car: rollout(config, s, c, values=v),  # type: ignore[misc]
                repeats,
            )
            by_differences = one_call * 2 * numbers * count / size
            found[f"{label}gradient_s"] = by_gradient
            found[f"{label}central_differences_s"] = by_differences
            found[f"{label}ratio"] = by_differences / by_gradient
        forward = found["central_differences_s"] / (2 * numbers)
        found["parameters_only_ratio"] = forward * 2 * len(names) / found["gradient_s"]
    return found


def _gradient(config: SimulatorConfig, names: list[str], cars: int) -> None:
    start, commands = (v.requires_grad_() for v in _drive(cars))
    values = {n: torch.full((cars,), config.values()[n], requires_grad=True) for n in names}
    loss = rollout(config, start, commands, values=values).states[:, -1].square().sum()
    torch.autograd.backward(loss)
