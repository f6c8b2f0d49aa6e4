"""Pauses of the whole machine: noticed, left out of durations, and a reason to run a test against the clock again.

A busy virtual machine stops all its processes for half a second now and then. A drive ends then, as it must: with a
stale pose, or by the watchdog. This file is a plugin of pytest, too.
"""

from __future__ import annotations

import contextlib
import threading
import time
from types import TracebackType
from typing import Any, Self

import pytest
from _pytest.runner import runtestprotocol

PERIOD_S = 0.01
MIN_PAUSE_S = 0.05
"""Shortest step of ``RunningTime`` that counts as a pause [s]: tests demand neutral commands over 0.055 s."""
MAX_RUNS = 3
PROPERTY = "runs before, with a pause of the machine of"


class RunningTime:
    """Measures the time in which this process could run: each step of a thread counts for ``2 * PERIOD_S`` at most.

    ``longest_step_s`` is the duration of the longest step.
    """

    def __init__(self) -> None:
        self.seconds = 0.0
        self.longest_step_s = 0.0
        self._finished = threading.Event()
        self._thread = threading.Thread(target=self._run, name="running time")

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._finished.set()
        self._thread.join()

    def _run(self) -> None:
        before_s, is_finished = time.monotonic(), False
        while not is_finished:
            is_finished = self._finished.wait(PERIOD_S)
            now_s = time.monotonic()
            step_s, before_s = now_s - before_s, now_s
            self.seconds += min(step_s, 2.0 * PERIOD_S)
            self.longest_step_s = max(self.longest_step_s, step_s)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> bool | None:
    """Run a ``realtime`` test; run it again, with new fixtures, if it failed and the machine paused meanwhile.

    A test that fails without a pause, or in each of ``MAX_RUNS`` runs, fails. Only the last run is reported.
    """
    if "realtime" not in item.keywords:
        return None
    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    pauses_s: list[float] = []
    while True:
        with RunningTime() as running:
            reports = runtestprotocol(item, log=False, nextitem=nextitem)
        is_paused = running.longest_step_s >= MIN_PAUSE_S
        if not is_paused or len(pauses_s) == MAX_RUNS - 1 or not any(report.failed for report in reports):
            break
        pauses_s.append(running.longest_step_s)
        with contextlib.suppress(Exception):  # A fixture of the module may have failed.
            item.session._setupstate.teardown_exact(None)
    for report in reports:
        if pauses_s:
            report.user_properties.append((PROPERTY, " and ".join(f"{pause_s:.2f} s" for pause_s in pauses_s)))
        item.ihook.pytest_runtest_logreport(report=report)
    item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
    return True


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Name the tests that ran again."""
    reports = (report for kind in ("passed", "failed", "error") for report in terminalreporter.getreports(kind))
    properties = ((report.nodeid, getattr(report, "user_properties", ())) for report in reports)  # not of a collection
    lines = {f"{test}: {name} {value}" for test, own in properties for name, value in own}
    for line in sorted(line for line in lines if PROPERTY in line):
        terminalreporter.write_line(line)
