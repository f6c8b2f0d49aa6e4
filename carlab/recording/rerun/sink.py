"""Writer of one episode to one .rrd file for the rerun viewer, named .partial until it is complete.

Live recordings and conversions from arrays (``episode_to_rrd``) have the same entities. The layout of a complete file
has no panel without data.
"""

from __future__ import annotations

import contextlib
import errno
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr

from carlab.core.documents import EpisodeEnded, EpisodeStarted
from carlab.core.episode_data import EpisodeData
from carlab.core.errors import DataError
from carlab.core.outcome import EndReason
from carlab.core.quantities import FloatArray
from carlab.recording.atomic_files import APPLICATION
from carlab.recording.episode_builder import documents_from_episode
from carlab.recording.pipe_file import PipeFile
from carlab.recording.rerun import blueprint as look
from carlab.recording.rerun.columns import entity_part
from carlab.recording.rerun.document_stream import DocumentStream
from carlab.recording.sink import Item, Sink, claim, partial_path, writing

_FLUSH_TIMEOUT_S = 10.0


class RerunSink(Sink):
    """One episode in one .rrd file, with its layout.

    Args:
        path: The complete file, ``.../0001.rrd``; must not exist.
        title: Name of the recording in the viewer; by default from the EpisodeStarted.
        overlays: Additional cars: name -> states (T + 1, 6) at the times of the ticks.
        extent_m: Points that the plan view must show besides arena, goal and path, shape (n, 2) [m].
    """

    def __init__(
        self,
        path: Path | str,
        title: str = "",
        overlays: Mapping[str, FloatArray] | None = None,
        extent_m: FloatArray | None = None,
    ) -> None:
        super().__init__()
        self.path = Path(path)
        self._title = title
        self._overlays = {entity_part(name): states for name, states in (overlays or {}).items()}
        self._extent_m = np.zeros((0, 2)) if extent_m is None else extent_m
        self._stream: rr.RecordingStream | None = None
        self._file = PipeFile(partial_path(self.path))
        self._opened = False
        self._documents: DocumentStream | None = None

    def open(self) -> None:
        """Create the file. Raises DataError if that fails."""
        if self._opened or self._finished:
            return
        with writing(self.path):
            claim(self.path)
            self._file.open()
        self._opened = True

    def flush(self) -> None:
        """Send the collected rows and wait until rerun has passed them to the system. Raises OSError if that fails."""
        if self._documents is not None:
            self._documents.flush()
            self._flush_stream(self._documents.stream)

    def abandon(self) -> None:
        """Close the stream and leave the file as ``.partial``. A file without documents is removed."""
        self._finished = True
        stream, self._stream = self._stream, None
        if stream is not None:
            with contextlib.suppress(Exception):
                stream.disconnect()
        self._file.close()
        if self._opened and self._started is None:
            with contextlib.suppress(OSError):
                partial_path(self.path).unlink()
        self._opened = False

    def _write(self, item: Item) -> None:
        if not self._opened:
            raise DataError(f"{self.path} is not open; use the sink in a Recorder.")
        if isinstance(item, EpisodeStarted):
            self._documents = self._begin(item)
            return
        if self._documents is None:
            raise DataError(f"{self.path} has no stream; its start was not written.")
        self._documents.write(item)
        if isinstance(item, EpisodeEnded):
            self._end(self._documents, item)

    def _begin(self, started: EpisodeStarted) -> DocumentStream:
        self._extent_m = np.vstack([look.extent_m(started), self._extent_m])
        overlays = tuple(self._overlays)
        stream = rr.RecordingStream(APPLICATION)
        # abandon() must disconnect the stream from here on.
        self._stream = stream
        stream.save(self._file.start(), default_blueprint=look.drive_blueprint(self._extent_m, overlays))
        reality = started.reality.value
        title = self._title or f"Episode {started.episode}: {started.policy} on {started.car}, {reality.upper()}"
        stream.send_recording_name(title)
        properties: dict[str, Any] = {
            **{name: value for name, value in started.metadata.items() if name.isidentifier() and value},
            "episode": started.episode,
            "reality": reality,
            "car": started.car,
            "policy": started.policy,
            "task": started.task,
            "seed": str(started.seed),
            "period_s": started.period_s,
        }
        stream.send_property(
            "episode",
            rr.AnyValues(**properties),
        )
        _send_end(stream, EndReason.CRASHED, "", 0, math.nan)
        if started.config_toml:
            stream.log("episode/config", rr.TextDocument(started.config_toml), static=True)
        look.log_styles(stream, overlays)
        documents = DocumentStream(stream)
        documents.begin(started)
        return documents

    def _end(self, documents: DocumentStream, ended: EpisodeEnded) -> None:
        for name, states in self._overlays.items():
            documents.overlay(name, states)
        _send_end(documents.stream, ended.reason, ended.detail, ended.steps, ended.total_reward)
        look.send_blueprint(
            documents.stream, look.drive_blueprint(self._extent_m, tuple(self._overlays), documents.logged)
        )

    def _finish(self) -> None:
        stream, self._stream = self._stream, None
        if stream is None:
            return
        stream.disconnect()
        self._file.close()
        self._file.check()
        if self.path.exists():
            raise FileExistsError(str(self.path))
        os.rename(partial_path(self.path), self.path)
        self._opened = False

    def _flush_stream(self, stream: rr.RecordingStream) -> None:
        try:
            stream.flush(timeout_sec=_FLUSH_TIMEOUT_S)
        except (RuntimeError, TimeoutError) as error:
            raise OSError(errno.EIO, f"rerun's writer failed ({error})") from error
        self._file.check()


def _send_end(stream: rr.RecordingStream, reason: EndReason, detail: str, steps: int, total_reward: float) -> None:
    stream.send_property(
        "end",
        rr.AnyValues(
            reason=reason.name, sentence=reason.value, detail=detail, steps=steps, total_reward=float(total_reward)
        ),
    )


def episode_to_rrd(
    episode: EpisodeData, path: Path | str, title: str = "", overlays: Mapping[str, FloatArray] | None = None
) -> None:
    """Write an episode of arrays as an .rrd with the entities and the layout of a live recording.

    Args:
        episode: The episode, possibly imported.
        path: The new file, ``.rrd``.
        title: Name of the recording in the viewer; by default from the metadata.
        overlays: Additional cars, ``{"predicted": states}``, states (T + 1, 6) at the times of ``episode``; rows with
            NaN are omitted.

    Raises:
        DataError: The file exists or cannot be written, or an overlay has a wrong number of rows.
    """
    for name, states in (overlays or {}).items():
        if states.shape != episode.states.shape:
            raise DataError(f"Overlay '{name}' has shape {states.shape}; the recording needs {episode.states.shape}.")
    extent_m = episode.states[np.isfinite(episode.states[:, :2]).all(axis=1), :2]
    sink = RerunSink(path, title, overlays, extent_m)
    sink.open()
    try:
        with writing(path):
            for document in documents_from_episode(episode):
                sink.write(document)
    finally:
        sink.abandon()
