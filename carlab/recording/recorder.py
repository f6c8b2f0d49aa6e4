"""Recorder: writes the documents of the control loop in a separate thread."""

from __future__ import annotations

import dataclasses
import logging
import queue
import threading
from collections.abc import Callable, Sequence
from typing import cast

from carlab.core.clock import MonotonicClock, wall_clock_ns
from carlab.core.documents import Document, EpisodeEnded, EpisodeStarted, SafetyEvent
from carlab.core.errors import NotOpenError
from carlab.core.outcome import EndReason
from carlab.core.resource import Resource
from carlab.recording.sink import Item, LogLine, Sink, describe_os_error

logger = logging.getLogger(__name__)

_UNDROPPABLE = (EpisodeStarted, EpisodeEnded, SafetyEvent)
_CLOSE = object()


class Recorder(Resource):
    """Distributes the documents of one episode to sinks without blocking the emitting thread.

    If the queue is full, ticks, transitions, health readings and log lines are dropped (``dropped`` counts them, also
    ``recorder_dropped`` in the EpisodeEnded), but never the start, the end or a safety event. A sink that raises is
    closed and not used any more; ``failed`` has the reason, and the other sinks continue. ``emit`` and ``close`` may
    be called from any thread, also while the thread that opened the recorder hangs.

    Args:
        sinks: Writers of the documents; this recorder opens and closes them.
        capacity: Length of the queue from which documents are dropped.
        flush_interval_s: Longest time whose documents are lost if the process is killed [s].
    """

    def __init__(self, sinks: Sequence[Sink], *, capacity: int = 100_000, flush_interval_s: float = 0.25) -> None:
        self._sinks = list(sinks)
        self._capacity = capacity
        self._flush_interval_s = flush_interval_s
        self._queue: queue.SimpleQueue[object] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._clock = MonotonicClock()
        self._thread: threading.Thread | None = None
        self._closing = False
        self._dropped = 0
        self._progress = 0
        self._failed: str | None = None

    @property
    def failed(self) -> str | None:
        """Error of the first failed sink, in one sentence; None without a failure."""
        return self._failed

    @property
    def dropped(self) -> int:
        """Number of documents dropped because the sinks were too slow."""
        return self._dropped

    def open(self) -> None:
        """Open every sink and start the writer. Raises DataError if a file cannot be created; then all are closed."""
        with self._lock:
            if self._thread is not None:
                return
            for sink in self._sinks:
                try:
                    sink.open()
                except BaseException:
                    for opened in self._sinks:
                        opened.abandon()
                    raise
            self._thread = threading.Thread(target=self._run, name="carlab-recorder", daemon=True)
            self._thread.start()

    def emit(self, document: Document | LogLine) -> None:
        """Queue one document; returns at once. Raises NotOpenError before ``open``; ignored after ``close``."""
        if self._thread is None:
            raise NotOpenError("The recorder was used before it was opened; use it in a with statement.")
        if self._closing:
            return
        if not isinstance(document, _UNDROPPABLE) and self._queue.qsize() >= self._capacity:
            self._dropped += 1
            return
        self._queue.put(document)

    def log_handler(self) -> logging.Handler:
        """A logging handler that writes the program's log into the recording; the caller adds and removes it."""
        return _RecorderHandler(self)

    def close(self, timeout_s: float = 5.0) -> None:
        """Write the queued documents, complete the files and join the writer. Idempotent, from any thread.

        Waits while the writer makes progress, and gives up after ``timeout_s`` without progress (a disk that hangs).
        An episode without an EpisodeEnded is completed as CRASHED. Does not raise if a file cannot be completed;
        ``failed`` has the reason.
        """
        with self._lock:
            if self._thread is None:
                self._closing = True
                return
            if not self._closing:
                self._closing = True
                self._queue.put(_CLOSE)
        progress, give_up_s = -1, 0.0
        while self._thread.is_alive():
            if progress != self._progress:
                progress, give_up_s = self._progress, self._clock.now_s() + timeout_s
            elif self._clock.now_s() >= give_up_s:
                self._store_failure(
                    f"The recording is incomplete: its writer made no progress for {timeout_s:g} s. Its .partial "
                    "file has the documents written so far; check the disk."
                )
                return
            self._thread.join(min(0.05, timeout_s))

    def _run(self) -> None:
        sinks = list(self._sinks)
        next_flush_s = self._clock.now_s() + self._flush_interval_s
        unflushed = False
        while True:
            try:
                item = self._queue.get(timeout=max(0.0, next_flush_s - self._clock.now_s()))
            except queue.Empty:
                item = None
            if item is _CLOSE:
                break
            if item is not None:
                unflushed = True
                self._write(sinks, cast(Item, item))
            if (now_s := self._clock.now_s()) >= next_flush_s:
                next_flush_s = now_s + self._flush_interval_s
                if unflushed:
                    self._for_each(sinks, _flush)
                    unflushed = False
        self._for_each(sinks, Sink.close)

    def _write(self, sinks: list[Sink], item: Item) -> None:
        if isinstance(item, EpisodeEnded) and self._dropped:
            item = dataclasses.replace(item, statistics={**item.statistics, "recorder_dropped": float(self._dropped)})
        self._for_each(sinks, lambda sink: sink.write(item))

    def _for_each(self, sinks: list[Sink], action: Callable[[Sink], None]) -> None:
        """Apply an action to each sink; one that raises is closed and removed from ``sinks``."""
        for sink in tuple(sinks):
            try:
                action(sink)
            except Exception as error:
                sinks.remove(sink)
                self._close_failed_sink(sink, error)
            self._progress += 1

    def _close_failed_sink(self, sink: Sink, error: Exception) -> None:
        """Close a sink that raised an error, and store the error.

        After a disk error the file stays ``.partial``, since bytes may be missing inside. After other errors it is
        completed as RECORDER_ERROR.
        """
        name = getattr(sink, "path", type(sink).__name__)
        sentence = describe_os_error(error, name) if isinstance(error, OSError) else f"{name}: {error}"
        self._store_failure(sentence)
        if isinstance(error, OSError):  # The episode reports ``failed`` once.
            logger.info("Recording failed: %s", sentence)
        else:
            logger.error("Recording failed: %s", sentence, exc_info=error)
        try:
            if not isinstance(error, OSError):
                sink.close(EndReason.RECORDER_ERROR, sentence)
        except Exception as second:
            logger.warning("%s could not be completed either: %s", name, second)
        finally:
            sink.abandon()

    def _store_failure(self, sentence: str) -> None:
        if self._failed is None:
            self._failed = sentence


def _flush(sink: Sink) -> None:
    if not sink.finished:
        sink.flush()


class _RecorderHandler(logging.Handler):
    """Sends log records to a recorder, except its own records (to avoid an endless loop)."""

    def __init__(self, recorder: Recorder) -> None:
        super().__init__(logging.INFO)
        self._recorder = recorder

    def emit(self, record: logging.LogRecord) -> None:
        """Queue one line."""
        if record.name == __name__ or self._recorder._thread is None:
            return
        self._recorder.emit(LogLine(wall_clock_ns(), record.levelno, record.name, record.getMessage()))
