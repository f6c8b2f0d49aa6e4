"""A time limit for a function of a user, by the interval timer of the process."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

REPEAT_S = 0.1
"""Period of further alarms [s], for a function that handles the first one itself."""


class TimeLimitExceededError(BaseException):
    """The time limit has passed. ``except Exception`` in the interrupted function does not handle it."""


@contextmanager
def time_limit(limit_s: float) -> Iterator[None]:
    """Interrupt the body if it takes longer than ``limit_s``. Only while no car is open: it may end at any line.

    Python handles signals in the main thread and between two instructions. So the body has no limit in another thread,
    and a call of compiled code is interrupted when it returns. An earlier interval timer does not run meanwhile.

    Raises:
        TimeLimitExceededError: the body takes longer.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    is_active = True

    def interrupt(number: int, frame: FrameType | None) -> None:
        if is_active:
            raise TimeLimitExceededError

    handler = signal.signal(signal.SIGALRM, interrupt)
    earlier = signal.setitimer(signal.ITIMER_REAL, limit_s, REPEAT_S)
    try:
        try:
            yield
        finally:
            is_active = False
    finally:  # also runs if an alarm interrupts the inner one; the next alarm comes REPEAT_S later
        is_active = False
        signal.setitimer(signal.ITIMER_REAL, *earlier)
        signal.signal(signal.SIGALRM, handler)
