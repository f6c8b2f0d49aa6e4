"""Child processes end with the process that waits for them."""

from __future__ import annotations

import fcntl
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from carlab.jobs.child_processes import run_child

JOB = """
import fcntl, os, pathlib, sys, time
held = open(sys.argv[1], "w")
fcntl.flock(held, fcntl.LOCK_EX)
if os.fork():
    pathlib.Path(sys.argv[1] + ".started").touch()
time.sleep(60)
"""
"""Two processes of one session that hold a lock until both have ended."""
WORKER = """
import sys, threading
from pathlib import Path
from carlab.jobs.child_processes import run_child
command = (sys.executable, "-c", sys.argv[2], sys.argv[1])
waiting = threading.Thread(target=run_child, args=(command, Path(sys.argv[1]).parent), kwargs={"timeout_s": 60.0})
waiting.start()
"""
DIES_BEFORE_GUARD = """
import os, signal, subprocess
start = subprocess.Popen
def start_only_the_child(command, **settings):
    if "kill" in command[2]:
        os.kill(os.getpid(), signal.SIGKILL)
    return start(command, **settings)
subprocess.Popen = start_only_the_child
"""
"""Kills the worker after the start of the child and before that of the process that watches over it."""


def wait_for(condition: Callable[[], bool], seconds: float = 10.0) -> bool:
    end_s = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end_s:
            return False
        time.sleep(0.02)
    return True


def is_free(lock: Path) -> bool:
    with lock.open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
    return True


def test_killed_parent_takes_its_child_and_its_grandchild_with_it(tmp_path: Path) -> None:
    lock = tmp_path / "lock"
    with subprocess.Popen([sys.executable, "-c", WORKER, str(lock), JOB]) as worker:
        assert wait_for(Path(f"{lock}.started").exists)
        assert not is_free(lock)
        worker.kill()
    assert wait_for(lambda: is_free(lock))


def test_parent_killed_while_it_starts_a_child_leaves_no_child(tmp_path: Path) -> None:
    lock = tmp_path / "lock"
    worker = subprocess.run([sys.executable, "-c", DIES_BEFORE_GUARD + WORKER, str(lock), JOB], check=False)
    assert worker.returncode == -signal.SIGKILL
    assert not wait_for(lock.exists, seconds=1.0)


@pytest.mark.parametrize("stdin_text", ["", "one\ntwo\n", "x" * 200_000])
def test_child_reads_all_of_its_standard_input(tmp_path: Path, stdin_text: str) -> None:
    program = "import sys; print(len(sys.stdin.read()))"
    end = run_child((sys.executable, "-c", program), tmp_path, timeout_s=60.0, stdin_text=stdin_text)
    assert (end.exit_status, end.output) == (0, f"{len(stdin_text)}\n")


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="counts open files in /proc")
def test_ended_child_leaves_no_process_and_no_open_file(tmp_path: Path) -> None:
    def open_files() -> int:
        return len(list(Path("/proc/self/fd").iterdir()))

    children = Path(f"/proc/self/task/{threading.get_native_id()}/children")
    before = open_files(), children.read_text()
    end = run_child((sys.executable, "-c", "print(1)"), tmp_path, timeout_s=60.0)
    assert (end.exit_status, end.output) == (0, "1\n")
    assert (open_files(), children.read_text()) == before
