"""Shared fixtures: seeded random generator, folder of reference data, CUDA stand-in, check for leaked threads."""

import gc
import importlib.util
import os
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from pauses import pytest_runtest_protocol as pytest_runtest_protocol
from pauses import pytest_terminal_summary as pytest_terminal_summary
from short_fits import shorten_identification, shorten_inference

SHARED = Path(__file__).resolve().parents[1].parent / "shared"

os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
os.environ.setdefault("SDL_AUDIODRIVER", "dummy")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--hil", action="store", default=None, metavar="CAR.toml", help="also test this real car")


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Search for garbage once after the collection, and later not among the modules and tests that it made."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.collect()
        gc.freeze()
        gc.enable()


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    for item in items:
        if "slow" in item.keywords and "slow" not in (config.getoption("-m") or ""):
            item.add_marker(pytest.mark.skip(reason="a long study; run it with -m slow"))
        if "hil" in item.keywords and config.getoption("--hil") is None:
            item.add_marker(pytest.mark.skip(reason="needs real hardware; run it with --hil CAR.toml"))


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20240607)


@pytest.fixture(scope="session")
def shared() -> Path:
    """Return the folder of reference data next to the repository; skip the test if it is absent."""
    if not SHARED.is_dir():
        pytest.skip("the folder 'shared' with reference captures and recordings is not next to the repository")
    return SHARED


@pytest.fixture(scope="session")
def stand_in_device() -> ModuleType:
    """Return the module ``stand_in_device``, imported on demand because it imports torch."""
    spec = importlib.util.spec_from_file_location("stand_in_device", Path(__file__).with_name("stand_in_device.py"))
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def short_inference(monkeypatch: pytest.MonkeyPatch) -> None:
    """Posteriors over functions have few draws and steps."""
    shorten_inference(monkeypatch)


@pytest.fixture
def short_identification(monkeypatch: pytest.MonkeyPatch) -> None:
    """Identification has few restarts and steps."""
    shorten_identification(monkeypatch)


@pytest.fixture(params=["stand-in", pytest.param("cuda", marks=pytest.mark.gpu)])
def device(
    request: pytest.FixtureRequest, stand_in_device: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> Iterator[str]:
    """Return ``cuda``: once as the stand-in, and once as the real device if present."""
    import stable_baselines3.common.utils as sb3
    import torch

    if request.param == "cuda":
        if not torch.cuda.is_available():
            pytest.skip("needs a CUDA device")
        yield "cuda"
        return
    sb3_get_device = sb3.get_device  # falls back to the CPU without an error
    for module in list(sys.modules.values()):
        if vars(module).get("get_device") is sb3_get_device:
            monkeypatch.setattr(module, "get_device", torch.device)
    monkeypatch.setattr(torch.cuda, "synchronize", lambda: None)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)  # Nothing can be captured on the stand-in.
    with stand_in_device.stand_in() as operations:
        yield "cuda"
    assert stand_in_device.without_cuda(operations.used) == []


@pytest.fixture(autouse=True)
def no_leaked_threads() -> Iterator[None]:
    """Fail a test that leaves a thread running; each thread has an owner whose close() joins it."""
    before = set(threading.enumerate())
    yield
    leaked = [t for t in threading.enumerate() if t not in before and t.is_alive() and not _is_library_thread(t)]
    for thread in leaked:
        thread.join(timeout=2.0)
    names = [t.name for t in leaked if t.is_alive()]
    assert not names, f"threads still running: {names}"


def _is_library_thread(thread: threading.Thread) -> bool:
    return thread.name.startswith(("pytest_timeout", "rerun", "QueueFeederThread", "tqdm"))
