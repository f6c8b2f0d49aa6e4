"""The command and its child processes ignore Python files in the current folder."""

import subprocess
import sys
from pathlib import Path

import pytest

from carlab.recording.mcap.source import read_episode

SHORT_DRIVE = ("drive", "--ticks", "3", "--no-place", "--no-rerun", "--no-picture", "--car")


@pytest.mark.realtime
@pytest.mark.parametrize("car", ["sim", "emulated"])
def test_file_with_the_name_of_a_python_module_does_not_stop_a_drive(tmp_path: Path, car: str) -> None:
    for name in ("copy", "random", "types", "numpy"):
        (tmp_path / f"{name}.py").write_text(f"raise SystemExit('{name}.py was imported')\n")
    command = Path(sys.executable).with_name("carlab")
    done = subprocess.run(
        [str(command), *SHORT_DRIVE, car], cwd=tmp_path, capture_output=True, text=True, check=False, timeout=60
    )
    assert "was imported" not in done.stdout + done.stderr
    assert done.returncode == 0, done.stdout + done.stderr
    (recording,) = tmp_path.glob("runs/*/episodes/0001.mcap")
    assert read_episode(recording).ticks == 3


def test_import_path_of_a_child_process_contains_the_current_folder_only_if_that_of_the_command_does(
    tmp_path: Path,
) -> None:
    program = tmp_path / "bin" / "program.py"
    program.parent.mkdir()
    program.write_text(
        "import os, subprocess, sys\n"
        "import carlab.cli\n"
        "carlab.cli.run = lambda argv: 0\n"
        "try:\n    carlab.cli.main([])\nexcept SystemExit:\n    pass\n"
        "child = [sys.executable, '-c', 'import sys; print(\"\" in sys.path)']\n"
        "print(subprocess.run(child, capture_output=True, text=True).stdout.strip())\n"
    )
    for folder, expected in ((tmp_path, "False"), (program.parent, "True")):
        done = subprocess.run(
            [sys.executable, str(program)], cwd=folder, capture_output=True, text=True, check=True, timeout=60
        )
        assert done.stdout.strip() == expected
