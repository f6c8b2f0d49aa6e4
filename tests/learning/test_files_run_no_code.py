"""Test that loading an untrusted model file runs no code and gives a one-sentence error with the remedy."""

from __future__ import annotations

import base64
import json
import os
import pickle
import tokenize
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from carlab.core.errors import DataError
from learning.networks.normaliser import Normaliser
from learning.networks.particles import Network
from learning.policy.sac_agent import SacAgent, SacSettings, _without_environment
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
        {"network": [WIDTH, 6, 10**30]},
        {"parameters": torch.zeros(1).expand(2, 62)},
        {"parameters": torch.zeros((2, 62), device="meta")},
        {"units": [torch.zeros((WIDTH, 1)), torch.ones((1, WIDTH)), torch.zeros(6), torch.ones(6)]},
    ],
    ids=lambda changed: next(iter(changed)),
)
def test_inconsistent_car_file_is_refused_in_one_sentence(tmp_path: Path, changed: dict[str, object]) -> None:
    path = tmp_path / "dynamics.pt"
    saved_car(path)
    load_car(path)
    torch.save(torch.load(path, weights_only=True) | changed, path)
    with pytest.raises(DataError, match=r"; remove its folder to train again\.$") as error:
        load_car(path)
    assert "\n" not in str(error.value)


def saved_car(path: Path) -> None:
    """Write a car with two particles of 62 parameters."""
    network = Network(WIDTH, 6, (4,))
    units = Normaliser(torch.zeros(WIDTH), torch.ones(WIDTH), torch.zeros(6), torch.ones(6))
    parameters = network.initial(2, torch.Generator().manual_seed(0))
    save_car(CarDynamics(ParticlePosterior(network, parameters, torch.ones(6), units), 1), path)


def test_car_file_of_a_few_kilobytes_allocates_no_gigabyte(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten million particles in one stored number are refused before they are copied."""
    path = tmp_path / "dynamics.pt"
    saved_car(path)
    torch.save(torch.load(path, weights_only=True) | {"parameters": torch.zeros(1).expand(10**7, 62)}, path)
    assert path.stat().st_size < 10_000
    monkeypatch.setattr(ParticlePosterior, "to", lambda *args: pytest.fail("the parameters are copied"))
    with pytest.raises(DataError, match=r"\(parameters has fewer numbers than its shape\); remove its folder"):
        load_car(path)


def test_transposed_parts_of_a_car_are_read(tmp_path: Path) -> None:
    path = tmp_path / "dynamics.pt"
    saved_car(path)
    correlation = (torch.eye(6) + 0.01 * torch.arange(36.0).reshape(6, 6)).T
    torch.save(torch.load(path, weights_only=True) | {"correlation": correlation}, path)
    read = load_car(path).posterior.correlation
    assert read is not None
    assert torch.equal(read, correlation)


def test_too_large_archive_is_refused_before_it_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Compressed zeros: an archive of less than a megabyte with 300 MB."""
    path = tmp_path / "dynamics.pt"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("archive/data/0", "w") as member:
        for _ in range(300):
            member.write(bytes(10**6))
    assert path.stat().st_size < 10**6
    monkeypatch.setattr(torch, "load", lambda *args, **options: pytest.fail("the archive is read"))
    with pytest.raises(DataError, match=r"\(it holds more than 256 MB\); remove its folder to train again\.$"):
        load_car(path)


def replace_member(path: Path, name: str, change: Callable[[bytes], bytes]) -> None:
    """Replace the content of a member of a ZIP file; checksums are correct."""
    with zipfile.ZipFile(path) as archive:
        contents = {member: archive.read(member) for member in archive.namelist()}
    (changed,) = [member for member in contents if member.rsplit("/", 1)[-1] == name]
    after = change(contents[changed])
    assert after != contents[changed]
    with zipfile.ZipFile(path, "w") as archive:
        for member, content in contents.items():
            archive.writestr(member, after if member == changed else content)


def test_stored_array_with_a_number_in_place_of_a_name_is_refused(tmp_path: Path) -> None:
    """PyTorch raises an AssertionError for this pickle."""
    path = tmp_path / "dynamics.pt"
    saved_car(path)
    replace_member(path, "data.pkl", lambda content: b"\x80\x02K\x01Q.")
    with pytest.raises(AssertionError):
        torch.load(path, weights_only=True)
    with pytest.raises(DataError, match=r"; remove its folder to train again\.$"):
        load_car(path)


def test_array_header_with_an_open_bracket_is_refused(tmp_path: Path) -> None:
    """NumPy tokenizes the header as Python, which raises a TokenError."""
    agent = SacAgent(SacSettings(), 0)
    agent._sac = _without_environment(9, SacSettings(), 0)
    agent.save(tmp_path)
    path = tmp_path / "policy.npz"
    replace_member(path, "log_temperature.npy", lambda text: text.replace(b"'shape': (", b"'shape':(("))
    with pytest.raises(tokenize.TokenError), np.load(path) as arrays:
        arrays["log_temperature"]
    with pytest.raises(DataError, match=r"or remove the folder to train again\.$"):
        SacAgent.load(tmp_path, SacSettings(), 0)


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
