"""Child processes of a run: imports, open files, and ^C.

^C at the terminal reaches every process of its group; those that compute for a run leave it to the run.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import signal
import subprocess
import sys
import threading
import time
from multiprocessing import forkserver
from pathlib import Path

import pytest

from carlab.experiment.campaign.child_process import child_context, interrupts_blocked, run_in_child
from tests.helpers.waiting import until

CHILD = """
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)  # A shell ignores SIGINT in background jobs.
print("ready", flush=True)
input()
"""
SOURCE = """
import json, os, pathlib, sys
names = [os.readlink(f"/proc/self/fd/{k}") for k in os.listdir("/proc/self/fd") if os.path.exists(f"/proc/self/fd/{k}")]
pathlib.Path(%r).write_text(json.dumps({"modules": list(sys.modules), "open": names}))
"""


def test_process_that_is_started_in_the_block_gets_no_interrupt() -> None:
    with interrupts_blocked():
        child = subprocess.Popen([sys.executable, "-c", CHILD], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert child.stdout is not None
    assert child.stdout.readline() == b"ready\n"
    child.send_signal(signal.SIGINT)
    child.communicate(b"end\n", timeout=20.0)
    assert child.returncode == 0


def test_interrupt_during_the_block_arrives_after_it() -> None:
    done = []

    def block() -> None:
        with interrupts_blocked():
            signal.raise_signal(signal.SIGINT)
            done.append("block")

    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # A shell ignores SIGINT in background jobs.
    try:
        with pytest.raises(KeyboardInterrupt):
            block()
    finally:
        signal.signal(signal.SIGINT, before)
    assert done == ["block"]
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, set())


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_server_of_the_child_processes_imports_without_interrupts() -> None:
    child_context()
    status = Path(f"/proc/{forkserver._forkserver._forkserver_pid}/status").read_text(encoding="ascii")
    (blocked,) = [int(line.split()[1], 16) for line in status.splitlines() if line.startswith("SigBlk:")]
    assert blocked >> (signal.SIGINT - 1) & 1


def test_child_has_the_imports_and_no_open_file_of_its_parent(tmp_path: Path) -> None:
    with (tmp_path / "port").open("w") as port:
        child = child_context().Process(target=exec, args=(SOURCE % str(tmp_path / "seen.json"),))
        child.start()
        child.join()
    seen = json.loads((tmp_path / "seen.json").read_text())
    assert {"torch", "carlab.experiment.campaign.training", "learning.policy.sac_agent"} <= set(seen["modules"])
    assert seen["open"]
    assert port.name not in seen["open"]


def test_script_from_standard_input_gets_the_result_of_its_child() -> None:
    script = (
        "import math\n"
        "from carlab.experiment.campaign.child_process import run_in_child\n"
        "print(run_in_child('root', math.sqrt, (4.0,), lambda: False), __file__)\n"
    )
    ended = subprocess.run([sys.executable, "-"], input=script, capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stdout) == (0, "2.0 <stdin>\n"), ended.stderr


def test_stop_does_not_wait_for_the_imports_of_the_server(tmp_path: Path) -> None:
    """The first server imports for a minute; after the stop the next child has another server."""
    marker = tmp_path / "marker"
    (tmp_path / "slow.py").write_text(
        "import pathlib, time\n"
        f"marker = pathlib.Path({str(marker)!r})\n"
        "if not marker.exists():\n"
        "    marker.touch()\n"
        "    time.sleep(60.0)\n"
    )
    script = (
        "import math, pathlib\n"
        "from carlab.experiment.campaign import child_process\n"
        "child_process._IMPORTED_ONCE = ('slow',)\n"
        f"stop = pathlib.Path({str(marker)!r}).exists\n"
        "print(child_process.run_in_child('root', math.sqrt, (4.0,), stop))\n"
        "print(child_process.run_in_child('root', math.sqrt, (4.0,), lambda: False))\n"
    )
    ended = subprocess.run(
        [sys.executable, "-c", script],
        env=_with_path(tmp_path),
        capture_output=True,
        text=True,
        check=False,
        timeout=50.0,
    )
    assert (ended.returncode, ended.stdout) == (0, "None\n2.0\n"), ended.stderr


def test_server_that_is_killed_by_a_stop_has_ended_when_the_stop_returns(monkeypatch: pytest.MonkeyPatch) -> None:
    """The next child could not connect to a server that is ending."""
    child_context()
    server, kill = forkserver._forkserver._forkserver_pid, os.kill  # type: ignore[attr-defined]

    def kill_later(pid: int, number: int) -> None:
        with contextlib.suppress(ProcessLookupError):
            time.sleep(0.3)
            kill(pid, number)

    monkeypatch.setattr(os, "kill", lambda *given: threading.Thread(target=kill_later, args=given).start())
    assert run_in_child("root", math.sqrt, (4.0,), lambda: True) is None
    state = Path(f"/proc/{server}/stat").read_text().rsplit(")", 1)[1].split()[0]
    assert state == "Z", "multiprocessing has to see its end"
    assert run_in_child("root", math.sqrt, (4.0,), lambda: False) == 2.0


def test_stop_returns_if_the_other_thread_has_seen_the_end_of_the_server(monkeypatch: pytest.MonkeyPatch) -> None:
    """The thread that starts the child replaces an ended server, after which the system no longer knows it."""
    waitid = os.waitid

    def after_the_other_thread(kind: int, pid: int, options: int) -> None:
        waitid(kind, pid, options)
        raise ChildProcessError

    monkeypatch.setattr(os, "waitid", after_the_other_thread)
    assert run_in_child("root", math.sqrt, (4.0,), lambda: True) is None


def _with_path(folder: Path) -> dict[str, str]:
    """The environment in which a new Python finds the modules of a folder too."""
    return os.environ | {"PYTHONPATH": os.pathsep.join([str(folder), *sys.path])}


SLEEPER = """
import os, time
def sleep(report):
    report(os.getpid())
    time.sleep(1000.0)
"""
PARENT = """
import sleeper
from carlab.experiment.campaign.child_process import run_in_child
run_in_child("sleeper", sleeper.sleep, (), lambda: False, on_report=lambda pid: print(pid, flush=True))
"""


def test_child_ends_with_a_parent_that_is_killed(tmp_path: Path) -> None:
    (tmp_path / "sleeper.py").write_text(SLEEPER)
    command = [sys.executable, "-c", PARENT]
    with subprocess.Popen(command, stdout=subprocess.PIPE, cwd=tmp_path, env=_with_path(tmp_path)) as parent:
        assert parent.stdout is not None
        child = int(parent.stdout.readline())
        os.kill(child, 0)
        parent.kill()
    until(lambda: not Path(f"/proc/{child}").exists())
