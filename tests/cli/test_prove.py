"""``carlab prove``: sealed before the first diagnosis, resumed after an interruption, refused if the seal is broken."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from carlab.benchmark.cases import proof_set
from carlab.benchmark.cases.proof_set import CaseSpec
from carlab.benchmark.proof import runner
from carlab.benchmark.proof.runner import Proof
from carlab.jobs.child_jobs import LocalExecutor
from tests.helpers.command_line import Carlab
from tests.helpers.jobs_here import ExecutorHere

ROOT = Path(__file__).resolve().parents[2]
FAKE_DIAGNOSIS = ROOT / "tests" / "benchmark" / "fake_diagnosis.py"
SPECS = [
    CaseSpec("single", 1, ("steering_lag",), "catalogue", 2.0, fit_s=6.0, hold_s=4.0),
    CaseSpec("null", 2, fit_s=8.0, hold_s=5.0),
]
NULL_SPECS = [CaseSpec("null", k, fit_s=8.0, hold_s=5.0) for k in (2, 3)]
# Logs whether the proof was sealed at the start of the diagnosis, then runs the fake diagnosis.
LOGGING_DIAGNOSIS = """
import json, os, runpy, sys
from pathlib import Path
root, fake_diagnosis = sys.argv[1:3]
log = Path(root, "diagnosis_log.jsonl")
with log.open("a") as file:
    threads = os.environ.get("OMP_NUM_THREADS")
    print(json.dumps({"sealed": Path(root, "seal.json").exists(), "threads": threads}), file=file)
sys.argv = sys.argv[2:]
runpy.run_path(fake_diagnosis, run_name="__main__")
"""


@pytest.fixture
def proof_dir(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Folder of a proof with two small cases and a fake diagnosis."""
    root = tmp_path / "proof"
    monkeypatch.setattr(proof_set, "short_set", lambda purpose, seed=0: SPECS)
    monkeypatch.setattr(runner, "DIAGNOSE", (sys.executable, "-c", LOGGING_DIAGNOSIS, str(root), str(FAKE_DIAGNOSIS)))
    return root


@pytest.fixture(scope="module")
def sealed_null_proof(tmp_path_factory: pytest.TempPathFactory) -> Proof:
    """A proof with two cases without an effect, which this process made one after the other."""
    proof = Proof(tmp_path_factory.mktemp("null") / "proof", NULL_SPECS, executor=ExecutorHere())
    assert proof.make() is not None
    return proof


def diagnosis_log(root: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (root / "diagnosis_log.jsonl").read_text().splitlines()]


def test_proof_is_sealed_scored_and_not_repeated(proof_dir: Path, carlab: Carlab) -> None:
    code, text = carlab("prove", "--out", proof_dir, "--no-baselines", "--jobs", 2)
    assert code == 0, text
    sealed = json.loads((proof_dir / "seal.json").read_text())["sha256"]
    assert text.index(sealed) < text.index("cases diagnosed") < text.index("The seal is intact")
    # Two cases, and the oracle run of one of them.
    assert [line["sealed"] for line in diagnosis_log(proof_dir)] == [True] * 3
    assert all(line["threads"] == "1" for line in diagnosis_log(proof_dir))
    scores = json.loads((proof_dir / "scores.json").read_text())
    shares = {rate["figure"]: rate["share"] for rate in scores["summary"]["rates"]}
    assert shares["correct effect first, strictly, all strengths"] == 1.0
    assert shares["false alarms, null and parameters"] == 1.0  # the fake diagnosis always answers steering_lag
    assert (proof_dir / "confusion.png").read_bytes()[:4] == b"\x89PNG"
    page = (proof_dir / "results.md").read_text()
    assert "| steering_lag | 1/1 | 1/1 | 1/1 |" in page
    assert "| one effect, short recording | - | - | - | 1.00 (0.21 to 1.00) 1/1 | - |" in page
    assert (proof_dir / "detection.png").read_bytes()[:4] == b"\x89PNG"
    assert "null null, short recording: answered steering_lag" in page
    assert "seeds: 1 to 2" in page
    runs = [json.loads(path.read_text()) for path in proof_dir.glob("reports/*/run.json")]
    assert all(run["exit_status"] == 0 and run["peak_memory_mib"] > 1.0 and run["jobs"] == 2 for run in runs)

    code, text = carlab("prove", "--out", proof_dir, "--no-baselines")
    assert code == 0
    assert sealed in text
    assert len(diagnosis_log(proof_dir)) == 3  # nothing was diagnosed twice

    handed = next((proof_dir / "handed").glob("*/hold.csv"))
    handed.write_bytes(handed.read_bytes() + b"\n")
    code, text = carlab("prove", "--out", proof_dir, "--no-baselines")
    assert code == 1
    assert "seal is broken" in text


def test_cases_do_not_depend_on_the_number_of_jobs(sealed_null_proof: Proof, tmp_path: Path) -> None:
    parallel = Proof(tmp_path / "parallel", NULL_SPECS, executor=LocalExecutor(2))
    assert parallel.make() is not None
    files = []
    for proof in (sealed_null_proof, parallel):
        plan = json.loads((proof.root / "answers" / "plan.json").read_text())
        files.append([(proof.root / "handed" / name / "fit.csv").read_bytes() for name in plan["names"]])
    assert files[0] == files[1]


