"""A test against the clock runs again only if the machine paused while it failed."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from tests.helpers.pauses import MAX_RUNS, RunningTime

HELPERS = Path(__file__).with_name("helpers")
TESTS = """
import collections, os, signal, subprocess, pauses, pytest
from pauses import RunningTime

pauses.MIN_PAUSE_S = 0.2  # a busy machine has shorter pauses

runs = collections.Counter()

def pause(name):
    runs[name] += 1
    subprocess.Popen(["sh", "-c", f"sleep 0.3; kill -CONT {os.getpid()}"])
    os.kill(os.getpid(), signal.SIGSTOP)

@pytest.fixture(scope="module")
def drive():
    pause("fixture")
    assert runs["fixture"] == 2
    return runs["fixture"]

@pytest.mark.realtime
def test_with_a_fixture_that_fails_once(drive, tmp_path):
    assert drive == 2
    assert not list(tmp_path.iterdir())
    (tmp_path / "file").touch()

@pytest.mark.realtime
def test_that_fails_once_with_a_pause():
    pause("once")
    assert runs["once"] == 2

@pytest.mark.realtime
def test_that_fails_without_a_pause():
    runs["no pause"] += 1
    assert runs["no pause"] == 2

@pytest.mark.realtime
def test_that_fails_always():
    pause("always")
    pytest.fail(f"run {runs['always']}")

def test_running_time_without_a_pause():
    with RunningTime() as running:
        pause("running")
    assert running.seconds < 0.2 < running.longest_step_s

def test_that_has_no_marker():
    pause("no marker")
    assert runs["no marker"] == 2
"""


def test_only_a_pause_of_the_machine_runs_a_test_again(tmp_path: Path) -> None:
    (tmp_path / "test_inner.py").write_text(TESTS)
    (tmp_path / "pytest.ini").write_text("[pytest]\nmarkers = realtime: against the clock\n")
    code = f"import sys, pytest; sys.path.insert(0, {str(HELPERS)!r}); sys.exit(pytest.main(sys.argv[1:]))"
    options = ["-p", "pauses", "-p", "no:cacheprovider", "-p", "no:xdist", "-rA", "-q", "--tb=short", "test_inner.py"]
    done = subprocess.run(
        [sys.executable, "-c", code, *options],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=60,
    )
    outcomes = {
        line.split("::")[1].split(" ")[0]: line.split(" ")[0]
        for line in done.stdout.splitlines()
        if line.startswith(("PASSED", "FAILED", "ERROR"))
    }
    assert outcomes == {
        "test_with_a_fixture_that_fails_once": "PASSED",
        "test_that_fails_once_with_a_pause": "PASSED",
        "test_that_fails_without_a_pause": "FAILED",
        "test_that_fails_always": "FAILED",
        "test_running_time_without_a_pause": "PASSED",
        "test_that_has_no_marker": "FAILED",
    }, done.stdout
    assert f"run {MAX_RUNS}" in done.stdout
    assert done.stdout.count("runs before, with a pause of the machine of") == 3


def test_running_time_grows_while_this_process_waits() -> None:
    with RunningTime() as running:
        subprocess.run(["sleep", "0.3"], check=True)
    assert running.seconds > 0.1
