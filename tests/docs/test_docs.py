"""Test the documentation: commands parse or run, car files load, programs run, links and references resolve."""

import dataclasses
import glob
import os
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import pytest

from carlab.cars import load_car_file
from carlab.cli import _verbs, run
from carlab.core.car import Car
from carlab.core.policy import PolicyInput
from carlab.core.quantities import CarState, Observation
from carlab.core.safety import SafetyEnvelope
from carlab.diagnosis.comparison.candidates import change_candidates
from carlab.diagnosis.findings import EffectFinding, Estimate, FitErrors
from carlab.experiment.episodes.result import EpisodeResult
from drivers.calibration import ActuatorCalibration
from drivers.config import ActuatorConfig
from mocap.config import MocapConfig
from sim_backends.car_parameters import SimulatorConfig, preset_names
from sim_backends.effects import CATALOGUE

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
README = ROOT / "README.md"
FASTER = {"diagnose": ("--effects", "steering_lag")}
"""Additional arguments of verbs by which a page runs in seconds; the long study runs the commands as they are."""
MARKER = re.compile(r"^<!-- test: (?P<kind>run|parse|hardware|file|car file)(?P<note>[^>]*)-->$")


@dataclass(frozen=True)
class Block:
    """A fenced block of a page with the test marker in the line above it."""

    page: Path
    language: str
    text: str
    marker: str
    note: str


def blocks(page: Path) -> list[Block]:
    lines = page.read_text(encoding="utf-8").split("\n")
    found, start = [], None
    for number, line in enumerate(lines):
        if line.startswith("```") and start is None:
            start = number
        elif line.startswith("```") and start is not None:
            marker = MARKER.match(lines[start - 1]) if start else None
            found.append(
                Block(
                    page,
                    lines[start][3:].strip(),
                    "\n".join(lines[start + 1 : number]) + "\n",
                    marker["kind"] if marker else "",
                    marker["note"].strip() if marker else "",
                )
            )
            start = None
    assert start is None, f"{page}: a fenced block is not closed"
    return found


BLOCKS = [block for page in PAGES for block in blocks(page)]
CONSOLE = [block for block in BLOCKS if block.language == "console"]
COMMANDS = sorted({line[2:] for block in CONSOLE for line in block.text.split("\n") if line.startswith("$ ")})


def _name(page: Path) -> str:
    return str(page.relative_to(ROOT))


def test_each_console_block_of_the_site_has_a_test_marker() -> None:
    unmarked = [f"{_name(b.page)}: {b.text}" for b in CONSOLE if (ROOT / "docs") in b.page.parents and not b.marker]
    assert unmarked == []


@pytest.mark.parametrize("command", [c for c in COMMANDS if c.startswith("carlab ")])
def test_each_command_parses(command: str) -> None:
    import tyro

    arguments = shlex.split(command, comments=True)[1:]
    parsed = tyro.extras.subcommand_cli_from_dict(_verbs(), args=arguments, prog="carlab")
    assert callable(parsed.run)


@pytest.mark.parametrize("command", [c for c in COMMANDS if "pytest " in c])
def test_each_pytest_command_names_existing_tests(command: str) -> None:
    paths = [word for word in shlex.split(command, comments=True) if word.startswith("tests/")]
    assert paths
    assert [path for path in paths if not (ROOT / path.split("::")[0]).exists()] == []


def test_each_make_target_exists() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = {match for command in COMMANDS for match in re.findall(r"^make (\w+)", command)}
    assert {"demo", "test", "docs"} <= targets
    assert [target for target in targets if not re.search(rf"^{target}:", makefile, flags=re.M)] == []


