"""A learned car as arrays: the same predictions after the journey, and refusal of damaged files."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from carlab.core.errors import DataError
from carlab.core.observation import STATE_FEATURES
from learning.functional_svgd.authors_fsvgd import WorldDynamics
from learning.networks.normaliser import Normaliser
from learning.networks.particles import Network
from learning.posterior.particle_posterior import ParticlePosterior
from learning.world.car_dynamics import CarDynamics
from learning.world.car_fit import LearnedCar, load_car, load_car_arrays, save_car, save_car_arrays

HISTORY = 1
COMMANDS = 2 * (HISTORY + 1)


def random_car(frame: str, *, optional: bool) -> LearnedCar:
    """A car with random numbers in all parts, with or without the optional ones."""
    generator = torch.Generator().manual_seed(3)
    width, outputs = (3 + COMMANDS, 6) if frame == "body" else (STATE_FEATURES + COMMANDS, STATE_FEATURES)

    def draw(*shape: int) -> torch.Tensor:
        return torch.rand(shape, generator=generator) + 0.5

    network = Network(width, outputs, (4, 5), "silu" if optional else "leaky_relu")
    units = Normaliser(draw(width), draw(width), draw(outputs), draw(outputs))
    units = units.decorrelated(torch.eye(outputs) + 0.1 * draw(outputs, outputs)) if optional else units
    correlation = torch.eye(outputs) + 0.01 * torch.ones(outputs, outputs)
    parts = (draw(1 + width, outputs), correlation, 3.0 * draw(width)) if optional else ()
    parameters = network.initial(3, generator)
    dof = 7.5 if optional else math.inf
    posterior = ParticlePosterior(network, parameters, draw(outputs), units, dof, *parts)
    return (CarDynamics if frame == "body" else WorldDynamics)(posterior, HISTORY)


@pytest.mark.parametrize("frame", ["body", "world"])
@pytest.mark.parametrize("optional", [True, False])
def test_car_has_the_same_predictions_after_its_journey(tmp_path: Path, frame: str, optional: bool) -> None:
    car = random_car(frame, optional=optional)
    save_car_arrays(car, tmp_path / "car.npz")
    read = load_car_arrays(tmp_path / "car.npz")
    inputs = torch.randn((20, car.posterior.network.inputs), generator=torch.Generator().manual_seed(1))
    for name in ("mean", "std"):
        found, expected = (getattr(c.posterior.predict(inputs), name) for c in (read, car))
        assert torch.equal(found, expected)
    save_car(car, tmp_path / "before.pt")
    save_car(read, tmp_path / "after.pt")
    assert (tmp_path / "after.pt").read_bytes() == (tmp_path / "before.pt").read_bytes()
    assert type(load_car(tmp_path / "after.pt")) is type(car)


def test_only_the_file_of_a_run_folder_has_a_pickle(tmp_path: Path) -> None:
    car = random_car("body", optional=True)
    save_car(car, tmp_path / "car.pt")
    save_car_arrays(car, tmp_path / "car.npz")
    assert b".pkl" in (tmp_path / "car.pt").read_bytes()
    assert b".pkl" not in (tmp_path / "car.npz").read_bytes()
    with np.load(tmp_path / "car.npz", allow_pickle=False) as arrays:
        assert all(arrays[name].dtype.kind in "fi" for name in arrays)


Arrays = dict[str, np.ndarray]
DAMAGES: dict[str, Callable[[Arrays], object]] = {
    "missing": lambda arrays: arrays.pop("noise_std"),
    "version": lambda arrays: arrays.update(version=np.array(1)),
    "frame": lambda arrays: arrays.update(frame=np.array(2)),
    "activation": lambda arrays: arrays.update(activation=np.array(9)),
    "history": lambda arrays: arrays.update(history=np.array(-1)),
    "other history": lambda arrays: arrays.update(history=np.array(4)),
    "network": lambda arrays: arrays.update(network=np.array([7, 6, 2])),
    "not finite": lambda arrays: arrays["input_mean"].fill(np.nan),
    "shape": lambda arrays: arrays.update(trend=np.zeros((2, 2), np.float32)),
    "freedom": lambda arrays: arrays.update(freedom=np.array(-1.0)),
    "text": lambda arrays: arrays.update(noise_std=np.array(["text"])),
    "objects": lambda arrays: arrays.update(noise_std=np.array([{}], dtype=object)),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_damaged_arrays_are_refused_in_one_sentence(tmp_path: Path, name: str) -> None:
    path = tmp_path / "car.npz"
    save_car_arrays(random_car("body", optional=True), path)
    with np.load(path) as opened:
        arrays = {key: opened[key].copy() for key in opened}
    DAMAGES[name](arrays)
    np.savez(path, **arrays)
    with pytest.raises(DataError, match=r"car\.npz .*; remove its folder to train again\.$") as error:
        load_car_arrays(path)
    assert "\n" not in str(error.value)
