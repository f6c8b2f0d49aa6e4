"""Signals, and a watch that acts whatever the loop hangs in."""

import logging
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from carlab.core.outcome import EndReason
from carlab.experiment.episodes.interrupts import SIGNALS, Flag, Interrupts, LoopWatch

PATIENT_S = 20.0


@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_asks_and_a_second_one_urges(number: signal.Signals) -> None:
    before = signal.getsignal(number)
    with Interrupts() as interrupts:
        assert interrupts.reason() is None
        signal.raise_signal(number)
        assert interrupts.reason() is EndReason.STOP_REQUESTED
        assert not interrupts.urgent.is_set()
        signal.raise_signal(number)
        assert interrupts.urgent.is_set()
    assert signal.getsignal(number) is before


def test_who_is_interrupted_while_driving_is_interrupted_after_it() -> None:
    with Interrupts() as whole:
        with Interrupts():
            pass
        assert whole.reason() is None
        with Interrupts():
            signal.raise_signal(signal.SIGINT)
        assert whole.reason() is EndReason.STOP_REQUESTED
        assert not whole.urgent.is_set()


def test_a_storm_of_signals_does_not_stop_the_program_in_its_handler() -> None:
    """One signal's handler interrupts another's at any instruction: with a lock in them they would wait for ever."""
    stormy = threading.Event()
    main = threading.main_thread().ident
    assert main is not None

    def storm() -> None:
        while not stormy.is_set():
            signal.pthread_kill(main, signal.SIGINT)
            signal.pthread_kill(main, signal.SIGTERM)

    with Interrupts() as interrupts:
        thread = threading.Thread(target=storm)
        thread.start()
        try:
            end_s = time.monotonic() + 1.0
            while time.monotonic() < end_s:
                interrupts.requested = Flag()
                interrupts.requested.wait(0.001)
        finally:
            stormy.set()
            thread.join()
        assert interrupts.requested.is_set()


def test_a_flag_waits_as_long_as_it_is_told_and_no_longer_than_it_must() -> None:
    flag = Flag()
    begin_s = time.monotonic()
    assert not flag.wait(0.05)
    assert time.monotonic() - begin_s >= 0.05
    timer = threading.Timer(0.05, flag.set)
    timer.start()
    assert flag.wait(PATIENT_S)
    assert time.monotonic() - begin_s < PATIENT_S / 2
    timer.join()


def test_a_signal_leaves_a_question_at_once_and_nothing_else() -> None:
    answers: list[str] = []
    with Interrupts() as interrupts:

        def question() -> None:
            signal.raise_signal(signal.SIGTERM)
            answers.append("it went on waiting")

        interrupts.prompt(question)
        assert interrupts.reason() is EndReason.STOP_REQUESTED
        interrupts.prompt(lambda: answers.append("asked although it is over"))
        signal.raise_signal(signal.SIGINT)
        assert interrupts.urgent.is_set()
    assert answers == []


def test_a_question_without_a_signal_is_asked_and_its_errors_pass() -> None:
    answers: list[str] = []

    def fail() -> None:
        raise EOFError

    with Interrupts() as interrupts:
        interrupts.prompt(lambda: answers.append("asked"))
        with pytest.raises(EOFError):
            interrupts.prompt(fail)
        signal.raise_signal(signal.SIGINT)  # Raises nothing here.
    assert answers == ["asked"]


@contextmanager
def blocked_log() -> Iterator[threading.Event]:
    """A log whose terminal takes nothing (Ctrl-S) until the event is set."""
    flows = threading.Event()

    class Blocked(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            assert flows.wait(PATIENT_S), "it waited for the log"

    handler = Blocked()
    logging.getLogger().addHandler(handler)
    try:
        yield flows
    finally:
        flows.set()
        logging.getLogger().removeHandler(handler)


def test_a_loop_that_hangs_in_the_log_is_stopped() -> None:
    stopped: list[str] = []
    with blocked_log() as flows:

        def on_hang(where: str, stack: str) -> None:
            stopped.append(where)
            assert "test_a_loop_that_hangs_in_the_log" in stack
            flows.set()

        with LoopWatch(on_hang, timeout_s=0.2) as watch:
            watch.beat("logging")
            logging.getLogger("somewhere").critical("blocks")
    assert stopped == ["logging"]


def test_a_beating_or_resting_loop_is_left_alone() -> None:
    stopped: list[str] = []
    with LoopWatch(lambda where, stack: stopped.append(where), timeout_s=0.5) as watch:
        time.sleep(0.7)  # Before the first beat nothing is driven.
        for _ in range(10):
            watch.beat("driving")
            time.sleep(0.07)
        watch.pause()
        time.sleep(0.7)
    assert stopped == []


def test_urgency_does_not_wait_for_the_time_out() -> None:
    urgent, hung = Flag(), threading.Event()
    with LoopWatch(lambda where, stack: hung.set(), timeout_s=1e6, urgent=urgent, grace_s=0.1) as watch:
        watch.beat("driving")
        assert not hung.wait(0.3)
        urgent.set()
        assert hung.wait(PATIENT_S)
