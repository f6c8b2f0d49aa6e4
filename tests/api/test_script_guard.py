"""A script without the guard of its main module learns that it needs one, and drives the car once only."""

import subprocess
import sys
from pathlib import Path

SCRIPT = """
import carlab
carlab.learn("sim", episodes=1, ticks=10, updates=10, model_steps=10, history=1, out="runs", rerun=False)
"""


def test_unguarded_script_is_told_to_add_the_guard(tmp_path: Path) -> None:
    path = tmp_path / "script.py"
    path.write_text(SCRIPT, encoding="utf-8")
    ended = subprocess.run([sys.executable, path], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert ended.returncode == 1
    assert "put its calls of carlab under 'if __name__ == \"__main__\":'" in ended.stderr
    assert "freeze_support" not in ended.stderr
    assert list((tmp_path / "runs").iterdir()) == []
