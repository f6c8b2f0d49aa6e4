"""Rows of different topics, joined by holding the newest value of each column."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from carlab.core.errors import DataError
from carlab.core.quantities import FloatArray
from carlab.recording.audit.file_checks import MIN_ROWS
from carlab.recording.audit.report import Finding, Severity
from carlab.recording.column_mapping import POSE_CHANNELS, ColumnMapping
from carlab.recording.csv.table import ColumnTable
from carlab.recording.pose_velocity import BoolArray, IndexArray

MAX_HELD_S = 0.5
"""[s] Motor controllers stop the car when commands are older than this, so a value held longer may be wrong."""


def with_held_values(table: ColumnTable, mapping: ColumnMapping) -> tuple[ColumnTable, list[Finding]]:
    """Hold the newest value of each column in the rows with a pose; the other rows are removed.

    A row has a pose if it has a number in the column of x (of vx for dead reckoning), and in the columns of y and yaw
    if these have numbers in no other rows. A value at the time of a pose belongs to this pose. Poses before the first
    number of a column of the mapping, and after its last one, are removed too.

    Returns:
        The table with a number in each cell of the mapped columns, and a finding with the age of the held values.

    Raises:
        DataError: the poses are not sorted by time, a mapped column contains text, or fewer than three poses lie
            between the first and the last number of each column.
    """
    time = mapping.columns["t"]
    stamps_s = time.values("t", table.column(time.name))
    order = np.argsort(stamps_s, kind="stable")[: np.sum(~np.isnan(stamps_s))]
    times_s = stamps_s[order]
    gate = [mapping.throttle_gate] if mapping.throttle_gate else []
    names = [source.name for source in mapping.columns.values() if source.name in table.header] + gate
    mapped = {name: table.column(name)[order] for name in names}
    is_pose = _rows_with_pose(mapped, mapping)
    if np.any(np.diff(order[is_pose]) < 0):
        raise DataError(f"The times of the poses in {table.path.name} go back; sort its rows by time, or cut it there.")
    last_row = np.searchsorted(times_s, times_s, side="right") - 1
    all_columns = {name: column[order] for name, column in table.columns.items()}
    newest = {name: _newest_rows(column, last_row) for name, column in all_columns.items()}
    is_row = is_pose.copy()
    for name, column in mapped.items():
        last_s = np.max(times_s[~np.isnan(column)], initial=-np.inf)
        is_row &= (newest[name] >= 0) & (times_s <= last_s)
    rows = np.flatnonzero(is_row)
    if len(rows) < MIN_ROWS:
        sparse = min(mapped, key=lambda name: np.sum(np.isfinite(mapped[name])))
        raise DataError(
            f"{table.path.name} has {len(rows)} poses between the first and the last number of each mapped column, of "
            f"which '{sparse}' has the fewest numbers ({np.sum(np.isfinite(mapped[sparse]))}); check that poses and "
            "commands were recorded at the same time and by one clock."
        )
    n_poses = int(np.sum(np.isfinite(mapped[mapping.columns[_pose_channels(mapping)[0]].name])))
    columns = {name: np.where(newest[name] < 0, np.nan, c[newest[name]])[rows] for name, c in all_columns.items()}
    max_age_s = max(float(np.max(times_s[rows] - times_s[newest[name][rows]])) for name in mapped)
    return replace(table, columns=columns), [_finding(len(rows), n_poses, max_age_s)]


def _finding(n_rows: int, n_poses: int, max_age_s: float) -> Finding:
    """The number of poses with held values, of all poses, and the largest age of a value [s]."""
    sentence = f"Each of {n_rows} poses has the newest value of each column, which is at most {max_age_s:.3g} s old"
    if n_poses > n_rows:
        sentence += (
            f"; {n_poses - n_rows} poses that are incomplete, or before the first or after the last value of a column, "
            "were left out"
        )
    severity = Severity.REPAIRED if max_age_s <= MAX_HELD_S else Severity.WARNING
    return Finding("held_values", "pose, commands", severity, f"{sentence}.", n_rows, (), {"max_age_s": max_age_s})


def _pose_channels(mapping: ColumnMapping) -> tuple[str, ...]:
    return ("vx",) if mapping.dead_reckoning else POSE_CHANNELS


def _rows_with_pose(mapped: Mapping[str, FloatArray], mapping: ColumnMapping) -> BoolArray:
    """Rows (N,) with a number of each pose channel that has its numbers in the rows of the first one."""
    has_number = [np.isfinite(mapped[mapping.columns[channel].name]) for channel in _pose_channels(mapping)]
    of_same_rows = [rows for rows in has_number if not np.any(rows & ~has_number[0])]
    is_pose: BoolArray = np.logical_and.reduce(of_same_rows)
    return is_pose


def _newest_rows(column: FloatArray, last_row: IndexArray) -> IndexArray:
    """Index of the newest row with a number (N,): the row itself, or one at its time or before; -1 without one.

    ``last_row`` (N,) is the last row with the time of each row.
    """
    rows = np.arange(len(column))
    newest = np.maximum.accumulate(np.where(np.isnan(column), -1, rows))
    return np.where(np.isnan(column), newest[last_row], rows)