def test_makefile_names_existing_tests() -> None:
    printed = subprocess.run(["make", "-n", "test"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    paths = set(re.findall(r"(?<=[\s=])tests/[\w/.]+", printed))
    assert len(paths) > 10
    assert [path for path in sorted(paths) if not (ROOT / path).exists()] == []


RUN_PAGES = sorted({b.page for b in BLOCKS if b.marker == "run"})


@pytest.mark.realtime
@pytest.mark.timeout(1500)
@pytest.mark.parametrize("page", RUN_PAGES, ids=_name)
def test_commands_of_a_page_run_in_order(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    run_commands_of(page, capfd, FASTER)


@pytest.mark.slow
@pytest.mark.timeout(1500)
@pytest.mark.parametrize("page", [ROOT / "docs" / "tutorials" / "first-diagnosis.md"], ids=_name)
def test_unchanged_commands_of_a_page_run_in_order(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    run_commands_of(page, capfd, {})


def run_commands_of(page: Path, capfd: pytest.CaptureFixture[str], added: Mapping[str, tuple[str, ...]]) -> None:
    """Run the commands of a page in this process, which spares its imports, and its scripts, in the current folder.

    Patterns of the shell are expanded, and ``added`` arguments of a verb are appended.
    """
    for block in blocks(page):
        if block.marker == "file":
            Path(block.note).write_text(block.text, encoding="utf-8")
        if block.marker == "run" and block.language == "python":
            subprocess.run([sys.executable, "-c", block.text], check=True)
        if block.marker != "run":
            continue
        for command in (line[2:] for line in block.text.split("\n") if line.startswith("$ ")):
            program, *arguments = shlex.split(command, comments=True)
            assert program == "carlab"
            arguments += added.get(arguments[0], ())
            code = run([path for argument in arguments for path in sorted(glob.glob(argument)) or [argument]])
            printed = "".join(capfd.readouterr())
            assert code == 0, f"{command}\n{printed}"
            assert "Traceback" not in printed


def test_installed_command_starts() -> None:
    command = Path(sys.executable).with_name("carlab")
    done = subprocess.run([str(command), "--version"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.split()[0]) == (0, "carlab"), done.stderr


@pytest.mark.parametrize("verb", list(_verbs()))
def test_help_of_each_verb_has_its_summary(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match=r"^0$"):
        run([verb, "--help"])
    printed = capsys.readouterr().out
    summary = (_verbs()[verb].__doc__ or "").split("\n")[0].rstrip(".")
    assert summary.split()[0] in printed
    assert "--verbose" in printed


def test_carlab_starts_as_a_module() -> None:
    done = subprocess.run([sys.executable, "-m", "carlab", "--help"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert [verb for verb in _verbs() if verb not in done.stdout] == []


def test_readme_lists_exactly_the_verbs() -> None:
    documented = re.findall(r"^\| `carlab (\w+)", README.read_text(encoding="utf-8"), flags=re.M)
    assert [verb for verb in documented if verb not in _verbs()] == []
    assert [verb for verb in _verbs() if verb not in documented] == []


def test_readme_has_at_most_150_lines_and_short_paragraphs() -> None:
    lines = README.read_text(encoding="utf-8").split("\n")
    assert len(lines) <= 150
    paragraphs = re.split(r"\n\s*\n", re.sub(r"```.*?```", "", README.read_text(encoding="utf-8"), flags=re.S))
    prose = [p for p in paragraphs if not p.lstrip().startswith(("|", "*", "1.", "#", "!"))]
    assert [p for p in prose if len(p.strip().split("\n")) > 4] == []


def test_documented_car_file_loads_as_a_real_car(tmp_path: Path) -> None:
    (block,) = [b for b in BLOCKS if b.marker == "car file"]
    path = tmp_path / "car.toml"
    path.write_text(block.text, encoding="utf-8")
    car = load_car_file(path)
    assert car.real is not None
    assert car.real.name == "blue car"
    assert car.real.envelope.max_speed_mps == 3.0
    assert car.simulator.effects["steering_lag"]["time_constant"] == 0.05
    assert set(tomllib.loads(block.text)["hardware"]) == {
        "name",
        "actuator",
        "calibration",
        "mocap",
        "arena",
        "limits",
    }


@pytest.mark.parametrize("block", [b for b in BLOCKS if b.language == "python"], ids=lambda b: _name(b.page))
def test_each_python_block_compiles(block: Block) -> None:
    compile(block.text, _name(block.page), "exec")


def test_links_between_files_of_the_repository_resolve() -> None:
    broken = [
        f"{_name(page)}: {target}"
        for page in PAGES
        for target in re.findall(r"\]\((?!https?://|#|mailto:)([^)#\s]+)", page.read_text(encoding="utf-8"))
        if not (page.parent / target).exists()
    ]
    assert broken == []


def test_each_effect_of_the_catalogue_has_a_picture() -> None:
    drawn = {path.stem for path in (ROOT / "docs" / "images" / "effects").glob("*.png")}
    assert drawn == set(CATALOGUE), "run make pictures"


@pytest.mark.parametrize(
    "page", ["README.md", "docs/glossary.md", "docs/reference/effects.md", "docs/explanation/proof-protocol.md"]
)
def test_number_of_effects_is_that_of_the_catalogue(page: str) -> None:
    numbers = re.findall(r"\b(\d\d) effects", (ROOT / page).read_text(encoding="utf-8"))
    assert set(numbers) == {str(len(CATALOGUE))}


def test_number_of_candidates_of_a_comparison_is_stated() -> None:
    page = (ROOT / "docs/how-to/compare-drives.md").read_text(encoding="utf-8")
    counts = [len(change_candidates(SimulatorConfig.from_preset(name))) for name in preset_names()]
    assert f"all candidates ({min(counts)} to {max(counts)} by the car file: effects and parameters" in page


@pytest.mark.parametrize("page", ["docs/glossary.md", "docs/reference/car-file.md"])
def test_cars_that_come_with_carlab_are_listed(page: str) -> None:
    text = (ROOT / page).read_text(encoding="utf-8")
    assert [name for name in preset_names() if f"`{name}`" not in text] == []


def test_site_builds_without_warnings(tmp_path: Path) -> None:
    mkdocs = Path(sys.executable).with_name("mkdocs")
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [str(mkdocs), "build", "--strict", "--quiet", "--site-dir", str(tmp_path / "site")],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    reference = tmp_path / "site" / "reference"
    assert (reference / "cli.html").is_file()
    effects = (reference / "effects.html").read_text(encoding="utf-8")
    for equation in (
        "time_constant dd/dt = d_cmd - d",
        "d = d_cmd - clip(d_cmd, -width/2, width/2)",
        "M -= coefficient r",
    ):
        assert equation in effects
    api = (reference / "api.html").read_text(encoding="utf-8")
    for cls in (CarState, Observation, PolicyInput, EffectFinding, Estimate, FitErrors, EpisodeResult):
        assert [field.name for field in dataclasses.fields(cls) if f">{field.name}<" not in api] == []
    car_file = (reference / "car-file.html").read_text(encoding="utf-8")
    for table in (ActuatorConfig, ActuatorCalibration, MocapConfig, SafetyEnvelope):
        for key in {field.name for field in dataclasses.fields(table)} - {"arena_m"}:
            assert f"<td><code>{key}</code></td>" in car_file, "a table lists each key with its default"


def test_page_about_a_new_car_lists_its_interface() -> None:
    page = (ROOT / "docs/how-to/add-a-car.md").read_text(encoding="utf-8")
    names = Car.__abstractmethods__ | set(Car.__annotations__)
    assert {"arm", "clock"} <= names
    assert [name for name in sorted(names) if f"`{name}" not in page] == []
