"""A run folder is locked until the end of its run: a second process does not change it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from carlab.api import learning
from carlab.core.errors import ConfigError
from carlab.recording.run_folder import RunDirectory
from tests.helpers.command_line import Carlab

LEARN = ("learn", "--car", "sim", "--ticks", 20, "--model-steps", 20, "--updates", 20, "--history", 1, "--no-rerun")


def test_run_is_resumed_by_one_process_at_a_time(
    carlab: Carlab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The run holds its lock until its result is written. Another process that holds the lock is then killed."""
    held: list[Path] = []
    write = learning.write_result

    def noted(run: RunDirectory, results: Any) -> None:
        with pytest.raises(ConfigError, match="is in use by another run"), run.locked():
            pass
        held.append(run.path)
        write(run, results)

    monkeypatch.setattr(learning, "write_result", noted)
    assert carlab(*LEARN, "--episodes", 1, "--out", tmp_path / "runs")[0] == 0
    (folder,) = (tmp_path / "runs").iterdir()
    assert held == [folder]
    script = (
        "from pathlib import Path; from carlab.recording.run_folder import RunDirectory\n"
        f"with RunDirectory(Path({str(folder)!r})).locked(): print('locked', flush=True), input()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as own:
        assert own.stdout is not None
        assert own.stdout.readline() == "locked\n"
        before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
        code, text = carlab("learn", "--resume", folder, "--episodes", 2)
        assert code == 2
        assert f"{folder} is in use by another run; wait until that run ends." in text
        assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before
        own.kill()
    code, text = carlab("learn", "--resume", folder)
    assert code == 0
    assert "is complete" in text
