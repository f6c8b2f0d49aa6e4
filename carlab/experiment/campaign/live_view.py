"""A run in the rerun viewer while it takes place, in another process.

The control loop only puts documents into a queue. A slow viewer loses documents; the loop never waits for it.
"""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import queue
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.queues import Queue
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import rerun as rr
import torch

from carlab.core.clock import MonotonicClock
from carlab.core.documents import Document, EpisodeStarted, Tick
from carlab.core.errors import CarlabError
from carlab.experiment.campaign.child_process import interrupts_blocked
from carlab.experiment.campaign.figures import EpisodeFigures
from carlab.experiment.campaign.quick_check import EpisodeCheck
from carlab.experiment.campaign.run_recording import TICKS_BETWEEN_PATHS, LearnedDriver, add_windows
from carlab.recording.rerun.blueprint import LOG, send_blueprint
from carlab.recording.rerun.run_recording import RunRecording, episode_number
from carlab.recording.run_folder import RunDirectory

log = logging.getLogger(__name__)

CAPACITY = 20_000
"""Documents that wait for the viewer; further ones are dropped."""
CLOSE_TIMEOUT_S = 10.0
FLUSH_PERIOD_S = 0.1
NICENESS = 10
"""Lowers the priority of the view's process below that of the control loop."""


@dataclass(frozen=True, slots=True)
class LiveSettings:
    """What the process of the view needs.

    Attributes:
        run: the run's folder.
        episodes: planned number of episodes.
        is_learning: whether the run learns.
        connect: attaches a stream to a viewer or a file; must be picklable.
    """

    run: Path
    episodes: int
    is_learning: bool
    connect: Callable[[rr.RecordingStream], None]


class LiveView:
    """Shows a run in a viewer; use it in a with statement.

    All methods return at once and raise nothing. ``dropped`` counts the documents that the viewer did not receive.
    """

    def __init__(self, settings: LiveSettings, capacity: int = CAPACITY) -> None:
        self.dropped = 0
        context = multiprocessing.get_context("spawn")
        self._queue: Queue[Any] = context.Queue(capacity)
        self._process = context.Process(target=_main, args=(settings, self._queue), daemon=True, name="live view")

    def emit(self, message: Document | EpisodeFigures | EpisodeCheck) -> None:
        """Pass a document of the control loop, or figures or a quick check of the newest episode."""
        try:
            self._queue.put_nowait(message)
        except (queue.Full, ValueError):
            self.dropped += 1

    def report_activity(self, name: str, done: int, total: int) -> None:
        """Pass the name of the work between two drives; a view does not show its progress."""
        with contextlib.suppress(queue.Full, ValueError):
            self._queue.put_nowait(name)

    def __enter__(self) -> Self:
        with interrupts_blocked():  # The process of the run handles ^C.
            self._process.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Wait until the view has shown what it received, at most ``CLOSE_TIMEOUT_S``. The viewer stays open."""
        with contextlib.suppress(queue.Full, ValueError):
            self._queue.put(None, timeout=1.0)
        self._process.join(CLOSE_TIMEOUT_S)
        if self._process.is_alive():
            self._process.terminate()
        self._queue.cancel_join_thread()
        self._queue.close()
        if self.dropped:
            log.warning("The live view missed %d documents; the recordings have them.", self.dropped)


def _main(settings: LiveSettings, messages: Queue[Any]) -> None:
    """The main function of the view's process.

    It has its own session: while a session mixes priorities, Linux 6.18.44 (``sched_autogroup``) can give the sender
    and emulated cars, which have their own sessions, no processor for seconds.
    """
    torch.set_num_threads(1)
    if hasattr(os, "setsid"):
        os.setsid()
        os.nice(NICENESS)
    show(settings, messages)


def show(settings: LiveSettings, messages: Queue[Any]) -> None:
    """Show messages until None arrives or the process of the run ends."""
    stream = rr.RecordingStream("carlab", recording_id=settings.run.name)
    try:
        settings.connect(stream)
    except CarlabError as error:
        log.warning("The run has no live view: %s", error)
        return
    stream.send_recording_name(settings.run.name)
    recording = RunRecording(stream, settings.episodes)
    send_blueprint(stream, recording.blueprint(is_learning=settings.is_learning))
    writer = _LiveWriter(settings, recording, messages.empty)
    parent = multiprocessing.parent_process()
    clock = MonotonicClock()
    next_flush_s = clock.now_s()
    while parent is None or parent.is_alive():
        with contextlib.suppress(queue.Empty):
            message = messages.get(timeout=FLUSH_PERIOD_S)
            if message is None:
                break
            writer.write(message)
        if clock.now_s() >= next_flush_s:
            recording.documents.flush()
            next_flush_s = clock.now_s() + FLUSH_PERIOD_S
    recording.documents.flush()
    stream.disconnect()


class _LiveWriter:
    """Writes messages into the recording of a run.

    Args:
        settings: of the view.
        recording: receives the entities.
        is_idle: whether no message waits. Paths are predicted then, or after the episode.
    """

    def __init__(self, settings: LiveSettings, recording: RunRecording, is_idle: Callable[[], bool]) -> None:
        self._settings = settings
        self._recording = recording
        self._is_idle = is_idle
        self._run = RunDirectory(settings.run)
        self._started: EpisodeStarted | None = None
        self._driver: LearnedDriver | None = None
        self._ticks_without_path: list[Tick] = []
        self._row: EpisodeFigures | None = None
        self._activity = ""

    def write(self, message: Document | EpisodeFigures | EpisodeCheck | str) -> None:
        """Write a document, figures, a quick check or the name of an activity."""
        match message:
            case str():
                if message != self._activity:
                    self._activity = message
                    self._recording.documents.text(LOG, message)
            case EpisodeFigures():
                self._write_figures(message)
            case EpisodeCheck():
                if self._row is not None and self._row.episode == message.episode:
                    row = self._row.with_check(message)
                    self._recording.add_figures(row.episode, row.to_dict(), row.diagnosis)
            case _:
                self._write_document(message)

    def _write_document(self, document: Document) -> None:
        is_first = self._started is None
        if isinstance(document, EpisodeStarted):
            self._started, self._ticks_without_path = document, []
            number = episode_number(document)
            self._driver = LearnedDriver.load(self._run, number) if self._settings.is_learning else None
        if self._started is None:
            return  # The start of the episode was dropped.
        self._recording.write(document)
        if is_first:  # The plan view can show the arena now.
            layout = self._recording.blueprint(is_learning=self._settings.is_learning)
            send_blueprint(self._recording.documents.stream, layout)
        if isinstance(document, Tick) and document.step % TICKS_BETWEEN_PATHS == 0:
            self._ticks_without_path.append(document)
            if self._is_idle():
                self._draw_paths([self._ticks_without_path.pop()])

    def _draw_paths(self, ticks: list[Tick]) -> None:
        if self._driver is not None and self._started is not None:
            self._driver.draw_paths_ahead(self._recording, ticks, self._started.period_s)

    def _write_figures(self, row: EpisodeFigures) -> None:
        self._row = row
        self._draw_paths(self._ticks_without_path)
        recordings = self._run.recordings()
        if self._driver is not None and row.episode <= len(recordings):
            add_windows(self._recording, self._driver.dynamics, row.episode, recordings[row.episode - 1])
        self._recording.add_figures(row.episode, row.to_dict())
