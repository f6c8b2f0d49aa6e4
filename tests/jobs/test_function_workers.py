"""Calls shared with child processes: the same results as in one process, whatever happens to a child."""

from __future__ import annotations

import math
import operator
import os
import signal
import statistics
import time

import numpy as np
import pytest

from carlab.jobs.function_workers import FunctionWorkers


def process_id_after(seconds: float) -> int:
    """The process that makes the call, after a pause in which another process can take the next call."""
    time.sleep(seconds)
    return os.getpid()


def test_results_are_in_the_order_of_the_arguments_with_and_without_children() -> None:
    arguments = [(k, 3) for k in range(40)]
    expected = [k**3 for k in range(40)]
    for processes in (1, 3):
        with FunctionWorkers(processes) as workers:
            assert workers.map(operator.pow, arguments) == expected
            assert workers.map(operator.pow, []) == []


def test_a_child_makes_a_part_of_the_calls(monkeypatch: pytest.MonkeyPatch) -> None:
    # The command line, which an earlier test may have called, sets it; a child imports this file from this folder.
    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
    with FunctionWorkers(2) as workers:
        made: set[int] = set()
        deadline_s = time.monotonic() + 60.0
        while len(made) < 2 and time.monotonic() < deadline_s:  # the child needs a moment to start
            made |= {each for each in workers.map(process_id_after, [(0.02,)] * 20) if each is not None}
    assert os.getpid() in made
    assert len(made) == 2


def test_an_error_of_a_call_is_raised_here() -> None:
    with FunctionWorkers(2) as workers, pytest.raises(ValueError, match=r"math domain error|expected a nonnegative"):
        workers.map(math.sqrt, [(1.0,), (-1.0,), (4.0,), (-9.0,)])


def test_calls_of_a_child_that_dies_are_made_here() -> None:
    with FunctionWorkers(2) as workers:
        workers.map(operator.neg, [(1,), (2,)])
        for child in workers._children:
            os.kill(child._process.pid, signal.SIGKILL)
        assert workers.map(operator.neg, [(k,) for k in range(10)]) == [-k for k in range(10)]


def test_arguments_that_cannot_travel_are_used_here() -> None:
    with FunctionWorkers(2) as workers:
        assert workers.map(lambda k: k + 1, [(k,) for k in range(6)]) == [1, 2, 3, 4, 5, 6]


def test_no_call_begins_after_a_stop() -> None:
    begun: list[int] = []
    workers = FunctionWorkers()
    results = workers.map(operator.neg, [(k,) for k in range(5)], stop=lambda: len(begun) == 2, started=begun.append)
    assert results == [0, -1, None, None, None]
    assert begun == [0, 1]


def test_linear_algebra_has_the_same_bits_in_every_process() -> None:
    rng = np.random.default_rng(0)
    pairs = [(a, b) for a, b in zip(rng.normal(size=(8, 30, 4000)), rng.normal(size=(8, 4000, 30)), strict=True)]
    with FunctionWorkers(2) as workers:
        shared = workers.map(np.matmul, pairs)
    with FunctionWorkers(1) as workers:
        alone = workers.map(np.matmul, pairs)
    assert all(np.array_equal(a, b) for a, b in zip(shared, alone, strict=True))


def test_children_end_with_the_workers() -> None:
    with FunctionWorkers(2) as workers:
        workers.map(statistics.fmean, [([1.0, 2.0],), ([3.0],)])
        children = [child._process for child in workers._children]
        assert [child.poll() for child in children] == [None]
    assert all(child.poll() is not None for child in children)
