"""A script without a main guard: its child process ends with one sentence and opens no car."""

import subprocess
import sys
from pathlib import Path

SCRIPT = """
import carlab
carlab.learn("sim", episodes=1, ticks=10, updates=10, model_steps=10, history=1, out="runs", rerun=False)
"""


def test_script_without_a_main_guard_ends_with_the_remedy(tmp_path: Path) -> None:
    path = tmp_path / "script.py"
    path.write_text(SCRIPT, encoding="utf-8")
    ended = subprocess.run([sys.executable, path], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert ended.returncode == 1
    assert "put its calls of carlab under 'if __name__ == \"__main__\":'" in ended.stderr
    assert "freeze_support" not in ended.stderr
    assert list((tmp_path / "runs").iterdir()) == []
