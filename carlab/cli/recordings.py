"""Recordings by path, whatever their format."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from carlab.cli.console import console, table
from carlab.cli.options import required_file
from carlab.core.episode_data import EpisodeData

if TYPE_CHECKING:
    from carlab.recording.audit_report import AuditReport
    from carlab.recording.csv_mapping import ColumnMapping

CSV_ENDS = (".csv", ".csv.gz")


def is_csv(path: Path) -> bool:
    """Whether the name says CSV."""
    return path.name.lower().endswith(CSV_ENDS)


def load_episodes(path: Path, mapping: ColumnMapping | None = None) -> Sequence[EpisodeData]:
    """Read an MCAP recording (one episode) or a CSV (one or several); what was found out about a CSV is printed."""
    required_file(path, "The recording")
    if is_csv(path):
        from carlab.recording.foreign_csv import import_csv

        imported = import_csv(path, mapping=mapping)
        console.print(imported.announcement)
        print_findings(imported.report)
        return imported.episodes
    from carlab.recording.mcap_source import read_episode

    episode = read_episode(path)
    if episode.metadata.get("recovered"):
        console.print(f"[yellow]{path} was never finished; {episode.ticks} complete ticks were recovered.[/yellow]")
    return [episode]


def print_findings(report: AuditReport) -> None:
    """Print an audit as a table, the gravest first."""
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
        table(
            f"What was found in {report.source}",
            ["severity", "finding", "channel", "rows", "what and remedy"],
            rows,
            numeric=False,
        )
