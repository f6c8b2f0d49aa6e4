"""Recordings that verbs read, with what was found in them printed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from carlab.api.recordings import Recording, load
from carlab.cli.console import console, table
from carlab.core.episode_data import EpisodeData
from carlab.core.errors import ConfigError, DataError

if TYPE_CHECKING:
    from carlab.diagnosis.findings import FitErrors
    from carlab.recording.audit.report import AuditReport


MIN_TABLE_CHARS = 80
"""Width of the terminal below which findings are printed as paragraphs."""


def recordings_in(folder: Path, min_count: int = 2) -> list[Path]:
    """Recordings of a folder, sorted by name. Raises ConfigError or DataError for fewer than ``min_count``."""
    if not folder.is_dir():
        raise ConfigError(f"--data {folder} is not a folder; name a folder with recordings (MCAP or CSV).")
    files = sorted(p for p in folder.iterdir() if p.name.endswith((".mcap", ".csv", ".csv.gz")))
    if len(files) < min_count:
        raise DataError(f"{folder} has {len(files)} recordings; add some (at least {min_count}).")
    return files


def load_episodes(path: Path) -> Sequence[EpisodeData]:
    """Read an MCAP recording (one episode) or a CSV (one or several), and print what was found in it."""
    return print_recording(load(path)).episodes


def print_recording(recording: Recording) -> Recording:
    """Print what was found in a recording, and return it."""
    if recording.audit is not None:
        console.print(recording.announcement)
        print_findings(recording.audit)
    if recording.is_recovered:
        console.print(f"{recording.path} {recording.recovery}.", style="yellow")
    return recording


def print_findings(report: AuditReport) -> None:
    """Print an audit, the gravest finding first: as a table, or as paragraphs in a narrow terminal."""
    if report.findings:
        rows = [
            [
                severity,
                identity,
                channel,
                str(count) if count else "",
                sentence + (f"  {option}" if option and option not in sentence else ""),
            ]
            for severity, identity, channel, count, sentence, option in report.rows()
        ]
        title = f"What was found in {report.source}"
        if console.width < MIN_TABLE_CHARS:
            console.print(f"\n{title}")
            for severity, identity, channel, count, sentence in rows:
                in_rows = f", {count} rows" if count else ""
                console.print(f"{severity}: {identity} of {channel}{in_rows}\n{sentence}")
            return
        columns = ["severity", "finding", "channel", "rows", "what and remedy"]
        table(title, columns, rows, numeric=False)


def print_errors(title: str, first_column: str, errors: Mapping[str, FitErrors]) -> None:
    """Print errors after a horizon as a table, one row per model."""
    figures = ("position_m", "yaw_rad", "vx", "vy", "yaw_rate")
    rows = [
        [name.replace("_", " "), *(f"{getattr(e, k):.4f}" for k in figures), f"{e.score:.2f}"]
        for name, e in errors.items()
    ]
    columns = [first_column, "position [m]", "yaw [rad]", "vx [m/s]", "vy [m/s]", "yaw rate [rad/s]", "score"]
    table(title, columns, rows)
