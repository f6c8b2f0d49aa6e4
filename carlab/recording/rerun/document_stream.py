"""Documents of episodes as entities of a rerun stream, in files and in live views.

Documents are collected and sent as columns at every flush, so that a tick costs microseconds.
"""

from __future__ import annotations

import logging

import rerun as rr

from carlab.core.documents import EpisodeEnded, EpisodeStarted, HealthReading, SafetyEvent, Tick, Transition
from carlab.core.quantities import FloatArray
from carlab.recording.rerun import blueprint as look
from carlab.recording.rerun.columns import Color, Columns, Row, entity_part, log_surroundings
from carlab.recording.sink import Item, LogLine

_ROWS_BEFORE_FLUSH = 512


class DocumentStream:
    """Writes the documents of one episode after the other; the first is an EpisodeStarted.

    Attributes:
        stream: receives the entities.
        logged: paths of the entities with data.
        now_s: time of the newest document on the timeline ``car_time`` [s].
        columns: writer of the arrays of the episode.
    """

    def __init__(self, stream: rr.RecordingStream) -> None:
        self.stream = stream
        self.logged: set[str] = set()
        self.now_s = 0.0
        self.columns = Columns(stream, 0.0)
        self.rows: list[tuple[int, float]] = []
        self._seen: list[Row] = []
        self._ticks: list[Tick] = []
        self._transitions: list[Transition] = []
        self._state = ""
        self._arrival_s: float | None = None
        self._step = 0

    def begin(
        self, started: EpisodeStarted, start_s: float = 0.0, episode: int | None = None, trail: Color | None = None
    ) -> None:
        """Start an episode.

        Args:
            started: its first document.
            start_s: time of that document on the timeline ``car_time``.
            episode: position on the timeline ``episode``; None: the recording has only this episode.
            trail: colour of the driven path; None: that of the car.
        """
        self.columns = Columns(self.stream, started.t_s - start_s, episode, trail, self.logged)
        self.now_s, self._step, self._state, self._arrival_s, self.rows = start_s, 0, "", None, []
        log_surroundings(self.stream, started.arena_m, started.path_m, started.goal)

    def write(self, item: Item) -> None:
        """Write a document or log line of the episode."""
        if not isinstance(item, LogLine | EpisodeStarted):
            self.now_s = item.t_s - self.columns.origin_s
        match item:
            case Tick():
                self._step = item.step
                self._seen.append((item.step, item.t_s, item.observation))
                self._ticks.append(item)
                if item.safety_state != self._state:
                    self._state = item.safety_state
                    self.log(look.SAFETY_STATE, rr.StateChange(state=item.safety_state))
                if len(self._ticks) >= _ROWS_BEFORE_FLUSH:
                    self.flush()
            case Transition():
                self._transitions.append(item)
                self._arrival_s = item.t_s
            case SafetyEvent():
                self.text(look.SAFETY_EVENT, f"{item.kind}: {item.text}", "WARN")
            case HealthReading():
                for name, value in item.health.readings.items():
                    self.log(f"{look.HEALTH}/{entity_part(name)}", rr.Scalars(value))
                for problem in item.health.problems:
                    self.text(look.LOG, f"health: {problem}", "WARN")
            case LogLine():
                level = logging.getLevelName(item.level).replace("WARNING", "WARN")
                self.text(look.LOG, f"{item.name}: {item.message}", level)
            case EpisodeEnded():
                if item.last is not None and item.steps > self._step:
                    end_s = item.t_s if self._arrival_s is None else self._arrival_s
                    self._seen.append((item.steps, end_s, item.last))
                self.flush()
                self._step = item.steps
                level = "WARN" if item.reason.is_safety_stop else "INFO"
                self.text(look.END, f"{item.reason.name}: {item.reason.sentences(item.detail)}", level)

    def overlay(self, name: str, states: FloatArray) -> None:
        """Write states (n, 6) of an additional car at the times of all rows so far; rows with NaN are omitted."""
        self.columns.overlay(name, [t_s for _, t_s in self.rows], [step for step, _ in self.rows], states)

    def flush(self) -> None:
        """Send the collected rows."""
        self.columns.states(self._seen)
        self.columns.ticks(self._ticks)
        self.columns.rewards(self._transitions)
        self.rows.extend((step, t_s) for step, t_s, _ in self._seen)
        self._seen, self._ticks, self._transitions = [], [], []

    def text(self, path: str, text: str, level: str = "INFO") -> None:
        """Log a line of text at the time of the newest document."""
        self.log(path, rr.TextLog(text, level=level))

    def log(self, path: str, entity: rr.AsComponents) -> None:
        """Log an entity at the time of the newest document."""
        self.columns.set_time(self.now_s, self._step)
        self.stream.log(path, entity)
        self.logged.add(path)
