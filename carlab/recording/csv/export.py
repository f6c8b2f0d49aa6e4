"""Export of an episode as CSV or Parquet.

Columns: ``t,x,y,yaw,vx,vy,yaw_rate,steering,throttle`` in s, m, rad, m/s, rad/s (velocities in the body frame) and
commands in [-1, 1], sent at the row's time and held until the next row; then every extra column. The last row repeats
the last command, because no command follows it.
"""

from __future__ import annotations

import contextlib
import csv
import gzip
import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

import numpy as np

from carlab.core.episode_data import EpisodeData
from carlab.core.quantities import ACTION_NAMES, STATE_NAMES, STATE_UNITS, FloatArray
from carlab.recording.atomic_files import replaced_file
from carlab.recording.sink import make_folder

COLUMN_UNITS = {"t": "s", **dict(zip(STATE_NAMES, STATE_UNITS, strict=True)), **dict.fromkeys(ACTION_NAMES, "1")}
_UNIT_SUFFIXES = {"_s": "s", "_m": "m", "_rad": "rad", "_mps": "m/s", "_radps": "rad/s", "_hz": "1/s", "_v": "V"}


def table_of(episode: EpisodeData) -> dict[str, FloatArray]:
    """Columns by name, each (T + 1,); an extra column with the name of a standard one gets the prefix ``extra_``."""
    commands = np.vstack([episode.sent, episode.sent[-1:]]) if episode.ticks else np.full((1, 2), np.nan)
    columns: dict[str, FloatArray] = {"t": episode.times_s}
    columns |= {name: episode.states[:, k] for k, name in enumerate(STATE_NAMES)}
    columns |= {name: commands[:, k] for k, name in enumerate(ACTION_NAMES)}
    if episode.ticks and not np.array_equal(episode.requested, episode.sent, equal_nan=True):
        requested = np.vstack([episode.requested, episode.requested[-1:]])
        columns |= {f"requested_{name}": requested[:, k] for k, name in enumerate(ACTION_NAMES)}
    if not np.isnan(episode.rewards).all():
        columns["reward"] = np.append(episode.rewards, np.nan)
    for name, values in episode.extra.items():
        while name in columns:
            name = f"extra_{name}"
        columns[name] = values
    return columns


def unit_of(column: str) -> str:
    """Unit of a column by its name; an empty string if it is unknown."""
    if column in COLUMN_UNITS:
        return COLUMN_UNITS[column]
    if column.removeprefix("requested_") in ACTION_NAMES or column == "reward":
        return "1"
    return next((unit for suffix, unit in _UNIT_SUFFIXES.items() if column.endswith(suffix)), "")


def write_csv(episode: EpisodeData, path: Path | str) -> None:
    """Write an episode as CSV with round-trip precision and empty cells for NaN, replacing an existing file.

    A name that ends in ``.gz`` gives a compressed file; equal episodes give equal bytes.

    Raises:
        DataError: The file cannot be written.
    """
    path = Path(path)
    table = table_of(episode)
    with replaced_file(path) as partial:
        make_folder(path.parent)
        with _text_file(partial, compressed=path.suffix == ".gz") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(table)
            columns = [[repr(v) if v == v else "" for v in values.tolist()] for values in table.values()]
            writer.writerows(zip(*columns, strict=True))


@contextlib.contextmanager
def _text_file(path: Path, *, compressed: bool) -> Iterator[TextIO]:
    if compressed:
        # The gzip header has no time and no name, so that equal episodes give equal bytes.
        with (
            path.open("wb") as file,
            gzip.GzipFile(filename="", mode="wb", fileobj=file, mtime=0) as archive,
            io.TextIOWrapper(archive, encoding="utf-8", newline="") as text,
        ):
            yield text
    else:
        with path.open("w", newline="", encoding="utf-8") as text:
            yield text


def write_parquet(episode: EpisodeData, path: Path | str) -> None:
    """Write an episode as Parquet: float64 columns with their ``unit``, the episode's metadata under ``carlab``.

    Raises:
        DataError: The file cannot be written.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    path = Path(path)
    table = table_of(episode)
    fields = [pa.field(name, pa.float64(), metadata={"unit": unit_of(name)}) for name in table]
    schema = pa.schema(fields, metadata={"carlab": json.dumps(dict(episode.metadata))})
    with replaced_file(path) as partial:
        make_folder(path.parent)
        pq.write_table(pa.table(list(table.values()), schema=schema), partial)
