"""Work in child processes: one command each, several at a time, with memory measured, stoppable between and within.

Children have sessions of their own: a ^C typed at the terminal reaches only the parent, which then lets the running
ones finish.
"""

from __future__ import annotations

import os
import signal
import subprocess
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from carlab.core.clock import MonotonicClock

POLL_S = 0.02
TAIL = 2000
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
Task = TypeVar("Task")
Made = TypeVar("Made")


@dataclass(frozen=True)
class ChildEnd:
    """How a child ended.

    ``exit_status`` is None where it took too long, negative where a signal ended it. ``peak_memory_mib`` is the largest
    resident set of the child or of a process that it waited for (getrusage); never less than the parent's own at the
    start of the child, as Linux counts it.
    """

    exit_status: int | None
    seconds: float
    words: str
    peak_memory_mib: float
    abandoned: bool = False


def run_child(
    command: Sequence[str],
    folder: Path,
    *,
    timeout_s: float,
    words_in: str = "",
    environment: Mapping[str, str] | None = None,
    abandon: Callable[[], bool] = lambda: False,
) -> ChildEnd:
    """Run a command in a folder and wait for it.

    Args:
        command: Program and arguments.
        folder: Working directory.
        timeout_s: The child and its session are killed after that long.
        words_in: Its standard input.
        environment: Changes to the environment.
        abandon: Asked all along; True kills it.
    """
    clock = MonotonicClock()
    inherited = {k: v for k, v in os.environ.items() if k != "PWD"}
    with tempfile.TemporaryFile() as said, tempfile.TemporaryFile() as asked:
        asked.write(words_in.encode())
        asked.seek(0)
        begin_s = clock.now_s()
        child = subprocess.Popen(
            command, cwd=folder, env={**inherited, **(environment or {})}, stdin=asked, stdout=said,
            stderr=subprocess.STDOUT, start_new_session=True,
        )  # fmt: skip
        too_long = abandoned = False
        ended = 0
        try:
            while not ended:
                ended, status, usage = os.wait4(child.pid, os.WNOHANG)
                if ended:
                    child.returncode = os.waitstatus_to_exitcode(status)
                    break
                too_long = too_long or clock.now_s() - begin_s > timeout_s
                abandoned = abandoned or abandon()
                if too_long or abandoned:
                    _kill_session(child.pid)
                clock.sleep_until(clock.now_s() + POLL_S)
        except BaseException:
            _kill_session(child.pid)
            child.wait()
            raise
        seconds = clock.now_s() - begin_s
        said.seek(max(0, said.seek(0, os.SEEK_END) - TAIL))
        words = said.read().decode(errors="replace")
    if too_long:
        words = f"ended after {timeout_s:g} s"
    code = None if too_long else int(child.returncode)
    return ChildEnd(code, seconds, words, usage.ru_maxrss / 1024.0, abandoned)


def _kill_session(pid: int) -> None:
    try:
        os.killpg(pid, signal.SIGKILL)
    except ProcessLookupError:
        return  # it has just ended by itself


def side_by_side(
    jobs: int,
    tasks: Iterable[Task],
    work: Callable[[Task], Made],
    *,
    stop_requested: Callable[[], bool] = lambda: False,
    finished: Callable[[Task, Made], None] = lambda task, made: None,
) -> bool:
    """Do tasks in order, ``jobs`` at a time, each in a thread (whose work is to wait for a child process).

    ``stop_requested`` is asked before each task begins; those that run are finished. ``finished`` is called in this
    thread. The first error ends the whole after the running tasks. Returns whether all were done.
    """
    left = iter(tasks)
    running: dict[Future[Made], Task] = {}
    more = True
    with ThreadPoolExecutor(jobs) as pool:
        while more or running:
            while more and len(running) < jobs:
                task = next(left, None)
                if task is None:
                    more = False
                elif stop_requested():
                    _drain(running, finished)
                    return False
                else:
                    running[pool.submit(work, task)] = task
            # A time-out, so that the main thread hears signals.
            for future in wait(running, timeout=0.2, return_when=FIRST_COMPLETED).done:
                finished(running.pop(future), future.result())
    return True


def _drain(running: Mapping[Future[Made], Task], finished: Callable[[Task, Made], None]) -> None:
    pending = set(running)
    while pending:
        done, pending = wait(pending, timeout=0.2, return_when=FIRST_COMPLETED)
        for future in done:
            finished(running[future], future.result())
