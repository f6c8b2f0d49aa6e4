"""The learning curve and what a model foretold, for the rerun viewer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import rerun as rr

from carlab.core.angles import on_one_branch
from carlab.core.quantities import STATE_NAMES, FloatArray
from carlab.recording.whole_files import rerun_file


def write_learning_curve(
    path: Path,
    rows: Sequence[Mapping[str, float]],
    driven: Sequence[FloatArray],
    foretold: Sequence[tuple[np.ndarray, FloatArray, FloatArray]],
    diagnoses: Sequence[str] = (),
) -> None:
    """Write a recording: every figure as a curve over the episodes, paths in the plan view, states over the ticks.

    Args:
        path: of the .rrd file; replaced whole.
        rows: figures by name, one mapping an episode, ``episode`` among them.
        driven: states of each episode (T + 1, 6).
        foretold: of stretches of each episode the ticks (S, N), and mean and standard deviation of the states there
            (S, N, 6).
        diagnoses: what is said of the simulator after each episode, empty where nothing is; none at all unless given.

    Raises:
        DataError: it cannot be written; what was there stays.
    """
    with rerun_file(path, recording_id=path.parent.name) as stream:
        texts = diagnoses or [""] * len(rows)
        before = 0
        for row, states, (ticks, mean, std), text in zip(rows, driven, foretold, texts, strict=True):
            stream.set_time("episode", sequence=int(row["episode"]))
            for name, value in row.items():
                if name != "episode" and np.isfinite(value):
                    stream.log(f"learning/{name}", rr.Scalars(float(value)))
            if text:
                stream.log("diagnosis", rr.TextLog(text, level=rr.TextLogLevel.INFO))
            stream.log("plan/driven", rr.LineStrips2D([states[:, :2]], colors=[(0, 0, 0)]))
            stream.log("plan/foretold", rr.LineStrips2D(list(mean[..., :2]), colors=[(230, 130, 0)]))
            places, doubts = mean[..., :2].reshape(-1, 2), 2.0 * std[..., :2].reshape(-1, 2)
            stream.log("plan/foretold/doubt", rr.Ellipses2D(centers=places, half_sizes=doubts))
            for k, name in enumerate(STATE_NAMES):
                measured, told = states[:, k], mean[..., k]
                if name == "yaw" and len(ticks):
                    measured, told = on_one_branch(measured, ticks[:, 0], told)
                _series(stream, f"states/{name}/measured", before + np.arange(len(states)), measured[:, None])
                if len(ticks):
                    middle, width = told[:, 1:].ravel(), 2.0 * std[:, 1:, k].ravel()
                    band = np.stack([middle, middle - width, middle + width], axis=1)
                    _series(stream, f"states/{name}/foretold", before + ticks[:, 1:].ravel(), band)
            before += len(states)


def _series(stream: rr.RecordingStream, entity: str, ticks: np.ndarray, values: FloatArray) -> None:
    """Curves (n, curves) over the ticks of all episodes, one after the other."""
    each = np.full(len(values), values.shape[1])
    columns = rr.Scalars.columns(scalars=values.ravel()).partition(each)
    stream.send_columns(entity, indexes=[rr.TimeColumn("tick", sequence=ticks)], columns=columns)


__all__ = ["write_learning_curve"]