def test_other_cases_in_the_same_folder_are_refused(proof_dir: Path, carlab: Carlab) -> None:
    assert carlab("prove", "--out", proof_dir, "--no-baselines", "--no-oracle", "--limit", 1)[0] == 0
    code, text = carlab("prove", "--out", proof_dir, "--no-baselines", "--no-oracle")
    assert code == 1
    assert "contains a proof of other cases" in text


def test_numbers_out_of_range_are_refused(tmp_path: Path, carlab: Carlab) -> None:
    for option, value in (("--jobs", 0), ("--limit", 0), ("--timeout", 0), ("--timeout", "nan"), ("--seed", -1)):
        code, text = carlab("prove", "--out", tmp_path / "proof", option, value)
        assert code == 2
        assert option in text
    # The next seed would share seeds of cases with a set of the other purpose.
    for name, last in (("development", 9), ("hard", 9), ("hard-development", 9), ("full", 29), ("short", 29)):
        code, text = carlab("prove", "--out", tmp_path / "proof", "--set", name, "--seed", last + 1)
        assert code == 2
        assert f"seeds 0 to {last}" in text
    assert not (tmp_path / "proof").exists()


def test_options_without_effect_are_refused(tmp_path: Path, carlab: Carlab) -> None:
    for option, *options in (
        ("--calibrate", "--calibrate", "--set", "real"),
        ("--calibrate", "--calibrate", "--simulator", "commonroad"),
        ("--set", "--set", "real", "--simulator", "commonroad-drift"),
        ("--ray", "--ray", "local", "--simulator", "commonroad"),
        ("--jobs", "--jobs", 2, "--simulator", "commonroad"),
        ("--data", "--data", tmp_path, "--car", "rc_car"),
        ("--tool", "--tool", "compare", "--set", "full"),
    ):
        code, text = carlab("prove", "--out", tmp_path / "proof", *options)
        assert code == 2
        assert f"{option} has no effect with --" in text
    assert not (tmp_path / "proof").exists()


# The diagnosis waits for a file, so that the test decides when it ends.
PROOF_WITH_WAITING_DIAGNOSIS = """
import sys
from pathlib import Path
from carlab.cli import run
from carlab.benchmark.cases import proof_set
from carlab.benchmark.cases.proof_set import CaseSpec
from carlab.benchmark.proof import runner
root, fake_diagnosis = sys.argv[1:]
waiting = '''
import pathlib, runpy, sys, time
root, fake_diagnosis = sys.argv[1:3]
pathlib.Path(root, "begun").touch()
while not pathlib.Path(root, "go").exists():
    time.sleep(0.02)
sys.argv = sys.argv[2:]
runpy.run_path(fake_diagnosis, run_name="__main__")
'''
specs = [CaseSpec("null", k, fit_s=8.0, hold_s=5.0) for k in (2, 3)]
proof_set.short_set = lambda purpose, seed=0: specs
runner.DIAGNOSE = (sys.executable, "-c", waiting, root, fake_diagnosis)
sys.exit(run(["prove", "--out", root, "--no-baselines", "--no-oracle"]))
"""


def wait_for(path: Path, process: subprocess.Popen[str]) -> None:
    while not path.exists():
        assert process.poll() is None, process.communicate()
        time.sleep(0.02)


@pytest.mark.parametrize("interrupts", [1, 2])
def test_first_interrupt_finishes_the_running_case_and_second_drops_it(
    interrupts: int, sealed_null_proof: Proof, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, carlab: Carlab
) -> None:
    root = tmp_path / "proof"
    shutil.copytree(sealed_null_proof.root, root)
    command = (sys.executable, "-c", PROOF_WITH_WAITING_DIAGNOSIS, str(root), str(FAKE_DIAGNOSIS))
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
    )
    wait_for(root / "begun", process)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does: to the whole process group
    if interrupts == 1:
        (root / "go").touch()
    else:
        time.sleep(0.2)
        os.killpg(process.pid, signal.SIGINT)
    output, _ = process.communicate()
    assert process.returncode == 130, output
    n_done = len(list((root / "reports").glob("*/run.json")))
    assert n_done == (1 if interrupts == 1 else 0)
    assert f"Stopped with {n_done} of 2 cases diagnosed; run the same command to continue." in " ".join(output.split())
    monkeypatch.setattr(proof_set, "short_set", lambda purpose, seed=0: NULL_SPECS)
    monkeypatch.setattr(runner, "DIAGNOSE", (sys.executable, str(FAKE_DIAGNOSIS)))
    code, text = carlab("prove", "--out", root, "--no-baselines", "--no-oracle")
    assert code == 0, text
    reports = [json.loads(path.read_text()) for path in (root / "reports").glob("*/run.json")]
    assert [report["exit_status"] for report in reports] == [0, 0]
