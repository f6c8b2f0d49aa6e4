"""^C, SIGTERM and a loop that hangs.

Signals set an event and nothing else: the first asks the loop to end after its tick, the second does not wait for it.
A watch thread acts when the loop has hung, or has not obeyed: it stops the car, finishes the recording and leaves.
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
from carlab.core.outcome import EndReason

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
POLL_S = 0.02


class Flag:
    """Like ``threading.Event``, for signal handlers: without a lock.

    The handler of a second signal, coming while that of the first one holds the lock, would wait for ever.
    """

    def __init__(self) -> None:
        self._is_set = False

    def set(self) -> None:
        """Set it, for good."""
        self._is_set = True

    def is_set(self) -> bool:
        """Whether it is set."""
        return self._is_set

    def wait(self, timeout_s: float) -> bool:
        """Wait until it is set, or for ``timeout_s``; whether it is set."""
        clock = MonotonicClock()
        end_s = clock.now_s() + timeout_s
        while not self._is_set and (now_s := clock.now_s()) < end_s:
            clock.sleep_until(min(now_s + POLL_S, end_s))
        return self._is_set


class Interrupts:
    """Turns signals into a request to stop while the context is entered (main thread only)."""

    def __init__(self) -> None:
        self.count = 0
        self.urgent = Flag()
        self.requested = Flag()
        self._breaks = False
        self._previous: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Self:
        for number in SIGNALS:
            self._previous[number] = signal.signal(number, self._handle)
        return self

    def __exit__(self, *exc_info: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
            outer = getattr(handler, "__self__", None)
            if self.requested.is_set() and isinstance(outer, Interrupts):
                outer.requested.set()  # Who asked in here did not ask in there, and means the whole program.
        self._previous.clear()

    def reason(self) -> EndReason | None:
        """The reason to end the episode, for ``EpisodeHooks.stop_requested``."""
        return EndReason.STOP_REQUESTED if self.requested.is_set() else None

    def ask(self, question: Callable[[], None]) -> None:
        """Call what waits for a person while nothing is driven; a signal leaves it at once, and nothing else.

        Otherwise a signal during ``input()`` would be heard only after Enter was pressed.
        """
        try:
            self._breaks = True
            if not self.requested.is_set():
                question()
        except KeyboardInterrupt:
            if not self.requested.is_set():
                raise
        finally:
            self._breaks = False

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.count += 1
        self.requested.set()
        if self.count > 1:
            self.urgent.set()
        if self._breaks:
            self._breaks = False
            raise KeyboardInterrupt


class LoopWatch:
    """Calls ``on_hang(where, stack)`` from a thread of its own when no heartbeat came for ``timeout_s``.

    Also when ``urgent`` is set and the loop did not end within ``grace_s``. It acts once, and does nothing before:
    a log handler or a terminal may be what the loop hangs in.
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
        """The loop is alive and about to do ``where``."""
        self._where = where
        self._beat_s = self._clock.now_s()
        self._active = True

    def rest(self) -> None:
        """Nothing is being driven: silence is fine until the next beat."""
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
