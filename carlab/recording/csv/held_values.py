"""Rows of different topics, joined by holding the newest value of each column."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from carlab.core.errors import DataError
from carlab.core.quantities import FloatArray
from carlab.recording.audit.file_checks import MIN_ROWS
from carlab.recording.audit.report import Finding, Severity
from carlab.recording.column_mapping import ColumnMapping
from carlab.recording.csv.table import ColumnTable
from carlab.recording.pose_velocity import IndexArray

MAX_HELD_S = 0.5
"""[s] Motor controllers stop the car when commands are older than this, so a value held longer may be wrong."""


def with_held_values(table: ColumnTable, mapping: ColumnMapping) -> tuple[ColumnTable, list[Finding]]:
    """Hold the newest value of each column in the rows with a pose; the other rows are removed.

    A row has a pose if it has a number in the column of x (of vx for dead reckoning). Rows before the first number of
    a column of the mapping, and after its last one, are removed too.

    Returns:
        The table with a number in each cell of the mapped columns, and a finding with the age of the held values.

    Raises:
        DataError: fewer than three rows with a pose lie between the first and the last number of each column.
    """
    time = mapping.columns["t"]
    has_time = np.isfinite(table.column(time.name))
    all_columns = {name: column[has_time] for name, column in table.columns.items()}
    times_s = time.values("t", all_columns[time.name])
    pose = mapping.columns["vx" if mapping.dead_reckoning else "x"].name
    gate = [mapping.throttle_gate] if mapping.throttle_gate else []
    mapped = {source.name for source in mapping.columns.values() if source.name in table.header} | set(gate)
    newest = {name: _newest_rows(column) for name, column in all_columns.items()}
    is_row = np.isfinite(table.column(pose)[has_time])
    for name in mapped:
        is_row &= (newest[name] >= 0) & (_rows_left(table.column(name)[has_time]) > 0)
    rows = np.flatnonzero(is_row)
    if len(rows) < MIN_ROWS:
        raise DataError(
            f"{table.path.name} has {len(rows)} poses between the first and the last number of each mapped column; "
            "check that poses and commands were recorded at the same time and by one clock."
        )
    columns = {name: np.where(newest[name] < 0, np.nan, c[newest[name]])[rows] for name, c in all_columns.items()}
    max_age_s = max(float(np.max(times_s[rows] - times_s[newest[name][rows]])) for name in mapped)
    finding = Finding(
        "held_values",
        "pose, commands",
        Severity.REPAIRED if max_age_s <= MAX_HELD_S else Severity.WARNING,
        f"Each of {len(rows)} poses has the newest command before it, which is at most {max_age_s:.3g} s old.",
        len(rows),
        evidence={"max_age_s": max_age_s},
    )
    return replace(table, columns=columns), [finding]


def _newest_rows(column: FloatArray) -> IndexArray:
    """Index of the newest row with a number, at or before each row (N,); -1 before the first one."""
    return np.maximum.accumulate(np.where(np.isnan(column), -1, np.arange(len(column))))


def _rows_left(column: FloatArray) -> IndexArray:
    """Number of rows with a number, at or after each row (N,)."""
    return np.cumsum(~np.isnan(column[::-1]))[::-1]
