"""``carlab import``."""

from __future__ import annotations

import json
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from carlab.api.recordings import import_foreign, is_foreign, required_file, resolved_mapping
from carlab.cli.console import console
from carlab.cli.options import new_file, options_of
from carlab.cli.recordings import print_findings
from carlab.core.errors import ConfigError, DataError
from carlab.recording.atomic_files import write_json
from carlab.recording.column_mapping import ColumnMapping

if TYPE_CHECKING:
    from carlab.recording.audit.report import AuditReport

Sign = Literal[1, -1]
OTHER_OPTIONS = ("recording", "out", "mapping", "report", "verbose")


@dataclass
@options_of(ColumnMapping)
class Import:
    """Convert a CSV of another program or a ROS bag to an MCAP recording, and report its data faults.

    Known layouts of a CSV are recognised by their header; others, and bags, need --mapping. Only what the layout, the
    mapping or an option declares is converted; suspected faults are reported with the option that corrects them.
    """

    recording: Positional[Path]
    """The CSV file (.csv, .csv.gz), or the ROS bag: a file (.bag, .db3, .mcap) or the folder of a ROS 2 bag."""

    out: Path | None = None
    """MCAP file to write; by default beside the recording. A split recording has -1, -2 ... in its file names."""

    mapping: Path | None = None
    """TOML file with the columns: tables [columns.x] with name, unit, sign, scale, neutral."""

    report: Path | None = None
    """Also write the findings as JSON, with the reason if the import is refused. The report of a refused import is
    replaced."""

    velocity_frame: Literal["body", "world"] | None = None
    velocity_lag_s: Annotated[float | None, arg(name="velocity-lag")] = None
    velocities: Literal["columns", "pose"] | None = None

    t_unit: str | None = None
    """s, ms, us or ns."""

    x_unit: str | None = None
    """Unit of x: m, cm, mm."""

    y_unit: str | None = None
    """Unit of y."""

    yaw_unit: str | None = None
    """Unit of yaw: rad, deg."""

    yaw_rate_unit: str | None = None
    """Unit of the yaw rate: rad/s, deg/s."""

    vx_unit: str | None = None
    """Unit of vx: m/s, cm/s, mm/s, km/h."""

    vy_unit: str | None = None
    """Unit of vy."""

    vx_scale: float | None = None
    """Factor on vx."""

    vy_scale: float | None = None
    """Factor on vy."""

    x_sign: Sign | None = None
    """-1 if x has the opposite sign."""

    y_sign: Sign | None = None
    """-1 if y has the opposite sign."""

    yaw_sign: Sign | None = None
    """-1 if yaw is positive clockwise."""

    yaw_rate_sign: Sign | None = None
    """-1 if the yaw rate is positive clockwise."""

    yaw_rate_scale: float | None = None
    """Factor on the yaw rate."""

    vx_sign: Sign | None = None
    """-1 if vx is positive backwards."""

    vy_sign: Sign | None = None
    """-1 if vy is positive to the right."""

    steering_sign: Sign | None = None
    """-1 if positive steering turns right."""

    steering_scale: float | None = None
    """Factor on steering, to bring it into [-1, 1]."""

    steering_neutral: float | None = None
    """Value in the column at the command 0, for example 1500 for pulse widths in microseconds."""

    throttle_sign: Sign | None = None
    """-1 if positive throttle drives backwards."""

    throttle_scale: float | None = None
    """Factor on throttle, to bring it into [-1, 1]."""

    throttle_neutral: float | None = None
    """Value in the column at the command 0."""

    yaw_offset_rad: Annotated[float | None, arg(name="yaw-offset")] = None
    swap_xy: bool | None = None
    repair_yaw_rate: bool | None = None
    missing: Literal["error", "drop", "hold"] | None = None
    gaps: Literal["error", "split", "keep"] | None = None
    stamps: Literal["error", "drop"] | None = None
    clock: Literal["column", "velocity", "even"] | None = None
    command_lag_s: Annotated[float | None, arg(name="command-lag")] = None
    rate_hz: Annotated[float | None, arg(name="rate")] = None
    message_times: Literal["auto", "header", "received"] | None = None

    verbose: bool = False
    """Show the whole log."""

    def run(self) -> int:
        """Import the recording, print the findings, write the MCAP file."""
        from carlab.recording.audit.report import AuditReport, RefusedError
        from carlab.recording.mcap.sink import write_episode

        required_file(self.recording)
        if not is_foreign(self.recording):
            raise ConfigError(
                f"{self.recording} is neither a CSV nor a ROS bag; name a .csv, .csv.gz, .bag or .db3 file, an .mcap "
                "file of ROS 2, or the folder of a ROS 2 bag (with metadata.yaml)."
            )
        out = self.out if self.out is not None else self._default_out()
        new_file(out, "--out", ".mcap")
        if self.report is not None and not _is_report_of_refusal(self.report):
            new_file(self.report, "--report", ".json")
        try:
            imported = import_foreign(self.recording, self._mapping())
        except DataError as error:
            found = error.all_findings if isinstance(error, RefusedError) else ()
            self._write_report(AuditReport(self.recording.name, "", found, refusal=str(error)))
            raise
        console.print(imported.announcement)
        print_findings(imported.report)
        self._write_report(imported.report)
        n_episodes = len(imported.episodes)
        parts = [out.with_name(f"{out.stem}-{k + 1}{out.suffix}") for k in range(n_episodes)]
        paths = parts if n_episodes > 1 else [out]
        for path in paths:
            new_file(path, "--out", ".mcap")
        for path, episode in zip(paths, imported.episodes, strict=True):
            path.parent.mkdir(parents=True, exist_ok=True)
            try:
                write_episode(episode, path)
            except KeyboardInterrupt:
                # A partial import is useless; the source remains.
                path.with_name(f"{path.name}.partial").unlink(missing_ok=True)
                raise
            seconds = episode.times_s[-1] - episode.times_s[0]
            console.print(f"{path}: {episode.ticks} commands, {seconds:.1f} s")
        return 0

    def _default_out(self) -> Path:
        """Path of the MCAP file beside the recording; for an MCAP of ROS, with another name."""
        recording = self.recording if self.recording.name not in ("", "..") else self.recording.resolve()
        stem = recording.name if recording.is_dir() else recording.name.removesuffix(".gz").rpartition(".")[0]
        ending = "_carlab.mcap" if recording.name.endswith(".mcap") else ".mcap"
        return recording.with_name(f"{stem}{ending}")

    def _write_report(self, report: AuditReport) -> None:
        if self.report is not None:
            self.report.parent.mkdir(parents=True, exist_ok=True)
            write_json(self.report, report.to_dict())

    def _mapping(self) -> ColumnMapping | None:
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        options = {name: value for name, value in values.items() if name not in OTHER_OPTIONS}
        return resolved_mapping(self.recording, self.mapping, options)


def _is_report_of_refusal(path: Path) -> bool:
    """Whether a file is the report of a refused import, which the next import may replace."""
    from carlab.recording.audit.report import AUDIT_SCHEMA

    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(content, dict) and content.get("schema") == AUDIT_SCHEMA and content.get("refusal") is not None
