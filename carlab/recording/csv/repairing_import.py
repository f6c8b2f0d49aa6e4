"""Import of a foreign CSV with automatic repair by the options that the audit proposes."""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

from carlab.core.errors import DataError
from carlab.recording.audit.report import Finding, RefusedError
from carlab.recording.column_mapping import ColumnMapping
from carlab.recording.csv.foreign import ImportedRecording, import_csv
from carlab.recording.csv.table import read_csv
from carlab.recording.layouts import recognise_layout

_CHANNELS = ("x", "y", "yaw", "vx", "vy", "yaw_rate")
_REPAIRS = {"gaps": ("keep",), "missing": ("drop", "hold"), "stamps": ("drop",)}
"""Safe values of options; of another proposed value, the first one is used."""
_MAX_ITERATIONS = 6


def import_repaired(path: Path | str, *, mapping: ColumnMapping | None = None) -> ImportedRecording:
    """Import a CSV as ``import_csv`` does, and repair errors for which the audit proposes a safe option.

    Repairs: declares the units of pose and velocities, drops rows with a missing value or a stamp that does not
    increase, holds the values between messages of different topics, and keeps gaps in time (``segment`` in ``extra``
    numbers the parts between them).

    Raises:
        DataError: the file cannot be read, or has an error without such a repair.
    """
    repaired: list[Finding] = []
    for _ in range(_MAX_ITERATIONS):
        try:
            return replace(import_csv(path, mapping=mapping), repaired=tuple(repaired))
        except RefusedError as refusal:
            if mapping is None:
                mapping = recognise_layout(read_csv(path).header, Path(path).name)
            before = mapping
            for finding in refusal.findings:
                repaired_mapping = None if finding.option is None else _with_option(mapping, finding.option)
                if repaired_mapping is None:
                    raise
                mapping = repaired_mapping
                repaired.append(finding)
            if mapping == before:
                raise
    raise DataError(f"{path} has too many faults for the automatic repair; import it with carlab import.")


def _with_option(mapping: ColumnMapping, option: str) -> ColumnMapping | None:
    """The mapping with an option of the audit (``--yaw-unit deg``); None if its automatic use is unsafe."""
    tokens = shlex.split(option)
    columns: dict[str, dict[str, Any]] = {}
    options: dict[str, Any] = {}
    for flag, value in zip(tokens[::2], tokens[1::2], strict=True):
        name = flag.removeprefix("--").replace("-", "_")
        channel, _, part = name.rpartition("_")
        if part == "unit" and channel in _CHANNELS:
            columns[channel] = {"unit": value}
        elif name in _REPAIRS:
            options[name] = value if value in _REPAIRS[name] else _REPAIRS[name][0]
        else:
            return None
    return mapping.with_options(columns=columns, **options)
