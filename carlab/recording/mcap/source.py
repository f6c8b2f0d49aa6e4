"""Reader of recordings, complete or not: it returns all records that are not damaged."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Attachment, Channel, Header, Message, Metadata

from carlab.core.documents import Document, EpisodeEnded, EpisodeStarted, SafetyEvent, Tick
from carlab.core.episode_data import EpisodeData
from carlab.core.errors import DataError
from carlab.core.quantities import Action, Observation, PoseSample
from carlab.recording.episode_builder import RECOVERED, RECOVERY, episode_from_documents
from carlab.recording.mcap import messages as messages
from carlab.recording.mcap import schemas as schemas
from carlab.recording.mcap.damage import MAGIC, UNFINISHED, FileDefect, read_records
from carlab.recording.sink import LogLine, partial_path


@dataclass(frozen=True, slots=True)
class Recording:
    """Contents of one recording.

    ``documents`` are the emitted documents in order; without an EpisodeEnded if the writer was killed.
    ``defect`` is what is wrong with the file, None if it is complete; ``extra`` has the further columns of an imported
    recording.
    """

    path: Path
    documents: tuple[Document, ...]
    run_metadata: Mapping[str, str]
    log: tuple[LogLine, ...]
    defect: FileDefect | None
    extra: Mapping[int, Mapping[str, float]] = field(default_factory=dict)


def read_episode(path: Path | str) -> EpisodeData:
    """Read a recording as arrays; times are on the car's clock.

    An incomplete file gives its complete ticks, with ``recovered`` = ``true`` and a sentence ``recovery`` in the
    metadata; ``end_reason`` is ``CRASHED`` if the end is missing. The ticks of a damaged chunk are left out. Metadata
    of the run, of the episode and of its end are one flat mapping.

    Raises:
        DataError: The file is not a carlab recording, or holds no complete tick.
    """
    recording = read_recording(path)
    try:
        episode = episode_from_documents(recording.documents, recording.extra, recording.run_metadata)
    except DataError as error:
        if recording.defect not in (None, UNFINISHED):
            raise DataError(_no_tick(recording.path, recording.defect)) from error
        raise DataError(str(error).replace("The recording", str(recording.path), 1)) from error
    if recording.defect is None:
        return episode
    recovery = {RECOVERED: "true", RECOVERY: recording.defect.sentence(episode.ticks)}
    return dataclasses.replace(episode, metadata={**episode.metadata, **recovery})


def read_documents(path: Path | str) -> tuple[Document, ...]:
    """Read the documents that were emitted, in order. Raises DataError like ``read_episode``."""
    return read_recording(path).documents


def read_recording(path: Path | str) -> Recording:
    """Read a recording. Raises DataError if it is no recording, or ends before its episode starts."""
    path = Path(path)
    collector = _Collector()
    try:
        with path.open("rb") as file:
            head = file.read(len(MAGIC))
            if head != MAGIC and (head != MAGIC[: len(head)] or not head):
                raise DataError(_not_an_mcap(path, head))
            defect = read_records(file, collector.take, collector.skip)
    except FileNotFoundError as error:
        raise DataError(_missing(path)) from error
    except IsADirectoryError as error:
        raise DataError(f"{path} is a folder; name one of the .mcap files in it (episodes/0001.mcap).") from error
    except OSError as error:
        raise DataError(f"{path} could not be read: {error.strerror}; check its permissions.") from error
    return collector.recording(path, defect)


def _not_an_mcap(path: Path, head: bytes) -> str:
    if path.suffix == ".rrd":
        return f"{path} is for the rerun viewer (carlab view); name the .mcap recording instead."
    found = f"it begins with {str(head)[1:]}" if head else "it is empty"
    return f"{path} is not an MCAP file ({found}); name an .mcap recording, or read a table with carlab import."


def _no_tick(path: Path, defect: FileDefect | None) -> str:
    """Sentence about a recording that ends before its first tick."""
    if defect in (None, UNFINISHED):
        return f"{path} holds no complete tick (its writer was stopped before the episode began); record it again."
    return f"{path} holds no complete tick and {defect.clause}; {defect.remedy}."


def _short(error: Exception) -> str:
    """Description of an error in a record, truncated to the length of a sentence."""
    reason = f"{error} is missing" if isinstance(error, KeyError) else str(error)
    return reason if len(reason) <= 120 else f"{reason[:120]}..."


def _missing(path: Path) -> str:
    unfinished = partial_path(path)
    if unfinished.exists():
        return f"{path} is incomplete; read {unfinished.name} in the same folder instead."
    return f"{path} does not exist; check the name (recordings are in runs/<run>/episodes/)."


class _Collector:
    """Converts messages back to documents."""

    def __init__(self) -> None:
        self._topics: dict[int, str] = {}
        self._library = ""
        self._config = ""
        self._run: dict[str, str] = {}
        self._episode: dict[str, str] = {}
        self._documents: list[Document] = []
        self._log: list[LogLine] = []
        self._extra: dict[int, dict[str, float]] = {}
        self._poses: list[PoseSample] = []
        self._state: tuple[int, Observation] | None = None
        self._actions: dict[str, tuple[int, Action]] = {}
        self._handlers: dict[str, Callable[[Any], None]] = {
            schemas.SAMPLE_TOPIC: lambda m: self._poses.append(messages.decode_pose(m)),
            schemas.STATE_TOPIC: self._handle_state,
            schemas.REQUESTED_TOPIC: lambda m: self._handle_action("requested", m),
            schemas.SENT_TOPIC: lambda m: self._handle_action("sent", m),
            schemas.TICK_TOPIC: self._handle_tick,
            schemas.LOG_TOPIC: lambda m: self._log.append(messages.decode_log(m)),
            schemas.EXTRA_TOPIC: lambda m: self._extra.__setitem__(m.step, dict(zip(m.names, m.values, strict=False))),
            schemas.TRANSITION_TOPIC: lambda m: self._documents.append(messages.decode_transition(m)),
            schemas.HEALTH_TOPIC: lambda m: self._documents.append(messages.decode_health(m)),
            schemas.EVENT_TOPIC: lambda m: self._documents.append(SafetyEvent(m.t_s, m.kind, m.text)),
        }

    def take(self, record: object) -> None:
        match record:
            case Message():
                self._handle_message(self._topics.get(record.channel_id, ""), record.data)
            case Channel():
                self._topics[record.id] = record.topic
            case Metadata(name=schemas.RUN_RECORD):
                self._run = dict(record.metadata)
            case Metadata(name=schemas.EPISODE_RECORD):
                self._episode = dict(record.metadata)
            case Attachment(name=schemas.CONFIG_ATTACHMENT):
                self._config = record.data.decode()
            case Header():
                self._library = record.library

    def skip(self) -> None:
        """Forget the parts of a tick whose other parts are damaged."""
        self._state = None
        self._poses.clear()
        self._actions.clear()

    def _handle_message(self, topic: str, data: bytes) -> None:
        if topic in self._handlers:
            message = schemas.TOPIC_CLASSES[topic]()
            message.ParseFromString(data)
            self._handlers[topic](message)

    def _handle_state(self, m: Any) -> None:
        self._state = (m.step, messages.decode_observation(m, tuple(self._poses)))
        self._poses.clear()

    def _handle_action(self, which: str, m: Any) -> None:
        self._actions[which] = (m.step, messages.decode_action(m))

    def _handle_tick(self, m: Any) -> None:
        parts = (self._state, self._actions.get("requested"), self._actions.get("sent"))
        if any(part is None or part[0] != m.step for part in parts):
            return
        (_, seen), (_, requested), (_, sent) = parts  # type: ignore[misc]
        features = np.array(m.features, dtype=np.float64)
        self._documents.append(
            Tick(m.step, m.t_s, m.late_s, seen, features, requested, sent, m.policy_s, m.safety_state)
        )
        self._state = None

    def recording(self, path: Path, defect: FileDefect | None) -> Recording:
        ours = self._library.startswith("carlab ")
        # The library of a damaged header is unknown; the topics show whose file it is.
        is_foreign = defect is None or self._library or not schemas.TOPIC_CLASSES.keys() >= {*self._topics.values()}
        if not ours and is_foreign:
            raise DataError(
                f"{path} is an MCAP file but not a recording of carlab (written by "
                f"{self._library or 'an unknown program'}); export it as CSV there and use carlab import."
            )
        if not self._episode:
            raise DataError(_no_tick(path, defect))
        try:
            documents = list(self._assemble())
        except (KeyError, ValueError) as error:
            raise DataError(
                f"{path} has a record {schemas.EPISODE_RECORD} that this version cannot read ({_short(error)}); "
                "read it with the version that wrote it."
            ) from error
        if defect is None and not isinstance(documents[-1], EpisodeEnded):
            defect = UNFINISHED
        return Recording(path, tuple(documents), self._run, tuple(self._log), defect, self._extra)

    def _assemble(self) -> Iterator[Document]:
        started: EpisodeStarted = messages.started_from_metadata(self._episode, self._config)
        yield started
        yield from self._documents
        if "end_t_s" in self._episode:
            yield messages.ended_from_metadata(self._episode, self._state[1] if self._state else None)


def has_ticks(recording: Path) -> bool:
    """Whether a recording has a completed tick; the safety gate or a hang may end an episode before the first one."""
    documents = read_documents(recording)
    steps = [document.step for document in documents if isinstance(document, Tick)]
    completed = [d.steps for d in documents if isinstance(d, EpisodeEnded) and d.last is not None]
    return len(steps) > 1 or bool(steps and completed and completed[0] > steps[-1])
