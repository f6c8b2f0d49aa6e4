"""Test that loading an untrusted model file runs no code and gives a one-sentence error with the remedy."""

from __future__ import annotations

import base64
import json
import os
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from carlab.core.errors import DataError
from learning.networks.normaliser import Normaliser
from learning.networks.particles import Network
from learning.policy.sac_agent import SacAgent, SacSettings
from learning.posterior.particle_posterior import ParticlePosterior
from learning.world.car_dynamics import CarDynamics
from learning.world.car_fit import load_car, save_car


class Payload:
    """An object that creates a folder when it is unpickled."""

    def __init__(self, created_folder: Path) -> None:
        self._created_folder = created_folder

    def __reduce__(self) -> tuple[Callable[..., object], tuple[str]]:
        return os.mkdir, (str(self._created_folder),)


def write_stable_baselines(path: Path, payload: Payload) -> None:
    """Write a payload in the file format of a ``stable_baselines3`` agent."""
    data = {"policy_class": {":type:": "type", ":serialized:": base64.b64encode(pickle.dumps(payload)).decode()}}
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("data", json.dumps(data))
        archive.writestr("_stable_baselines3_version", "2.9.2")


def write_pickle(path: Path, payload: Payload) -> None:
    path.write_bytes(
        pickle.dumps(payload, protocol=2)
    )  # torch's protocol; torch warns about others before it refuses them


def write_torch(path: Path, payload: Payload) -> None:
    torch.save({"version": payload}, path)


def write_object_array(path: Path, payload: Payload) -> None:
    with path.open("wb") as file:
        np.savez(file, version=np.array([payload], dtype=object))


WRITERS = [write_stable_baselines, write_pickle, write_torch, write_object_array]


@pytest.mark.parametrize("write", WRITERS)
@pytest.mark.parametrize("name", ["agent.zip", "policy.npz", "dynamics.pt"])
def test_payload_in_a_model_file_does_not_run(
    tmp_path: Path, name: str, write: Callable[[Path, Payload], None]
) -> None:
    created_folder = tmp_path / "made"
    folder = tmp_path / "models" / "0001"
    folder.mkdir(parents=True)
    write(folder / name, Payload(created_folder))
    with pytest.raises(DataError, match=r"\bremove .* to train again\.$") as error:
        load_car(folder / name) if name == "dynamics.pt" else SacAgent.load(folder, SacSettings(), 0)
    assert not created_folder.exists()
    assert "\n" not in str(error.value)
    assert "weights_only" not in str(error.value)
    assert str(folder) in str(error.value)


def test_payload_runs_with_unsafe_readers(tmp_path: Path) -> None:
    """The unsafe reader of each format runs the payload, so the test above is meaningful."""
    from stable_baselines3 import SAC

    readers: dict[Callable[[Path, Payload], None], Callable[[Path], object]] = {
        write_stable_baselines: SAC.load,
        write_pickle: lambda path: pickle.loads(path.read_bytes()),
        write_torch: lambda path: torch.load(path, weights_only=False),
        write_object_array: lambda path: np.load(path, allow_pickle=True)["version"],
    }
    for write in WRITERS:
        created_folder = tmp_path / write.__name__
        path = tmp_path / f"{write.__name__}.zip"
        write(path, Payload(created_folder))
        try:
            readers[write](path)
        except Exception:  # The file holds nothing but the payload.
            assert created_folder.is_dir(), write.__name__
        assert created_folder.is_dir(), write.__name__


WIDTH = 3 + 2 * 2


@pytest.mark.parametrize(
    "changed",
    [
        {"noise_std": torch.ones(5)},
        {"noise_std": "text"},
        {"noise_std": None},
        {"parameters": [1.0]},
        {"parameters": torch.zeros((2, 4)).to_sparse()},
        {"units": [torch.zeros(WIDTH)] * 4},
        {"units": [torch.zeros(WIDTH), torch.full((WIDTH,), torch.nan), torch.zeros(6), torch.ones(6)]},
        {"turn": torch.ones(6)},
        {"trend": torch.zeros((3, 6))},
        {"correlation": 1.0},
        {"reach": torch.ones(WIDTH, dtype=torch.int64)},
        {"history": 5},
        {"history": "1"},
        {"history": 10**9},
        {"freedom": -1.0},
        {"frame": "moon"},
        {"frame": ["world"]},
        {"network": [WIDTH, 6, -4]},
        {"network": 3},
    ],
    ids=lambda changed: next(iter(changed)),
)
def test_inconsistent_car_file_is_refused_in_one_sentence(tmp_path: Path, changed: dict[str, object]) -> None:
    network = Network(WIDTH, 6, (4,))
    units = Normaliser(torch.zeros(WIDTH), torch.ones(WIDTH), torch.zeros(6), torch.ones(6))
    parameters = network.initial(2, torch.Generator().manual_seed(0))
    path = tmp_path / "dynamics.pt"
    save_car(CarDynamics(ParticlePosterior(network, parameters, torch.ones(6), units), 1), path)
    load_car(path)
    torch.save(torch.load(path, weights_only=True) | changed, path)
    with pytest.raises(DataError, match=r"; remove its folder to train again\.$") as error:
        load_car(path)
    assert "\n" not in str(error.value)


def test_sources_use_no_unsafe_reader() -> None:
    """No package uses a file reader that can run code."""
    root = Path(__file__).parents[2]
    readers = ("pickle.load", "allow_pickle=True", "weights_only=False", "joblib", "yaml.load", "SAC.load", "Sac.load")
    found = [
        f"{path.relative_to(root)}: {reader}"
        for package in ("carlab", "drivers", "mocap", "learning", "sim_backends")
        for path in (root / package).rglob("*.py")
        for reader in readers
        if reader in path.read_text(encoding="utf-8")
    ]
    assert found == []
    for path in (root / "learning").rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        assert text.count("torch.load(") == text.count("weights_only=True"), path
