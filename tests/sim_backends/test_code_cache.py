"""Machine code is cached on disk; a damaged file, and a folder of others, are not used."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sim_backends.compiled import code_cache
from sim_backends.compiled.machine_code import MachineCode, compile_function
from sim_backends.compiled.tracing import Tracer

X = np.linspace(-2.0, 2.0, 37)


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache."""
    folder = tmp_path / "machine-code"
    monkeypatch.setattr(code_cache, "cache_folder", lambda: folder)
    return folder


def cubic() -> MachineCode:
    """Compiles ``x^3 - x``."""
    tracer = Tracer()
    x = tracer.input("x")
    return compile_function([x], [x * x * x - x], np.dtype("f8"))


def values(code: MachineCode) -> np.ndarray:
    return np.asarray(code.run([X], 1)[0])


def test_cached_code_computes_the_same(folder: Path) -> None:
    first = values(cubic())
    [path] = folder.iterdir()
    written = path.stat().st_mtime_ns
    assert np.array_equal(values(cubic()), first)
    assert np.allclose(first, X**3 - X, rtol=1e-15, atol=1e-15)
    assert [p.stat().st_mtime_ns for p in folder.iterdir()] == [written]


@pytest.mark.parametrize("content", [b"", b"short", bytes(5000)])
def test_damaged_file_is_compiled_again(folder: Path, content: bytes) -> None:
    cubic()
    [path] = folder.iterdir()
    intact = path.read_bytes()
    path.write_bytes(content)
    assert np.allclose(values(cubic()), X**3 - X, rtol=1e-15, atol=1e-15)
    assert path.read_bytes() == intact


def test_changed_byte_is_noticed(folder: Path) -> None:
    assert code_cache.cached_object_code(("a",), lambda: b"code") == b"code"
    [path] = folder.iterdir()
    path.write_bytes(path.read_bytes()[:-1] + b"!")
    assert code_cache.cached_object_code(("a",), lambda: b"code") == b"code"


def test_code_of_another_processor_or_compiler_is_another_file(folder: Path) -> None:
    assert code_cache.cached_object_code(("one processor", "source"), lambda: b"1") == b"1"
    assert code_cache.cached_object_code(("another", "source"), lambda: b"2") == b"2"
    assert code_cache.cached_object_code(("one processor", "source"), lambda: b"3") == b"1"


def test_folder_that_cannot_be_written_is_ignored(folder: Path) -> None:
    folder.write_text("a file where the folder should be")
    assert np.allclose(values(cubic()), X**3 - X, rtol=1e-15, atol=1e-15)


def test_folder_that_other_users_can_write_to_is_not_used(folder: Path) -> None:
    assert code_cache.cached_object_code(("a",), lambda: b"own") == b"own"
    [path] = folder.iterdir()
    folder.chmod(0o777)
    assert code_cache.cached_object_code(("a",), lambda: b"compiled again") == b"compiled again"
    assert code_cache.cached_object_code(("b",), lambda: b"not cached") == b"not cached"
    assert list(folder.iterdir()) == [path]


def test_older_half_is_removed(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(code_cache, "MAX_FILES", 4)
    for k in range(4):
        code_cache.cached_object_code((str(k),), lambda: b"code")
        newest = max(folder.iterdir(), key=lambda p: p.stat().st_mtime_ns)
        os.utime(newest, (k, k))
    code_cache.cached_object_code(("new",), lambda: b"code")
    assert sorted(round(p.stat().st_mtime) for p in folder.iterdir())[:2] == [2, 3]
    assert len(list(folder.iterdir())) == 3


@pytest.mark.skipif(sys.platform != "linux", reason="the folder follows XDG_CACHE_HOME on Linux")
def test_default_folder_is_the_users_cache(tmp_path: Path) -> None:
    script = "from sim_backends.compiled import code_cache; print(code_cache.cache_folder())"
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path)}
    found = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True)
    assert Path(found.stdout.strip()) == tmp_path / "carlab" / "machine-code"
