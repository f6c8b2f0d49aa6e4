"""``make test`` runs commands that only compute at low priority, in their own sessions."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.helpers.low_priority import NICENESS
from tests.helpers.waiting import until

ROOT = Path(__file__).resolve().parents[1]
HELPER = "tests/helpers/low_priority.py"
COMMAND = [sys.executable, str(ROOT / HELPER), sys.executable, "-c"]


def test_command_has_its_own_session_and_a_low_priority() -> None:
    code = "import os; print(os.getpid(), os.getsid(0), os.getpriority(os.PRIO_PROCESS, 0))"
    printed = subprocess.run([*COMMAND, code], capture_output=True, text=True, check=True).stdout.split()
    pid, session, niceness = map(int, printed)
    assert session == pid != os.getsid(0)
    assert niceness == NICENESS


@pytest.mark.parametrize(("code", "status"), [("raise SystemExit(7)", 7), ("import os; os.kill(os.getpid(), 9)", 137)])
def test_exit_status_is_that_of_the_command(code: str, status: int) -> None:
    assert subprocess.run([*COMMAND, code], check=False).returncode == status


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signal_ends_the_command_and_its_children(number: signal.Signals) -> None:
    """^C of a terminal does not reach another session by itself."""
    child = "import time; time.sleep(60)"
    code = (
        "import signal, subprocess, sys; [signal.signal(n, signal.SIG_DFL) for n in (1, 2, 15)]\n"
        f"child = subprocess.Popen([sys.executable, '-c', {child!r}]); print(child.pid, flush=True); child.wait()"
    )

    def reset_signal() -> None:
        """A script that starts the tests in the background makes them ignore SIGINT."""
        signal.signal(number, signal.SIG_DFL)

    with subprocess.Popen([*COMMAND, code], stdout=subprocess.PIPE, text=True, preexec_fn=reset_signal) as process:
        assert process.stdout is not None
        pid = int(process.stdout.readline())
        process.send_signal(number)
        assert process.wait(timeout=20.0) == 128 + number
    until(lambda: not Path(f"/proc/{pid}").exists())


def test_command_ends_if_the_program_that_lowers_its_priority_is_killed() -> None:
    """As by a time limit that kills the process group of make."""
    code = "import os, time; print(os.getpid(), flush=True); time.sleep(60)"
    with subprocess.Popen([*COMMAND, code], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        pid = int(process.stdout.readline())
        process.kill()
    until(lambda: not Path(f"/proc/{pid}").exists())


def test_make_mixes_no_priorities_in_a_session() -> None:
    printed = subprocess.run(["make", "-n", "test"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    low = [line for line in printed.splitlines() if HELPER in line]
    assert any("pytest" in line for line in low)
    assert any("mypy" in line for line in low)
    assert "nice" not in printed.replace(HELPER, "")
