"""Records of an MCAP file that may be cut off or damaged, and the sentence about what is missing."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import IO

from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, DataEnd
from mcap.stream_reader import CRCValidationError, StreamReader, breakup_chunk

from carlab.recording.mcap import schemas
from carlab.recording.sink import PARTIAL_SUFFIX

MAGIC = b"\x89MCAP0\r\n"


@dataclass(frozen=True, slots=True)
class FileDefect:
    """Why records of a file are missing.

    Attributes:
        clause: predicate about the file, for example ``is damaged at byte 5093``.
        remedy: what to do.
        ticks_written: number of ticks by the statistics at the end of the file; None if they are missing.
    """

    clause: str
    remedy: str
    ticks_written: int | None = None

    def sentence(self, ticks: int) -> str:
        """Predicate about the file, with the number of ticks that were read and the remedy."""
        count = f"{ticks} complete ticks" if self.ticks_written is None else f"{ticks} of {self.ticks_written} ticks"
        return "; ".join(part for part in (self.clause, f"{count} were recovered", self.remedy) if part)


UNFINISHED = FileDefect("is incomplete, because its writer was stopped", "")


@dataclass(frozen=True, slots=True)
class _Index:
    """What the summary at the end of a file states; empty if the summary is missing or damaged.

    Attributes:
        channels: channels of all messages.
        ticks_written: number of ticks; None if it is unknown.
        record_starts: positions of chunks, attachments and metadata, in ascending order.
    """

    channels: tuple[Channel, ...] = ()
    ticks_written: int | None = None
    record_starts: tuple[int, ...] = ()


class _DamagedChunkError(Exception):
    """A chunk whose content cannot be read; ``end`` is the position after it."""

    def __init__(self, end: int) -> None:
        super().__init__()
        self.end = end


def read_records(file: IO[bytes], take: Callable[[object], None], skip: Callable[[], None]) -> FileDefect | None:
    """Pass all readable records of a file to ``take``.

    A damaged chunk is left out: ``skip`` is called, and later chunks are read. The index at the end of the file gives
    their positions.

    Args:
        file: an MCAP file, opened for reading.
        take: receives each record that is not a chunk, and the records of each chunk.
        skip: is called for each damaged part that is left out.

    Returns:
        What is wrong with the file; None if it is complete.

    Raises:
        OSError: the file cannot be read.
    """
    size = os.fstat(file.fileno()).st_size
    has_end = _has_end(file, size)
    index = _index(file, size) if has_end else _Index()
    damaged_at: int | None = None
    start = 0
    while (failure := _read_from(file, start, size, take)) is not None:
        position, error = failure
        if isinstance(error, CRCValidationError) and isinstance(error.record, DataEnd):
            if damaged_at is None:
                return FileDefect("does not match its checksum", "copy it again", index.ticks_written)
            break
        end = error.end if isinstance(error, _DamagedChunkError) else size
        next_start = next((k for k in index.record_starts if k > position), end)
        if next_start < size or has_end:
            damaged_at = position if damaged_at is None else damaged_at
        if next_start >= size:
            break
        skip()
        for channel in index.channels:  # The first chunk holds them.
            take(channel)
        start = next_start
    if damaged_at is not None:
        return FileDefect(f"is damaged at byte {damaged_at}", "copy it again", index.ticks_written)
    if failure is None:
        return None
    if str(file.name).endswith(PARTIAL_SUFFIX):
        return UNFINISHED
    return FileDefect(
        f"ends at byte {size} before its closing record (it was not copied as a whole, or its writer was stopped)",
        "copy it again",
    )


def _read_from(file: IO[bytes], start: int, size: int, take: Callable[[object], None]) -> tuple[int, Exception] | None:
    """Read records from a position on. Returns the position of the first unreadable one, and the error."""
    file.seek(start)
    position = max(start, len(MAGIC))
    try:
        reader = StreamReader(file, skip_magic=start > 0, emit_chunks=True, validate_crcs=True, record_size_limit=size)
        for record in reader.records:
            for content in _contents(record, file.tell()) if isinstance(record, Chunk) else [record]:
                take(content)
            position = file.tell()
    except OSError:
        raise
    except Exception as error:  # mcap, zstandard and protobuf raise different errors for damaged bytes.
        return position, error
    return None


def _contents(chunk: Chunk, end: int) -> list[object]:
    """Records of a chunk. Raises _DamagedChunkError, with the position ``end`` after it, if it is damaged."""
    try:
        return [*breakup_chunk(chunk, validate_crc=True)]
    except Exception as error:
        raise _DamagedChunkError(end) from error


def _has_end(file: IO[bytes], size: int) -> bool:
    """Whether a file ends as a complete one does."""
    if size < 2 * len(MAGIC):
        return False
    file.seek(-len(MAGIC), os.SEEK_END)
    return file.read() == MAGIC


def _index(file: IO[bytes], size: int) -> _Index:
    """The summary at the end of the file."""
    file.seek(0)
    try:
        summary = SeekingReader(file, record_size_limit=size).get_summary()
    except Exception:
        return _Index()
    if summary is None or summary.statistics is None:
        return _Index()
    channels = tuple(summary.channels.values())
    counts = summary.statistics.channel_message_counts
    ticks = sum(counts.get(channel.id, 0) for channel in channels if channel.topic == schemas.TICK_TOPIC)
    starts = [chunk.chunk_start_offset for chunk in summary.chunk_indexes]
    starts += [attachment.offset for attachment in summary.attachment_indexes]
    starts += [metadata.offset for metadata in summary.metadata_indexes]
    return _Index(channels, ticks, tuple(sorted(starts)))
