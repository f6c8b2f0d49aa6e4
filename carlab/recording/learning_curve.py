"""The learning curve and what a model foretold, for the rerun viewer."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
import rerun as rr

from carlab.core.errors import DataError
from carlab.core.quantities import FloatArray
from carlab.recording.drained_file import DrainedFile
from carlab.recording.sink import describe_os_error, partial_path

APPLICATION = "carlab"


def write_learning_curve(
    path: Path,
    rows: Sequence[Mapping[str, float]],
    driven: Sequence[FloatArray],
    foretold: Sequence[tuple[FloatArray, FloatArray]],
    diagnoses: Sequence[str] = (),
) -> None:
    """Write a recording whose timeline is the episode: every figure as a curve, paths in the plan view.

    Args:
        path: of the .rrd file; replaced whole.
        rows: figures by name, one mapping an episode, ``episode`` among them.
        driven: x, y [m] of each episode (T, 2).
        foretold: mean and standard deviation of x, y [m] of stretches of each episode (S, T, 2).
        diagnoses: what is said of the simulator after each episode, empty where nothing is; none at all unless given.

    Raises:
        DataError: it cannot be written; what was there stays.
    """
    unfinished = partial_path(path)
    file = DrainedFile(unfinished)
    stream: rr.RecordingStream | None = None
    try:
        unfinished.unlink(missing_ok=True)
        file.open()
        stream = rr.RecordingStream(APPLICATION, recording_id=path.parent.name)
        stream.save(file.start())
        texts = diagnoses or [""] * len(rows)
        for row, line, (mean, std), text in zip(rows, driven, foretold, texts, strict=True):
            stream.set_time("episode", sequence=int(row["episode"]))
            for name, value in row.items():
                if name != "episode" and np.isfinite(value):
                    stream.log(f"learning/{name}", rr.Scalars(float(value)))
            if text:
                stream.log("diagnosis", rr.TextLog(text, level=rr.TextLogLevel.INFO))
            stream.log("plan/driven", rr.LineStrips2D([line], colors=[(0, 0, 0)]))
            stream.log("plan/foretold", rr.LineStrips2D(list(mean), colors=[(230, 130, 0)]))
            stream.log("plan/foretold/doubt", rr.Boxes2D(centers=mean[:, -1], half_sizes=2.0 * std[:, -1]))
        stream.disconnect()
        stream = None
        file.close()
        file.check()
        os.replace(unfinished, path)
    except OSError as error:
        raise DataError(describe_os_error(error, path)) from error
    finally:
        if stream is not None:
            with suppress(Exception):
                stream.disconnect()
        file.close()
        with suppress(OSError):
            unfinished.unlink(missing_ok=True)


__all__ = ["write_learning_curve"]
