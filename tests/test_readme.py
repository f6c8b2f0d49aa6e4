"""README: each verb is documented, each command in it parses, its car file loads, its program runs."""

import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from carlab.cars import load_car_file
from carlab.cli import _verbs

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
COMMANDS = re.findall(r"^\$ (carlab .*)$", README, flags=re.M)


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", README, flags=re.M | re.S)


def test_every_verb_is_in_the_table_and_nothing_else() -> None:
    documented = re.findall(r"^\| `carlab (\w+)", README, flags=re.M)
    assert documented == list(_verbs())


@pytest.mark.parametrize("verb", list(_verbs()))
def test_every_verb_explains_itself(verb: str) -> None:
    done = subprocess.run([sys.executable, "-m", "carlab", verb, "--help"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    summary = (_verbs()[verb].__doc__ or "").split("\n")[0].rstrip(".")
    assert summary.split()[0] in done.stdout
    assert "--verbose" in done.stdout


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_parses(command: str) -> None:
    import tyro

    made = tyro.extras.subcommand_cli_from_dict(_verbs(), args=shlex.split(command)[1:], prog="carlab")
    assert callable(made.run)


def test_the_make_targets_exist() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for target in re.findall(r"^\$ make (\w+)", README, flags=re.M):
        assert re.search(rf"^{target}:", makefile, flags=re.M)


def test_the_car_file_loads_and_is_a_real_car(tmp_path: Path) -> None:
    (text,) = blocks("toml")
    path = tmp_path / "car.toml"
    path.write_text(text, encoding="utf-8")
    car = load_car_file(path)
    assert car.real is not None
    assert car.real.name == "blue car"
    assert car.real.envelope.max_speed_mps == 3.0
    assert car.simulator.effects["steering_lag"]["time_constant"] == 0.05
    assert set(tomllib.loads(text)["hardware"]) == {"name", "actuator", "calibration", "mocap", "arena", "limits"}


def test_the_program_runs() -> None:
    (program,) = blocks("python")
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stderr
    assert "ticks" in done.stdout
