"""Waiting for a condition in tests that drive."""

import time
from collections.abc import Callable

TIMEOUT_S = 20.0


def until(condition: Callable[[], bool]) -> None:
    """Wait for a condition; fail after ``TIMEOUT_S``."""
    end_s = time.monotonic() + TIMEOUT_S
    while not condition():
        assert time.monotonic() < end_s, "the condition was not met in time"
        time.sleep(0.002)
