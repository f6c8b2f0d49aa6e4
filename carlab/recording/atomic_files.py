"""Atomic writing: a file replaces an existing file only after it is complete."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from carlab.core.errors import DataError
from carlab.recording.sink import describe_os_error, partial_path

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb

APPLICATION = "carlab"


@contextmanager
def replaced_file(path: Path) -> Iterator[Path]:
    """Path to write; it replaces ``path`` when the block ends. After an error it is removed, and ``path`` is unchanged.

    Raises:
        DataError: it cannot be written.
    """
    partial = partial_path(path)
    try:
        yield partial
        os.replace(partial, path)
    except BaseException as error:
        with suppress(OSError):
            partial.unlink()
        if isinstance(error, OSError):
            raise DataError(describe_os_error(error, path)) from error
        raise


def write_text(path: Path, text: str) -> None:
    """Write text as UTF-8; after an error an existing file is unchanged.

    Raises:
        DataError: it cannot be written.
    """
    with replaced_file(path) as partial, partial.open("w", encoding="utf-8", newline="\n") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())


def write_json(path: Path, content: Mapping[str, Any], default: Callable[[Any], Any] | None = None) -> None:
    """Write a JSON object as ``write_text`` does; ``default`` converts values that JSON does not have."""
    write_text(path, json.dumps(content, indent=2, default=default) + "\n")


@contextmanager
def rerun_file(
    path: Path, recording_id: str | None = None, blueprint: rrb.Blueprint | None = None
) -> Iterator[rr.RecordingStream]:
    """Recording stream into an .rrd file, created when the block ends; after an error the old file is unchanged.

    Raises:
        DataError: it cannot be written.
    """
    import rerun as rr

    from carlab.recording.pipe_file import PipeFile

    with replaced_file(path) as partial:
        partial.unlink(missing_ok=True)
        with closing(PipeFile(partial)) as file:
            file.open()
            stream = rr.RecordingStream(APPLICATION, recording_id=recording_id)
            try:
                stream.save(file.start(), default_blueprint=blueprint)
                yield stream
            finally:
                stream.disconnect()
        file.check()
