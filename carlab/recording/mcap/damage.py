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


def read_records(file: IO[bytes], take: Callable[[object], None], skip: Callable[[], None]) -> FileDefect | None:
    """Pass all readable records of a file to ``take``.

    A chunk that does not match its checksum is left out: ``skip`` is called, and later chunks are read.

    Args:
        file: an MCAP file, opened for reading.
        take: receives each record that is not a chunk, and the records of each chunk.
        skip: is called for each chunk that is left out.

    Returns:
        What is wrong with the file; None if it is complete.

    Raises:
        OSError: the file cannot be read.
    """
    size = os.fstat(file.fileno()).st_size
    has_end = _has_end(file, size)
    channels, ticks_written = _summary(file, size) if has_end else ((), None)
    file.seek(0)
    damaged_at: int | None = None
    start = len(MAGIC)
    try:
        reader = StreamReader(file, emit_chunks=True, validate_crcs=True, record_size_limit=size)
        for record in reader.records:
            for content in _contents(record) if isinstance(record, Chunk) else [record]:
                if content is not None:
                    take(content)
                elif file.tell() < size:
                    damaged_at = start if damaged_at is None else damaged_at
                    skip()
                    for channel in channels:  # The first chunk holds them.
                        take(channel)
            start = file.tell()
    except OSError:
        raise
    except Exception as error:
        # mcap, zstandard and protobuf raise different errors for damaged bytes.
        if damaged_at is None and isinstance(error, CRCValidationError) and isinstance(error.record, DataEnd):
            return FileDefect("does not match its checksum", "copy it again", ticks_written)
        damaged_at = start if damaged_at is None and has_end else damaged_at
    else:
        if damaged_at is None:
            return None
    if damaged_at is not None:
        return FileDefect(f"is damaged at byte {damaged_at}", "copy it again", ticks_written)
    if str(file.name).endswith(PARTIAL_SUFFIX):
        return UNFINISHED
    return FileDefect(
        f"ends at byte {size} before its closing record (it was not copied as a whole, or its writer was stopped)",
        "copy it again",
    )


def _contents(chunk: Chunk) -> list[object | None]:
    """Records of a chunk; ``[None]`` if it is damaged."""
    try:
        return [*breakup_chunk(chunk, validate_crc=True)]
    except Exception:
        return [None]


def _has_end(file: IO[bytes], size: int) -> bool:
    """Whether a file ends as a complete one does."""
    if size < 2 * len(MAGIC):
        return False
    file.seek(-len(MAGIC), os.SEEK_END)
    return file.read() == MAGIC


def _summary(file: IO[bytes], size: int) -> tuple[tuple[Channel, ...], int | None]:
    """Channels and number of ticks by the summary at the end of the file; none if it is missing or damaged."""
    file.seek(0)
    try:
        summary = SeekingReader(file, record_size_limit=size).get_summary()
    except Exception:
        return (), None
    if summary is None or summary.statistics is None:
        return (), None
    channels = tuple(summary.channels.values())
    counts = summary.statistics.channel_message_counts
    return channels, sum(counts.get(channel.id, 0) for channel in channels if channel.topic == schemas.TICK_TOPIC)
