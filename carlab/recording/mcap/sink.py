"""Writer of one episode to one .mcap file, named .partial until it is complete.

Chunks are small and are closed at every flush, so that a reader recovers all but the last fraction of a second if the
writer was killed. ``log_time`` and ``publish_time`` are Unix times [ns] of the tick and of the capture of the pose,
converted by the origins ``start_t_s`` and ``start_wall_ns`` of the record ``carlab.episode``. The messages also have
the car's clock in seconds, unrounded.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import IO

import mcap_protobuf.schema
from mcap.writer import Writer

from carlab.core.documents import EpisodeEnded, EpisodeStarted, Tick
from carlab.core.episode_data import EpisodeData
from carlab.core.errors import DataError
from carlab.core.outcome import EndReason
from carlab.core.version import VERSION
from carlab.recording.episode_builder import OWN_COLUMNS, documents_from_episode
from carlab.recording.mcap import schemas as schemas
from carlab.recording.mcap.messages import (
    Stamped,
    UnixMapping,
    encode,
    ended_to_metadata,
    started_to_metadata,
    text,
)
from carlab.recording.sink import Item, Sink, claim, partial_path, writing

CHUNK_BYTES = 16 * 1024


class McapSink(Sink):
    """One episode in one MCAP file.

    Args:
        path: The complete file, ``.../0001.mcap``; must not exist.
        run_metadata: Facts about the run (versions, git, host), written as the metadata record ``carlab.run``.
    """

    def __init__(self, path: Path | str, run_metadata: Mapping[str, str] | None = None) -> None:
        super().__init__()
        self.path = Path(path)
        self._run_metadata = {text(key): text(value) for key, value in (run_metadata or {}).items()}
        self._file: IO[bytes] | None = None
        self._writer: Writer | None = None
        self._channels: dict[str, int] = {}
        self._unix = UnixMapping(0.0, 0)

    def open(self) -> None:
        """Create the file and write its header. Raises DataError if that fails."""
        if self._file is not None or self._finished:
            return
        with writing(self.path):
            self._file = claim(self.path).open("xb")
            self._writer = Writer(self._file, chunk_size=CHUNK_BYTES)
            self._writer.start(profile="", library=f"carlab {VERSION}")
            self._writer.add_metadata(schemas.RUN_RECORD, self._run_metadata)
            for topic, message_class in schemas.TOPIC_CLASSES.items():
                schema_id = mcap_protobuf.schema.register_schema(self._writer, message_class)
                self._channels[topic] = self._writer.register_channel(
                    topic, "protobuf", schema_id, schemas.channel_metadata(topic)
                )
            self._file.flush()

    def flush(self) -> None:
        """Close the current chunk and pass it to the operating system."""
        if self._writer is not None:
            self._writer.flush()  # type: ignore[no-untyped-call]

    def abandon(self) -> None:
        """Close the file and leave it as ``.partial``. A file without documents is removed."""
        self._finished = True
        self._writer = None
        if self._file is None:
            return
        file, self._file = self._file, None
        with contextlib.suppress(OSError):
            file.close()
        if self._started is None:
            with contextlib.suppress(OSError):
                partial_path(self.path).unlink()

    def write_extra(self, step: int, t_s: float, values: Mapping[str, float]) -> None:
        """Write further columns of an imported recording at one step. Raises DataError before ``open``."""
        message = schemas.CLASSES["Extra"](t_s=t_s, step=step, names=list(values), values=list(values.values()))
        self._put(Stamped(schemas.EXTRA_TOPIC, message, t_s, t_s, step))

    def _write(self, item: Item) -> None:
        if self._writer is None:
            raise DataError(f"{self.path} is not open; use the sink in a Recorder.")
        if isinstance(item, EpisodeStarted):
            self._unix = UnixMapping(item.t_s, item.wall_ns)
            now_ns = self._unix.to_ns(item.t_s)
            self._writer.add_attachment(
                now_ns, now_ns, schemas.CONFIG_ATTACHMENT, "application/toml", text(item.config_toml).encode()
            )
            # The end is unknown here; a reader uses the last record of this name.
            crashed = {"end_reason": EndReason.CRASHED.name, "end_sentence": EndReason.CRASHED.value}
            self._writer.add_metadata(schemas.EPISODE_RECORD, {**started_to_metadata(item), **crashed})
        for stamped in encode(item, self._unix, self._last_t_s):
            self._put(stamped)
        if isinstance(item, EpisodeEnded) and self._started is not None:
            self._writer.flush()  # type: ignore[no-untyped-call]
            record = {**started_to_metadata(self._started), **ended_to_metadata(item)}
            self._writer.add_metadata(schemas.EPISODE_RECORD, record)

    def _put(self, stamped: Stamped) -> None:
        if self._writer is None:
            raise DataError(f"{self.path} is not open; use the sink in a Recorder.")
        self._writer.add_message(
            self._channels[stamped.topic],
            log_time=self._unix.to_ns(stamped.t_s),
            data=stamped.message.SerializeToString(),
            publish_time=self._unix.to_ns(stamped.publish_s),
            sequence=stamped.sequence & 0xFFFFFFFF,
        )

    def _finish(self) -> None:
        if self._writer is None or self._file is None:
            return
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()
        self._file = self._writer = None
        if self.path.exists():
            raise FileExistsError(str(self.path))
        partial_path(self.path).rename(self.path)


def write_episode(episode: EpisodeData, path: Path | str) -> None:
    """Write an episode of arrays (for example an imported one) as a recording; ``read_episode`` is the inverse.

    Raises:
        DataError: The file exists or cannot be written.
    """
    sink = McapSink(path)
    names = [name for name in episode.extra if name not in OWN_COLUMNS]
    sink.open()
    try:
        with writing(path):
            for document in documents_from_episode(episode):
                if isinstance(document, (Tick, EpisodeEnded)) and names:
                    step = document.step if isinstance(document, Tick) else document.steps
                    sink.write_extra(step, document.t_s, {name: float(episode.extra[name][step]) for name in names})
                sink.write(document)
    finally:
        sink.abandon()
