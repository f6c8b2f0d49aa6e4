"""Calls of a function with many arguments, shared between this process and child processes."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection, Pipe
from typing import Any, Generic, Self, TypeVar

from threadpoolctl import threadpool_limits

from carlab.jobs.child_processes import ONE_THREAD

log = logging.getLogger(__name__)

WORKER = ("-m", "carlab.jobs.function_workers")
Result = TypeVar("Result")


def cores_count() -> int:
    """Number of processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class FunctionWorkers:
    """Shares calls between this process and child processes.

    Results do not depend on the process that computes them: linear algebra has one thread in all of them. Children
    start with the first shared calls. Functions, arguments and results travel as pickles, between this process and its
    own children only. If a call fails in a child, this process makes it again, and all calls that follow: the child may
    have died, or may lack what a program added after its start, such as a new effect.

    Args:
        processes: Number of processes, this one included.
    """

    def __init__(self, processes: int = 1) -> None:
        self.processes = processes
        self._children: list[_Child] = []
        self._child_failed = False
        self._limits: Any = None

    def __enter__(self) -> Self:
        """Limit linear algebra to one thread."""
        self._limits = threadpool_limits(1, "blas")
        return self

    def __exit__(self, *_: object) -> None:
        """End the children, and restore the number of threads."""
        self.close()
        if self._limits is not None:
            self._limits.restore_original_limits()
            self._limits = None

    def map(
        self,
        function: Callable[..., Result],
        arguments: Sequence[tuple[Any, ...]],
        *,
        stop: Callable[[], bool] = lambda: False,
        started: Callable[[int], None] = lambda index: None,
    ) -> list[Result | None]:
        """Call a function with each tuple of arguments.

        Args:
            function: A function of a module, or a method of a picklable object.
            arguments: Positional arguments of each call.
            stop: Polled by this process before each of its calls; if it returns true, no further call begins.
            started: Called with the index of each call of this process before it begins.

        Returns:
            The results in the order of the arguments; None for calls that did not begin.
        """
        calls = _Calls(function, arguments)
        is_shared = len(arguments) > 1 and not self._child_failed
        while is_shared and len(self._children) < self.processes - 1:
            self._children.append(_Child())
        threads = [
            threading.Thread(target=calls.make_in, args=(child,), name="function worker", daemon=True)
            for child in (self._children if is_shared else ())
        ]
        for thread in threads:
            thread.start()
        try:
            while calls.pending or any(thread.is_alive() for thread in threads):
                if calls.pending and stop():
                    calls.pending.clear()
                index = calls.next()
                if index is None:  # all calls have begun; one that fails in a child becomes pending again
                    for thread in threads:
                        thread.join()
                    continue
                started(index)
                calls.results[index] = function(*arguments[index])
        except BaseException:
            calls.pending.clear()
            self.close()  # ends the calls of the children
            raise
        finally:
            for thread in threads:
                thread.join()
        self._child_failed = self._child_failed or calls.child_failed
        return calls.results

    def close(self) -> None:
        """End the children; a later ``map`` starts new ones."""
        for child in self._children:
            child.kill()
        self._children = []


class _Child:
    """A child process that makes one call at a time. It has its own session, so ^C reaches only the parent."""

    def __init__(self) -> None:
        self.connection, remote = Pipe()
        with remote:
            self._process = subprocess.Popen(
                (sys.executable, *WORKER, str(remote.fileno())),
                pass_fds=(remote.fileno(),),
                env={**os.environ, **ONE_THREAD},
                stdin=subprocess.DEVNULL,
                start_new_session=True,
            )

    def kill(self) -> None:
        self._process.kill()
        self._process.wait()
        self.connection.close()


class _Calls(Generic[Result]):
    """Calls that this process and its children share."""

    def __init__(self, function: Callable[..., Result], arguments: Sequence[tuple[Any, ...]]) -> None:
        self.function, self.arguments = function, arguments
        self.pending = deque(range(len(arguments)))
        self.results: list[Result | None] = [None] * len(arguments)
        self.child_failed = False

    def next(self) -> int | None:
        """Index of the next call, which is then no longer pending; None if none is left."""
        try:
            return self.pending.popleft()
        except IndexError:
            return None

    def make_in(self, child: _Child) -> None:
        """Hand pending calls to a child until none is left, or until one fails, which is pending again."""
        while (index := self.next()) is not None:
            try:
                child.connection.send((self.function, self.arguments[index]))
                self.results[index] = child.connection.recv()
            except Exception as error:  # whatever it is, the parent makes this call again, or raises the same error
                log.info("a call in a child process failed (%s: %s)", type(error).__name__, error)
                self.child_failed = True
                self.pending.append(index)
                return


def serve(connection: Connection) -> None:
    """Make the calls that arrive, until the other end is closed. A call that fails ends the process."""
    while True:
        try:
            function, arguments = connection.recv()
        except EOFError:
            return
        connection.send(function(*arguments))


if __name__ == "__main__":  # the program of a child process
    with Connection(int(sys.argv[1])) as parent:
        try:
            serve(parent)
        except Exception:  # the parent makes the call again, and reports its error
            sys.exit(1)
