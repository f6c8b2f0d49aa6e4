"""The learning curve and a model's predictions, for the rerun viewer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import rerun as rr

from carlab.core.angles import align_unwrapped
from carlab.core.quantities import STATE_NAMES, FloatArray
from carlab.recording.atomic_files import rerun_file


def write_learning_curve(
    path: Path,
    rows: Sequence[Mapping[str, float]],
    driven: Sequence[FloatArray],
    predictions: Sequence[tuple[np.ndarray, FloatArray, FloatArray]],
    diagnoses: Sequence[str] = (),
) -> None:
    """Write a recording: every figure as a curve over the episodes, paths in the plan view, states over the ticks.

    Args:
        path: of the .rrd file; replaced atomically.
        rows: figures by name, one mapping an episode, ``episode`` among them.
        driven: states of each episode (T + 1, 6).
        predictions: of the prediction windows of each episode the ticks (S, N), and mean and standard deviation of
            the states there (S, N, 6).
        diagnoses: text of the quick check after each episode; empty without a check.

    Raises:
        DataError: it cannot be written; an existing file is unchanged.
    """
    with rerun_file(path, recording_id=path.parent.name) as stream:
        texts = diagnoses or [""] * len(rows)
        before = 0
        for row, states, (ticks, mean, std), text in zip(rows, driven, predictions, texts, strict=True):
            stream.set_time("episode", sequence=int(row["episode"]))
            for name, value in row.items():
                if name != "episode" and np.isfinite(value):
                    stream.log(f"learning/{name}", rr.Scalars(float(value)))
            if text:
                stream.log("diagnosis", rr.TextLog(text, level=rr.TextLogLevel.INFO))
            stream.log("plan/driven", rr.LineStrips2D([states[:, :2]], colors=[(0, 0, 0)]))
            stream.log("plan/predicted", rr.LineStrips2D(list(mean[..., :2]), colors=[(230, 130, 0)]))
            centers, half_sizes = mean[..., :2].reshape(-1, 2), 2.0 * std[..., :2].reshape(-1, 2)
            stream.log("plan/predicted/two_std", rr.Ellipses2D(centers=centers, half_sizes=half_sizes))
            for k, name in enumerate(STATE_NAMES):
                measured, predicted = states[:, k], mean[..., k]
                if name == "yaw" and len(ticks):
                    measured, predicted = align_unwrapped(measured, ticks[:, 0], predicted)
                _series(stream, f"states/{name}/measured", before + np.arange(len(states)), measured[:, None])
                if len(ticks):
                    center, half_width = predicted[:, 1:].ravel(), 2.0 * std[:, 1:, k].ravel()
                    band = np.stack([center, center - half_width, center + half_width], axis=1)
                    _series(stream, f"states/{name}/predicted", before + ticks[:, 1:].ravel(), band)
            before += len(states)


def _series(stream: rr.RecordingStream, entity: str, ticks: np.ndarray, values: FloatArray) -> None:
    """Curves (n, curves) over the ticks of all episodes, one after the other."""
    each = np.full(len(values), values.shape[1])
    columns = rr.Scalars.columns(scalars=values.ravel()).partition(each)
    stream.send_columns(entity, indexes=[rr.TimeColumn("tick", sequence=ticks)], columns=columns)


__all__ = ["write_learning_curve"]
