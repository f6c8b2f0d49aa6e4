"""Import of a foreign table: converts units, signs and axes by the mapping, and audits the columns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from carlab.core.episode_data import EpisodeData
from carlab.core.errors import ConfigError, DataError
from carlab.core.hashes import sha256_of
from carlab.core.planar import to_body
from carlab.core.quantities import FloatArray
from carlab.recording.audit.audit import Channels, audit_channels, check_heading
from carlab.recording.audit.file_checks import MIN_ROWS, check_jumps, check_missing, check_order, check_stamps
from carlab.recording.audit.report import AuditReport, Finding, Severity, raise_errors
from carlab.recording.column_mapping import (
    CHANNELS,
    MAX_LAG_SHARE,
    VELOCITY_CHANNELS,
    ColumnMapping,
    conversions,
    missing_columns,
)
from carlab.recording.csv.clocks import even_clock, with_rebuilt_clock
from carlab.recording.csv.held_values import with_held_values
from carlab.recording.csv.table import ColumnTable, read_csv
from carlab.recording.episode_builder import POSE_AGE
from carlab.recording.faults.robust import held_at
from carlab.recording.faults.stamps import gap_rows, segments
from carlab.recording.layouts import recognise_layout
from carlab.recording.pose_velocity import BoolArray, pose_jumps, pose_motion

SEGMENT = "segment"
"""Extra column of an episode with the numbers of the parts between gaps and jumps."""
CAPTURE_DECIMALS = 9
"""Decimals [s] of the capture times of poses: rows with the same pose have equal ones despite rounding."""


@dataclass(frozen=True, slots=True)
class ImportedRecording:
    """An imported file with its audit report.

    Attributes:
        episodes: one episode, or several if the file was split.
        report: findings of the audit.
        mapping: the mapping that was used.
        announcement: sentence about the recognised or declared layout and the conversions.
        repaired: findings that prevented the import before ``import_repaired`` repaired them.
    """

    episodes: tuple[EpisodeData, ...]
    report: AuditReport
    mapping: ColumnMapping
    announcement: str
    repaired: tuple[Finding, ...] = ()

    @property
    def episode(self) -> EpisodeData:
        """The only episode. Raises DataError if the recording was split into several."""
        if len(self.episodes) != 1:
            raise DataError(f"{self.report.source} was split into {len(self.episodes)} episodes; choose one of them.")
        return self.episodes[0]


def import_csv(path: Path | str, *, mapping: ColumnMapping | None = None) -> ImportedRecording:
    """Import a .csv or .csv.gz file as ``import_table`` does; by default the layout is recognised by the header.

    Raises:
        ConfigError: the mapping has an option for ROS bags.
        DataError: the file is not a CSV, or ``import_table`` refuses its table.
    """
    if mapping is not None and mapping.message_times != "auto":
        raise ConfigError("message_times is an option for ROS bags, and a CSV has a time column; remove it.")
    return import_table(read_csv(path), mapping=mapping)


def import_table(
    table: ColumnTable, *, mapping: ColumnMapping | None = None, findings: Sequence[Finding] = ()
) -> ImportedRecording:
    """Import a table by the meaning of its columns. ``findings`` are those of its reading.

    A command is sent at the time of its row and held until the next row: N rows give N states and N - 1 commands. The
    command of the last row is dropped. Times start at the first row. The row rate is unchanged.

    Raises:
        DataError: a column is missing, a cell is not a number, time does not increase or has
            gaps, undeclared units are evidently not SI, commands exceed [-1, 1], or the command lag is too long for
            the recording. Other findings are reported only.
    """
    source = table.path.name
    mapping, layout_note = _layout(table, mapping)
    if table.note:
        layout_note += f", {table.note}"
    findings = list(findings)
    if mapping.missing == "hold":
        table, new_findings = with_held_values(table, mapping)
        findings += new_findings
    values, extra, new_findings = _usable_rows(table, mapping)
    findings += new_findings
    origin_s = float(values["t"][0])
    t_s = values["t"] - origin_s
    findings += check_stamps(t_s, mapping)
    if mapping.clock == "even":
        t_s, new_findings = even_clock(t_s)
        findings += new_findings
    heading = [] if mapping.dead_reckoning else check_heading(t_s, values, mapping)
    findings += heading
    raise_errors(source, findings)

    channels, new_findings = _channels(t_s, values, extra, mapping)
    findings += new_findings
    new_findings, spikes = audit_channels(channels, mapping, heading)
    findings += new_findings
    raise_errors(source, findings)
    clock_notes: dict[str, str] = {}
    if mapping.clock == "velocity":
        channels, clock_notes["clock"] = with_rebuilt_clock(channels)
    states, notes = _states(channels, mapping, spikes)
    metadata = {
        "source": str(table.path),
        "source_sha256": sha256_of(table.path),
        "layout": mapping.layout,
        "task": "recorded",
        "time_origin_s": repr(origin_s),
        "units": "s, m, rad, m/s, rad/s; velocities in the body frame; commands in [-1, 1] held from their row on",
        **notes,
        **clock_notes,
    }
    episodes, new_findings = _episodes(states, channels, mapping, metadata)
    findings += new_findings
    announcement = f"{layout_note}; {conversions(mapping)}."
    return ImportedRecording(episodes, AuditReport(source, mapping.layout, tuple(findings)), mapping, announcement)


def _layout(table: ColumnTable, mapping: ColumnMapping | None) -> tuple[ColumnMapping, str]:
    """The mapping of the table and a note about its choice. Raises DataError if columns are missing."""
    source = table.path.name
    if mapping is None:
        mapping = recognise_layout(table.header, source)
        return mapping, f"{source}: recognised the {mapping.layout} layout by its header"
    missing = missing_columns(mapping, table.header)
    if missing:
        raise DataError(
            f"{source} has no column {', '.join(missing)}; it holds {', '.join(table.header)}; correct the mapping."
        )
    time = mapping.columns.get("t")
    if mapping.rate_hz is not None and time is not None and time.name in table.header:
        raise DataError(
            f"{source} has the time column '{time.name}'; remove --rate, or even out its stamps with --clock even."
        )
    return mapping, f"{source}: read with mapping '{mapping.layout}'"


def _usable_rows(
    table: ColumnTable, mapping: ColumnMapping
) -> tuple[dict[str, FloatArray], dict[str, FloatArray], list[Finding]]:
    """Channels, extra columns and findings of the rows with a number in each channel and an increasing stamp."""
    source = table.path.name
    findings = _text_column_findings(table, mapping)
    values, extra = _converted_columns(table, mapping)
    gate = {mapping.throttle_gate: table.column(mapping.throttle_gate)} if mapping.throttle_gate else {}
    new_findings, is_complete = check_missing({**values, **gate}, mapping)
    findings += new_findings
    raise_errors(source, findings)
    new_findings, is_increasing = check_order(values["t"][is_complete], mapping)
    findings += new_findings
    raise_errors(source, findings)
    usable_rows = np.flatnonzero(is_complete)[is_increasing]
    if len(usable_rows) < MIN_ROWS:
        raise DataError(f"{source} has too few usable rows ({len(usable_rows)}); a recording needs at least three.")
    usable_values, usable_extra = (
        {name: column[usable_rows] for name, column in columns.items()} for columns in (values, extra)
    )
    return usable_values, usable_extra, findings


def _converted_columns(
    table: ColumnTable, mapping: ColumnMapping
) -> tuple[dict[str, FloatArray], dict[str, FloatArray]]:
    """Channels converted to SI by the declared units, signs, axes and offset, and all other numeric columns."""
    values: dict[str, FloatArray] = {}
    if mapping.rate_hz is not None:
        values["t"] = np.arange(table.rows) / mapping.rate_hz
    for channel in CHANNELS:
        source = mapping.columns.get(channel)
        if source is not None and source.name in table.header and channel not in values:
            values[channel] = source.values(channel, table.column(source.name))
    if mapping.swap_xy:
        values["x"], values["y"] = values["y"], values["x"]
        if mapping.velocity_frame == "world" and "vx" in values and "vy" in values:
            values["vx"], values["vy"] = values["vy"], values["vx"]
    if "yaw" in values:
        values["yaw"] = values["yaw"] + mapping.yaw_offset_rad
    ignored = set(VELOCITY_CHANNELS).difference(mapping.velocity_columns(values))
    used = {source.name for channel, source in mapping.columns.items() if channel not in ignored}
    extra = {name: column for name, column in table.columns.items() if name not in used}
    return values, extra


def _text_column_findings(table: ColumnTable, mapping: ColumnMapping) -> list[Finding]:
    used = {source.name for source in mapping.columns.values()}
    return [
        Finding(
            "text_column",
            name,
            Severity.INFO,
            f"Column '{name}' contains text ({cell!r} in row {row}) and is dropped: extra columns must be numbers.",
            1,
            (row,),
        )
        for name, (row, cell) in table.texts.items()
        if name not in used
    ]


def _channels(
    t_s: FloatArray, values: Mapping[str, FloatArray], extra: Mapping[str, FloatArray], mapping: ColumnMapping
) -> tuple[Channels, list[Finding]]:
    gaps = gap_rows(t_s)
    if mapping.dead_reckoning:
        return Channels(t_s, values, extra, segments(len(t_s), gaps), None), []
    pose = (values["x"], values["y"], values["yaw"])
    jumps = np.setdiff1d(pose_jumps(t_s, *pose), gaps)
    segment = segments(len(t_s), np.union1d(gaps, jumps))
    motion = pose_motion(t_s, *pose, segment)
    return Channels(t_s, values, extra, segment, motion), check_jumps(t_s, values, jumps, mapping)


def _states(channels: Channels, mapping: ColumnMapping, spikes: BoolArray) -> tuple[FloatArray, dict[str, str]]:
    """States (N, 6) with velocities in the body frame, and notes about their sources."""
    t_s, values, motion = channels.t_s, channels.values, channels.motion
    if motion is None:
        return _dead_reckoned(t_s, values["vx"], values["yaw_rate"]), {
            "pose_source": "dead reckoning from the vx and yaw_rate columns with vy = 0: not measured",
            "velocity_source": "columns",
        }
    pose = [values["x"], values["y"], values["yaw"]]
    columns = mapping.velocity_columns(values)
    lag = mapping.velocity_lag_s
    own = pose_motion(t_s, values["x"], values["y"], values["yaw"], channels.segment, for_states=True)
    sources, vx, vy, yaw_rate = [], own.vx, own.vy, own.yaw_rate
    if "vx" in columns:
        vx, vy = values["vx"], values["vy"]
        sources.append(f"vx, vy: columns in the {mapping.velocity_frame} frame")
        if mapping.velocity_frame == "world":
            vx, vy = to_body(vx, vy, np.interp(t_s - lag, t_s, motion.yaw_unwrapped))
            sources[-1] += f", rotated by the yaw of {lag * 1e3:.1f} ms before"
    else:
        sources.append(f"vx, vy: {own.method()}")
    if "yaw_rate" in columns:
        yaw_rate = values["yaw_rate"]
        sources.append("yaw_rate: column")
        if mapping.repair_yaw_rate and spikes.any():
            yaw_rate = np.where(spikes, np.interp(t_s - lag, t_s, motion.yaw_rate), yaw_rate)
            sources[-1] += f", {int(spikes.sum())} rows of wrap spikes taken from the pose"
    else:
        sources.append(f"yaw_rate: {own.method()}")
    notes = {"velocity_source": "; ".join(sources), "velocity_delay_s": f"{lag if columns else 0.0:.6g}"}
    return np.column_stack([*pose, vx, vy, yaw_rate]), notes


def _dead_reckoned(t_s: FloatArray, vx: FloatArray, yaw_rate: FloatArray) -> FloatArray:
    """Integrate speed and yaw rate, held over each period, with the heading at mid-period. Returns states (N, 6)."""
    step_s = np.diff(t_s)
    yaw = np.concatenate([[0.0], np.cumsum(yaw_rate[:-1] * step_s)])
    mid_yaw = 0.5 * (yaw[1:] + yaw[:-1])
    x = np.concatenate([[0.0], np.cumsum(vx[:-1] * step_s * np.cos(mid_yaw))])
    y = np.concatenate([[0.0], np.cumsum(vx[:-1] * step_s * np.sin(mid_yaw))])
    return np.column_stack([x, y, yaw, vx, np.zeros_like(vx), yaw_rate])


def _episodes(
    states: FloatArray, channels: Channels, mapping: ColumnMapping, metadata: Mapping[str, str]
) -> tuple[tuple[EpisodeData, ...], list[Finding]]:
    t_s = channels.t_s
    requested, sent, findings = _commands(channels, mapping)
    parts, row_findings = _episode_rows(channels.segment, mapping)
    extra, extra_findings = _extra_columns(channels, mapping)
    ages_s = extra.get(POSE_AGE)
    episodes = []
    for part in parts:
        times = t_s[part]
        captured_s = times if ages_s is None else np.round(times - ages_s[part], CAPTURE_DECIMALS)
        poses = np.column_stack([captured_s, states[part, :3]])
        is_pose = np.isfinite(captured_s) & (channels.motion is not None)
        last = slice(part.start, part.stop - 1)
        episodes.append(
            EpisodeData(
                times_s=times,
                states=states[part],
                requested=requested[last],
                sent=sent[last],
                rewards=np.full(len(times) - 1, np.nan),
                poses=poses[is_pose],
                metadata={**metadata, "rows": f"{part.start + 1} to {part.stop}"},
                extra={name: column[part] for name, column in extra.items()},
            )
        )
    return tuple(episodes), findings + row_findings + extra_findings


def _extra_columns(channels: Channels, mapping: ColumnMapping) -> tuple[dict[str, FloatArray], list[Finding]]:
    """Extra columns by name, each (N,), with ``segment`` if an episode has several parts.

    Readers of episodes do not join rows of different ``segment``, so a column of the file with this name gets another.
    """
    extra = dict(channels.extra)
    findings = []
    if SEGMENT in extra and not np.array_equal(extra[SEGMENT], channels.segment):
        name = f"{SEGMENT}_of_file"
        while name in extra:
            name += "_"
        extra[name] = extra.pop(SEGMENT)
        sentence = (
            f"Column '{SEGMENT}' is renamed '{name}': in a recording, '{SEGMENT}' numbers the parts between gaps and "
            "jumps."
        )
        findings.append(Finding("renamed_column", SEGMENT, Severity.INFO, sentence))
    if mapping.gaps != "split" and np.ptp(channels.segment) > 0:
        extra[SEGMENT] = channels.segment
    return extra, findings


def _commands(channels: Channels, mapping: ColumnMapping) -> tuple[FloatArray, FloatArray, list[Finding]]:
    """Requested and sent commands (N, 2), and findings about their conversion."""
    t_s = channels.t_s
    requested = np.column_stack([channels.values["steering"], channels.values["throttle"]])
    sent = requested.copy()
    if mapping.throttle_gate:
        sent[:, 1] *= channels.extra[mapping.throttle_gate]
    if not mapping.command_lag_s:
        return requested, sent, []
    duration_s = float(t_s[-1] - t_s[0])
    if abs(mapping.command_lag_s) > MAX_LAG_SHARE * duration_s:
        raise DataError(
            f"The command lag of {mapping.command_lag_s:g} s exceeds {MAX_LAG_SHARE:.0%} of the "
            f"recording ({duration_s:.3g} s); import a longer recording, or change it with --command-lag (0: no shift)."
        )
    requested, sent = (
        np.column_stack([held_at(t_s, column, -mapping.command_lag_s) for column in table.T])
        for table in (requested, sent)
    )
    finding = Finding(
        "column_shift",
        "steering, throttle",
        Severity.REPAIRED,
        f"By the mapping, commands were logged {mapping.command_lag_s * 1e3:.0f} ms after they were sent; they were "
        "shifted by this lag.",
        len(t_s),
        evidence={"lag_s": mapping.command_lag_s},
    )
    return requested, sent, [finding]


def _episode_rows(segment: FloatArray, mapping: ColumnMapping) -> tuple[list[slice], list[Finding]]:
    """Rows of each episode: all rows, or the parts of ``segment`` (N,) if the mapping splits at gaps."""
    numbers = np.unique(segment)
    if mapping.gaps != "split" or len(numbers) == 1:
        return [slice(0, len(segment))], []
    bounds = [*(int(np.argmax(segment == n)) for n in numbers), len(segment)]
    ranges = [slice(first, end) for first, end in pairwise(bounds)]
    parts = [part for part in ranges if part.stop - part.start >= 2]
    isolated = [part for part in ranges if part.stop - part.start < 2]
    if not parts:
        raise DataError("A gap or a pose jump separates every row from the next; check the time column.")
    if not isolated:
        return parts, []
    finding = Finding(
        "short_part",
        "t",
        Severity.INFO,
        f"{len(isolated)} rows are isolated between two breaks and have no transition; they were dropped.",
        len(isolated),
        tuple(part.start + 1 for part in isolated[:20]),
    )
    return parts, [finding]
