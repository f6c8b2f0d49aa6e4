"""Files that replace the one that is there only once they are whole."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from carlab.core.errors import DataError
from carlab.recording.sink import describe_os_error, partial_path

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb

APPLICATION = "carlab"


def write_text(path: Path, text: str) -> None:
    """Write text as UTF-8, or leave the file that is there.

    Raises:
        DataError: it cannot be written.
    """
    partial = partial_path(path)
    try:
        with partial.open("w", encoding="utf-8", newline="\n") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
    except OSError as error:
        with suppress(OSError):
            partial.unlink()
        raise DataError(describe_os_error(error, path)) from error


@contextmanager
def rerun_file(
    path: Path, recording_id: str | None = None, blueprint: rrb.Blueprint | None = None
) -> Iterator[rr.RecordingStream]:
    """A stream into an .rrd file that is there when the block ends well; after an error the old one stays.

    Raises:
        DataError: it cannot be written.
    """
    import rerun as rr

    from carlab.recording.drained_file import DrainedFile

    partial = partial_path(path)
    file = DrainedFile(partial)
    stream: rr.RecordingStream | None = None
    try:
        partial.unlink(missing_ok=True)
        file.open()
        stream = rr.RecordingStream(APPLICATION, recording_id=recording_id)
        stream.save(file.start(), default_blueprint=blueprint)
        yield stream
        stream.disconnect()
        stream = None
        file.close()
        file.check()
        os.replace(partial, path)
    except OSError as error:
        raise DataError(describe_os_error(error, path)) from error
    finally:
        if stream is not None:
            with suppress(Exception):
                stream.disconnect()
        file.close()
        with suppress(OSError):
            partial.unlink(missing_ok=True)


__all__ = ["rerun_file", "write_text"]
