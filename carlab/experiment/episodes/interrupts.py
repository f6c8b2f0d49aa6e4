"""^C, SIGTERM and a watchdog for a hanging loop.

Signal handlers only set flags: the first signal requests the end of the loop after its tick, the second the immediate
end. A watchdog thread acts if the loop hangs or does not end: it stops the car and finishes the recording.
"""

from __future__ import annotations

import signal
import sys
import threading
import traceback
from collections.abc import Callable
from types import FrameType
from typing import Any, Self

from carlab.core.clock import MonotonicClock
from carlab.core.errors import ConfigError
from carlab.core.outcome import EndReason

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
POLL_S = 0.02


class Flag:
    """``threading.Event`` without a lock, for signal handlers.

    With a lock, a second signal during the handler of the first one would deadlock.
    """

    def __init__(self) -> None:
        self._is_set = False

    def set(self) -> None:
        """Set the flag permanently."""
        self._is_set = True

    def is_set(self) -> bool:
        """Whether the flag is set."""
        return self._is_set

    def wait(self, timeout_s: float) -> bool:
        """Wait until the flag is set, at most ``timeout_s``; returns whether it is set."""
        clock = MonotonicClock()
        end_s = clock.now_s() + timeout_s
        while not self._is_set and (now_s := clock.now_s()) < end_s:
            clock.sleep_until(min(now_s + POLL_S, end_s))
        return self._is_set


def check_main_thread() -> None:
    """Raise ConfigError outside the main thread, which alone can receive signals."""
    if threading.current_thread() is not threading.main_thread():
        raise ConfigError(
            "A car is driven from the main thread only, because ^C does not reach another one and could not stop the "
            "car; call carlab in the main thread, or in a process of its own."
        )


class Interrupts:
    """Context in which signals become stop requests; an inner context keeps an earlier request.

    SIGHUP stays ignored if it is ignored at the start: nohup ignores it so that a run outlives its terminal.

    Args:
        second_raises: whether the second signal raises KeyboardInterrupt, for computations that open no car.

    Raises:
        ConfigError: it is entered outside the main thread.
    """

    def __init__(self, *, second_raises: bool = False) -> None:
        self._second_raises = second_raises
        self.count = 0
        self.urgent = Flag()
        self.requested = Flag()
        self._is_prompting = False
        self._previous: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Self:
        check_main_thread()
        for number in SIGNALS:
            if number is signal.SIGHUP and signal.getsignal(number) is signal.SIG_IGN:
                continue
            self._previous[number] = signal.signal(number, self._handle)
            outer = getattr(self._previous[number], "__self__", None)
            if isinstance(outer, Interrupts) and outer.requested.is_set():
                self.requested.set()
        return self

    def __exit__(self, *exc_info: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
            outer = getattr(handler, "__self__", None)
            if self.requested.is_set() and isinstance(outer, Interrupts):
                outer.requested.set()  # The signal did not reach the outer context; its request holds for both.
        self._previous.clear()

    def reason(self) -> EndReason | None:
        """The reason to end the episode, for ``EpisodeHooks.stop_requested``."""
        return EndReason.STOP_REQUESTED if self.requested.is_set() else None

    def prompt(self, question: Callable[[], None]) -> None:
        """Call a function that waits for a person between episodes; a signal interrupts it.

        Without this, a signal during ``input()`` would take effect only after Enter.
        """
        try:
            self._is_prompting = True
            if not self.requested.is_set():
                question()
        except KeyboardInterrupt:
            if not self.requested.is_set():
                raise
        finally:
            self._is_prompting = False

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.count += 1
        self.requested.set()
        if self.count > 1:
            self.urgent.set()
        if self._is_prompting or (self._second_raises and self.count > 1):
            self._is_prompting = False
            raise KeyboardInterrupt


class LoopWatch:
    """Watchdog thread: calls ``on_hang(where, stack)`` once after ``timeout_s`` without a heartbeat.

    It also calls it if ``urgent`` is set and the loop does not end within ``grace_s``. It neither logs nor prints
    before the call, because the loop may hang in a log handler or a terminal.
    """

    def __init__(
        self,
        on_hang: Callable[[str, str], None],
        *,
        timeout_s: float = 2.0,
        urgent: Flag | None = None,
        grace_s: float = 0.5,
    ) -> None:
        self._on_hang = on_hang
        self._timeout_s = timeout_s
        self._urgent = urgent or Flag()
        self._grace_s = grace_s
        self._clock = MonotonicClock()
        self._beat_s = 0.0
        self._where = ""
        self._active = False
        self._finished = threading.Event()
        self._thread: threading.Thread | None = None
        self._watched = threading.main_thread()

    def __enter__(self) -> Self:
        self._finished.clear()
        self._watched = threading.current_thread()
        self._thread = threading.Thread(target=self._run, name="loop-watch", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *exc_info: object) -> None:
        self._finished.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join()
        self._thread = None

    def beat(self, where: str) -> None:
        """Report a heartbeat; ``where`` names the next stage of the loop."""
        self._where = where
        self._beat_s = self._clock.now_s()
        self._active = True

    def pause(self) -> None:
        """Suspend the watchdog until the next heartbeat."""
        self._active = False

    def _run(self) -> None:
        urgent_since_s: float | None = None
        while not self._finished.wait(0.05):
            now_s = self._clock.now_s()
            if self._urgent.is_set() and urgent_since_s is None:
                urgent_since_s = now_s
            hung = self._active and now_s - self._beat_s > self._timeout_s
            ignored = self._active and urgent_since_s is not None and now_s - urgent_since_s > self._grace_s
            if hung or ignored:
                frame = sys._current_frames().get(self._watched.ident or 0)
                stack = "".join(traceback.format_stack(frame)) if frame is not None else ""
                self._on_hang(self._where, stack)
                return
