"""Parallel child processes with measured memory that can be stopped between tasks or killed.

Each child has its own session, so ^C at the terminal reaches only the parent. The parent lets running children finish.
If the parent is killed, its children are killed too.
"""

from __future__ import annotations

import os
import signal
import subprocess
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from carlab.core.clock import MonotonicClock

POLL_S = 0.02
OUTPUT_TAIL_BYTES = 2000
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
KILL_AT_END_OF_INPUT = ("/bin/sh", "-c", 'read line || kill -s KILL -- "-$0"')
"""Command that waits for the end of its standard input and then kills the process group of its argument."""
START_AFTER_LINE = ("/bin/sh", "-c", 'read line && exec "$@" <"$0"')
"""Command that waits for a line of its standard input and then becomes the command that follows.

The first argument is the file that the command reads as its standard input. Without the line nothing is started.
"""
Task = TypeVar("Task")
Result = TypeVar("Result")


@dataclass(frozen=True)
class ChildEnd:
    """End of a child process.

    ``exit_status`` is None after a time-out, negative after a signal. ``output`` is the end of standard output and
    standard error, at most ``OUTPUT_TAIL_BYTES``, or states the time-out. ``peak_memory_mib`` is the largest resident
    set of the child or of a process that it waited for (getrusage); on Linux at least that of the parent at the start.
    """

    exit_status: int | None
    seconds: float
    output: str
    peak_memory_mib: float
    abandoned: bool = False


def run_child(
    command: Sequence[str],
    folder: Path,
    *,
    timeout_s: float,
    stdin_text: str = "",
    environment: Mapping[str, str] | None = None,
    abandon: Callable[[], bool] = lambda: False,
) -> ChildEnd:
    """Run a command in a folder and wait for it.

    Args:
        command: Program and arguments.
        folder: Working directory.
        timeout_s: Time after which the child and its session are killed.
        stdin_text: Standard input.
        environment: Changes to the environment.
        abandon: Polled; True kills the child.
    """
    clock = MonotonicClock()
    inherited = {k: v for k, v in os.environ.items() if k != "PWD"}
    with tempfile.TemporaryFile() as output_file, tempfile.NamedTemporaryFile() as input_file:
        input_file.write(stdin_text.encode())
        input_file.flush()
        begin_s = clock.now_s()
        child = subprocess.Popen(
            (*START_AFTER_LINE, input_file.name, *command), cwd=folder, env={**inherited, **(environment or {})},
            stdin=subprocess.PIPE, stdout=output_file, stderr=subprocess.STDOUT, start_new_session=True,
        )  # fmt: skip
        too_long = abandoned = False
        ended = 0
        try:
            with _killed_with_this_process(child.pid):
                _write_line(child)
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
        output_file.seek(max(0, output_file.seek(0, os.SEEK_END) - OUTPUT_TAIL_BYTES))
        output = output_file.read().decode(errors="replace")
    if too_long:
        output = f"ended after {timeout_s:g} s"
    code = None if too_long else int(child.returncode)
    return ChildEnd(code, seconds, output, usage.ru_maxrss / 1024.0, abandoned)


@contextmanager
def _killed_with_this_process(pid: int) -> Iterator[None]:
    """Kill the session of a child if this process is killed before the block ends.

    The child waits for a line (``START_AFTER_LINE``) until this block has begun. A shell waits for the end of a pipe,
    of which only this process has the other end. PR_SET_PDEATHSIG would need code between fork and exec, and would
    reach neither the children of the child nor outlive the thread that started it.
    """
    to_read, to_write = os.pipe()
    try:
        guard = subprocess.Popen(
            (*KILL_AT_END_OF_INPUT, str(pid)), stdin=to_read, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            start_new_session=True,
        )  # fmt: skip
        try:
            yield
        finally:
            guard.kill()
            guard.wait()
    finally:
        os.close(to_read)
        os.close(to_write)


def _write_line(child: subprocess.Popen[bytes]) -> None:
    assert child.stdin is not None
    with suppress(BrokenPipeError), child.stdin as stdin:  # the child may have been killed
        stdin.write(b"\n")


def _kill_session(pid: int) -> None:
    with suppress(ProcessLookupError):  # the process has ended
        os.killpg(pid, signal.SIGKILL)


def run_parallel(
    jobs: int,
    tasks: Iterable[Task],
    work: Callable[[Task], Result],
    *,
    stop_requested: Callable[[], bool] = lambda: False,
    finished: Callable[[Task, Result], None] = lambda task, result: None,
) -> bool:
    """Run tasks in order, ``jobs`` at a time, each in a thread that waits for a child process.

    ``stop_requested`` is called before each task; running tasks are finished. ``finished`` is called in this thread.
    The first error is raised after the running tasks have ended. Returns whether all tasks were done.
    """
    remaining = iter(tasks)
    running: dict[Future[Result], Task] = {}
    more, stopped = True, False
    with ThreadPoolExecutor(jobs) as pool:
        while more or running:
            while more and len(running) < jobs:
                task = next(remaining, None)
                stopped = task is not None and stop_requested()
                if task is None or stopped:
                    more = False
                else:
                    running[pool.submit(work, task)] = task
            # A time-out lets the main thread receive signals.
            for future in wait(running, timeout=0.2, return_when=FIRST_COMPLETED).done:
                finished(running.pop(future), future.result())
    return not stopped
