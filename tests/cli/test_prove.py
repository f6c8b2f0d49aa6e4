"""``carlab prove``: the seal before the first diagnosis, resumed where it stopped, void where it was broken."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from carlab.benchmark.cases import proof_set
from carlab.benchmark.cases.proof_set import CaseSpec
from carlab.cli import prove

Carlab = Callable[..., tuple[int, str]]
ROOT = Path(__file__).resolve().parents[2]
FAKE_DIAGNOSIS = ROOT / "tests" / "benchmark" / "fake_diagnosis.py"
SPECS = [
    CaseSpec("single", 1, ("steering_lag",), "catalogue", 2.0, fit_s=10.0, hold_s=6.0),
    CaseSpec("null", 2, fit_s=8.0, hold_s=5.0),
]
# Notes what of the proof was there when the diagnosis began, then stands in.
NOTING = """
import json, os, runpy, sys
from pathlib import Path
root, fake_diagnosis = sys.argv[1:3]
seen = Path(root, "seen.jsonl")
with seen.open("a") as file:
    threads = os.environ.get("OMP_NUM_THREADS")
    print(json.dumps({"sealed": Path(root, "seal.json").exists(), "threads": threads}), file=file)
sys.argv = sys.argv[2:]
runpy.run_path(fake_diagnosis, run_name="__main__")
"""


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Two small cases and a stand-in for the tool; the folder of the proof."""
    root = tmp_path / "proof"
    monkeypatch.setattr(proof_set, "short_set", lambda purpose, seed=0: SPECS)
    monkeypatch.setattr(
        prove, "_diagnose_command", lambda: (sys.executable, "-c", NOTING, str(root), str(FAKE_DIAGNOSIS))
    )
    return root


def seen(root: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (root / "seen.jsonl").read_text().splitlines()]


def test_a_proof_from_seal_to_results_and_again(small: Path, carlab: Carlab) -> None:
    code, text = carlab("prove", "--out", small, "--no-baselines", "--jobs", 2)
    assert code == 0, text
    sealed = json.loads((small / "seal.json").read_text())["sha256"]
    assert text.index(sealed) < text.index("cases diagnosed") < text.index("The seal is intact")
    assert [line["sealed"] for line in seen(small)] == [True] * 3  # two cases, one of them again with its name told
    assert all(line["threads"] == "1" for line in seen(small))
    scores = json.loads((small / "scores.json").read_text())
    shares = {rate["figure"]: rate["share"] for rate in scores["summary"]["rates"]}
    assert shares["correct effect first, strictly, all strengths"] == 1.0
    assert shares["false alarms, null and parameters"] == 1.0  # the stand-in always says steering_lag
    assert (small / "confusion.png").read_bytes()[:4] == b"\x89PNG"
    page = (small / "results.md").read_text()
    assert "| steering_lag | 1 | 1 | 1 |" in page
    assert "null null: answered steering_lag" in page
    assert "seeds: 1 to 2" in page
    runs = [json.loads(path.read_text()) for path in small.glob("reports/*/run.json")]
    assert all(run["exit_status"] == 0 and run["peak_memory_mib"] > 1.0 and run["jobs"] == 2 for run in runs)

    again = carlab("prove", "--out", small, "--no-baselines")
    assert again[0] == 0
    assert sealed in again[1]
    assert len(seen(small)) == 3  # nothing was diagnosed twice

    handed = next((small / "handed").glob("*/hold.csv"))
    handed.write_bytes(handed.read_bytes() + b"\n")
    code, text = carlab("prove", "--out", small, "--no-baselines")
    assert code == 1
    assert "seal is broken" in text


def test_the_cases_are_the_same_however_many_jobs(small: Path, tmp_path: Path) -> None:
    from carlab.benchmark.proof.runner import Proof

    files = []
    for jobs in (1, 2):
        proof = Proof(tmp_path / str(jobs), SPECS, jobs=jobs)
        assert proof.make() is not None
        plan = json.loads((proof.root / "answers" / "plan.json").read_text())
        files.append([(proof.root / "handed" / name / "fit.csv").read_bytes() for name in plan["names"]])
    assert files[0] == files[1]


def test_other_cases_in_the_same_folder_are_refused(small: Path, carlab: Carlab) -> None:
    assert carlab("prove", "--out", small, "--no-baselines", "--no-oracle", "--limit", 1)[0] == 0
    code, text = carlab("prove", "--out", small, "--no-baselines", "--no-oracle")
    assert code == 1
    assert "contains a proof of other cases" in text


def test_bad_options(tmp_path: Path, carlab: Carlab) -> None:
    for option in ("--jobs", "--limit", "--timeout"):
        code, text = carlab("prove", "--out", tmp_path / "proof", option, 0)
        assert code == 2
        assert option in text
    assert not (tmp_path / "proof").exists()


# The diagnosis waits for a file, so that the test says when it ends.
INTERRUPTED = """
import sys
from pathlib import Path
from carlab.cli import prove, run
from carlab.benchmark.cases import proof_set
from carlab.benchmark.cases.proof_set import CaseSpec
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
prove._diagnose_command = lambda: (sys.executable, "-c", waiting, root, fake_diagnosis)
sys.exit(run(["prove", "--out", root, "--no-baselines", "--no-oracle"]))
"""


def wait_for(path: Path, process: subprocess.Popen[str]) -> None:
    while not path.exists():
        assert process.poll() is None, process.communicate()
        time.sleep(0.02)


@pytest.mark.parametrize("times", [1, 2])
def test_interrupted_once_finishes_the_running_case_twice_drops_it(times: int, tmp_path: Path) -> None:
    root = tmp_path / "proof"
    command = (sys.executable, "-c", INTERRUPTED, str(root), str(FAKE_DIAGNOSIS))
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
    )
    wait_for(root / "begun", process)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does it: to the whole group
    if times == 1:
        (root / "go").touch()
    else:
        time.sleep(0.2)
        os.killpg(process.pid, signal.SIGINT)
    said, _ = process.communicate()
    assert process.returncode == 130, said
    done = len(list((root / "reports").glob("*/run.json")))
    assert done == (1 if times == 1 else 0)
    assert f"Stopped with {done} of 2 cases diagnosed; run the same command to continue." in " ".join(said.split())
    (root / "go").touch()
    again = subprocess.run(command, capture_output=True, text=True, check=False)
    assert again.returncode == 0, again.stdout + again.stderr
    reports = [json.loads(path.read_text()) for path in (root / "reports").glob("*/run.json")]
    assert [report["exit_status"] for report in reports] == [0, 0]
