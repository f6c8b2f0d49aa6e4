"""Signal handling of a drive, and the watch that stops a hung control loop."""

import logging
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from carlab.core.outcome import EndReason
from carlab.experiment.episodes.interrupts import SIGNALS, Flag, Interrupts, LoopWatch

TIMEOUT_S = 20.0


@pytest.mark.usefixtures("default_hangup")
@pytest.mark.parametrize("number", SIGNALS)
def test_first_signal_requests_a_stop_and_second_one_is_urgent(number: signal.Signals) -> None:
    before = signal.getsignal(number)
    with Interrupts() as interrupts:
        assert interrupts.reason() is None
        signal.raise_signal(number)
        assert interrupts.reason() is EndReason.STOP_REQUESTED
        assert not interrupts.urgent.is_set()
        signal.raise_signal(number)
        assert interrupts.urgent.is_set()
    assert signal.getsignal(number) is before


def test_second_signal_raises_in_a_computation() -> None:
    with Interrupts(second_raises=True) as interrupts:
        signal.raise_signal(signal.SIGINT)
        assert interrupts.requested.is_set()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)


def test_hangup_that_nohup_ignores_stays_ignored() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with Interrupts() as outer, Interrupts() as inner:
            signal.raise_signal(signal.SIGHUP)
            assert inner.reason() is None
            signal.raise_signal(signal.SIGTERM)
        assert outer.reason() is EndReason.STOP_REQUESTED
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_signal_in_an_inner_context_is_passed_to_the_outer_one() -> None:
    with Interrupts() as outer:
        with Interrupts():
            pass
        assert outer.reason() is None
        with Interrupts():
            signal.raise_signal(signal.SIGINT)
        assert outer.reason() is EndReason.STOP_REQUESTED
        assert not outer.urgent.is_set()


def test_inner_context_keeps_the_request_of_the_outer_one() -> None:
    with Interrupts():
        with Interrupts() as before:
            assert before.reason() is None
        signal.raise_signal(signal.SIGINT)
        with Interrupts() as after:
            assert after.reason() is EndReason.STOP_REQUESTED


def test_many_signals_do_not_deadlock_their_handlers() -> None:
    """A signal interrupts the handler of another one at any instruction; a lock in the handlers would deadlock."""
    finished = threading.Event()
    main = threading.main_thread().ident
    assert main is not None

    def send_signals() -> None:
        while not finished.is_set():
            signal.pthread_kill(main, signal.SIGINT)
            signal.pthread_kill(main, signal.SIGTERM)

    with Interrupts() as interrupts:
        thread = threading.Thread(target=send_signals)
        thread.start()
        try:
            end_s = time.monotonic() + 1.0
            while time.monotonic() < end_s:
                interrupts.requested = Flag()
                interrupts.requested.wait(0.001)
        finally:
            finished.set()
            thread.join()
        assert interrupts.requested.is_set()


def test_flag_wait_ends_at_the_timeout_or_when_the_flag_is_set() -> None:
    flag = Flag()
    begin_s = time.monotonic()
    assert not flag.wait(0.05)
    assert time.monotonic() - begin_s >= 0.05
    timer = threading.Timer(0.05, flag.set)
    timer.start()
    assert flag.wait(TIMEOUT_S)
    assert time.monotonic() - begin_s < TIMEOUT_S / 2
    timer.join()


def test_signal_cancels_the_current_and_all_later_prompts() -> None:
    answers: list[str] = []
    with Interrupts() as interrupts:

        def prompt() -> None:
            signal.raise_signal(signal.SIGTERM)
            answers.append("the prompt continued after the signal")

        interrupts.prompt(prompt)
        assert interrupts.reason() is EndReason.STOP_REQUESTED
        interrupts.prompt(lambda: answers.append("prompted after the stop request"))
        signal.raise_signal(signal.SIGINT)
        assert interrupts.urgent.is_set()
    assert answers == []


def test_prompt_without_a_signal_runs_and_raises_its_errors() -> None:
    answers: list[str] = []

    def fail() -> None:
        raise EOFError

    with Interrupts() as interrupts:
        interrupts.prompt(lambda: answers.append("asked"))
        with pytest.raises(EOFError):
            interrupts.prompt(fail)
        signal.raise_signal(signal.SIGINT)  # Outside a prompt a signal raises nothing.
    assert answers == ["asked"]


@contextmanager
def blocked_log() -> Iterator[threading.Event]:
    """A log handler that blocks until the event is set, like a terminal after Ctrl-S."""
    unblocked = threading.Event()

    class Blocked(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            assert unblocked.wait(TIMEOUT_S), "the log handler was not unblocked"

    handler = Blocked()
    logging.getLogger().addHandler(handler)
    try:
        yield unblocked
    finally:
        unblocked.set()
        logging.getLogger().removeHandler(handler)


def test_loop_that_hangs_in_the_log_is_stopped() -> None:
    stopped: list[str] = []
    with blocked_log() as unblocked:

        def on_hang(where: str, stack: str) -> None:
            stopped.append(where)
            assert "test_loop_that_hangs_in_the_log" in stack
            unblocked.set()

        with LoopWatch(on_hang, timeout_s=0.2) as watch:
            watch.beat("logging")
            logging.getLogger("somewhere").critical("blocks")
    assert stopped == ["logging"]


@pytest.mark.realtime
def test_loop_watch_does_not_stop_a_beating_or_paused_loop() -> None:
    stopped: list[str] = []
    with LoopWatch(lambda where, stack: stopped.append(where), timeout_s=0.5) as watch:
        time.sleep(0.7)  # The watch starts at the first beat.
        for _ in range(10):
            watch.beat("driving")
            time.sleep(0.07)
        watch.pause()
        time.sleep(0.7)
    assert stopped == []


def test_urgent_flag_stops_the_loop_before_the_timeout() -> None:
    urgent, hung = Flag(), threading.Event()
    with LoopWatch(lambda where, stack: hung.set(), timeout_s=1e6, urgent=urgent, grace_s=0.1) as watch:
        watch.beat("driving")
        assert not hung.wait(0.3)
        urgent.set()
        assert hung.wait(TIMEOUT_S)
