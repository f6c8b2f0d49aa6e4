"""Import of a foreign CSV for those who would rather have it mended than refused: acts on the audit's own options."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from carlab.core.errors import DataError
from carlab.recording.audit.report import Finding, RefusedError
from carlab.recording.column_mapping import ColumnMapping, recognise_layout
from carlab.recording.csv.foreign import ImportedRecording, import_csv
from carlab.recording.csv.table import read_csv

_CHANNELS = ("x", "y", "yaw", "vx", "vy", "yaw_rate")
_KEPT = {"gaps": "keep", "missing": "drop", "stamps": "drop"}
_MOST_ROUNDS = 6


@dataclass(frozen=True, slots=True)
class MendedImport:
    """What came of a file, and the findings that would have refused it and were acted upon."""

    imported: ImportedRecording
    mended: tuple[Finding, ...]


def import_mended(path: Path | str, *, mapping: ColumnMapping | None = None) -> MendedImport:
    """Import a CSV; what would refuse it is mended where the audit knows how.

    Mended are units of pose and velocities, rows with a missing value or a stamp that does not increase (left out),
    and gaps in time (kept; ``segment`` in ``extra`` numbers the stretches).

    Raises:
        DataError: the file cannot be read, or something else is wrong with it.
    """
    mended: list[Finding] = []
    for _ in range(_MOST_ROUNDS):
        try:
            return MendedImport(import_csv(path, mapping=mapping), tuple(mended))
        except RefusedError as refused:
            if mapping is None:
                mapping = recognise_layout(read_csv(path).header, Path(path).name)
            for finding in refused.findings:
                changed = None if finding.option is None else _with_option(mapping, finding.option)
                if changed is None or changed == mapping:
                    raise
                mapping = changed
                mended.append(finding)
    raise DataError(f"{path} has more faults than can be mended one after another; import it with carlab import.")


def _with_option(mapping: ColumnMapping, option: str) -> ColumnMapping | None:
    """The mapping with an option as the audit writes it, ``--yaw-unit deg``; None where it is not safe to act on."""
    words = shlex.split(option)
    columns: dict[str, dict[str, Any]] = {}
    options: dict[str, Any] = {}
    for flag, value in zip(words[::2], words[1::2], strict=True):
        name = flag.removeprefix("--").replace("-", "_")
        channel, _, part = name.rpartition("_")
        if part == "unit" and channel in _CHANNELS:
            columns[channel] = {"unit": value}
        elif name in _KEPT:
            options[name] = _KEPT[name]
        else:
            return None
    return mapping.with_options(columns=columns, **options)
