"""Each script in examples/ runs, with small settings, and says what it promises."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
SCRIPTS = {
    "own_policy.py": [],
    "write_task.py": [],
    "add_effect.py": [],
    "diagnose_csv.py": ["--effects", "steering_lag"],
    "train_in_learned_car.py": ["--updates", "64", "--model-steps", "20"],
    "demo.py": ["--car", "sim", "--episodes", "1", "--updates", "64", "--effects", "steering_lag"],
}


def output_of(script: str, folder: Path) -> str:
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, str(EXAMPLES / script), *SCRIPTS[script], "--out", "runs"],
        cwd=folder, capture_output=True, text=True, check=False, env=environment, timeout=900,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_every_example_is_run() -> None:
    assert {path.name for path in EXAMPLES.glob("*.py")} == set(SCRIPTS)


def test_a_policy_of_ones_own_holds_its_speed(tmp_path: Path) -> None:
    text = output_of("own_policy.py", tmp_path)
    speed = float(text.partition("last second: ")[2].split()[0])
    assert speed == pytest.approx(0.8, abs=0.1)


def test_a_task_of_ones_own_ends_where_it_says(tmp_path: Path) -> None:
    text = output_of("write_task.py", tmp_path)
    assert text.startswith("GOAL_REACHED")


@pytest.mark.timeout(900)
def test_an_effect_of_ones_own_is_found(tmp_path: Path) -> None:
    text = output_of("add_effect.py", tmp_path)
    found = text.partition("a drag of ")[2].split()[0]
    assert float(found) == pytest.approx(0.5, abs=0.1)


@pytest.mark.timeout(900)
def test_a_csv_is_diagnosed(tmp_path: Path) -> None:
    text = output_of("diagnose_csv.py", tmp_path)
    assert "steering" in text
    assert (tmp_path / "runs" / "diagnosis" / "model.toml").is_file()
    before, after = (float(line.split()[1]) for line in text.splitlines() if line.startswith("model  "))
    assert after < before


@pytest.mark.timeout(900)
def test_a_policy_is_trained_in_the_learned_car(tmp_path: Path) -> None:
    text = output_of("train_in_learned_car.py", tmp_path)
    assert "Mean return" in text
    assert "from the goal" in text


@pytest.mark.timeout(900)
def test_the_demo_prints_what_was_concealed_beside_what_was_found(tmp_path: Path) -> None:
    text = output_of("demo.py", tmp_path)
    row = next(line for line in text.splitlines() if line.startswith("effects.steering_lag.time_constant [s]"))
    said, concealed, found = row.split()[2:5]
    assert (said, float(concealed)) == ("none", 0.07)
    assert float(found) == pytest.approx(0.07, abs=0.02)
    assert "Held-out position error" in text
