"""``carlab import``."""

from __future__ import annotations

import json
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tyro.conf import Positional

from carlab.api.recordings import is_csv, required_file, resolved_mapping
from carlab.cli.console import console
from carlab.cli.options import new_file
from carlab.cli.recordings import print_findings
from carlab.core.errors import ConfigError

if TYPE_CHECKING:
    from carlab.recording.column_mapping import ColumnMapping

Sign = Literal[1, -1]
NOT_OF_THE_MAPPING = ("recording", "out", "mapping", "report", "verbose")


@dataclass
class Import:
    """Turn a foreign CSV (.csv, .csv.gz) into an MCAP recording, and say what is wrong with it.

    Known layouts are recognised by their header; others need --mapping. What is declared is converted; what is merely
    detected is reported with the option that would act on it, and nothing is guessed.
    """

    recording: Positional[Path]
    """The CSV file."""

    out: Path | None = None
    """The MCAP file to write; beside the CSV unless given. A recording that is split gets -1, -2 ... in the names."""

    mapping: Path | None = None
    """TOML file that says which column is which: tables [columns.x] with name, unit, sign, scale."""

    report: Path | None = None
    """Also write the findings as JSON."""

    velocity_frame: Literal["body", "world"] | None = None
    """Frame of the velocity columns."""

    velocity_lag: float | None = None
    """Known delay of the velocity columns behind the pose [s]."""

    velocities: Literal["columns", "pose"] | None = None
    """Take velocities from their columns, or estimate them from the pose."""

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
    """-1 where x counts the other way."""

    y_sign: Sign | None = None
    """-1 where y counts the other way."""

    yaw_sign: Sign | None = None
    """-1 where yaw counts clockwise."""

    yaw_rate_sign: Sign | None = None
    """-1 where the yaw rate counts clockwise."""

    yaw_rate_scale: float | None = None
    """Factor on the yaw rate."""

    vx_sign: Sign | None = None
    """-1 where vx counts backwards."""

    vy_sign: Sign | None = None
    """-1 where vy counts to the right."""

    steering_sign: Sign | None = None
    """-1 where positive steering turns right."""

    steering_scale: float | None = None
    """Factor on steering, to bring it into [-1, 1]."""

    throttle_sign: Sign | None = None
    """-1 where positive throttle drives backwards."""

    throttle_scale: float | None = None
    """Factor on throttle, to bring it into [-1, 1]."""

    yaw_offset: float | None = None
    """Added to yaw [rad]."""

    swap_xy: bool | None = None
    """Exchange x and y."""

    repair_yaw_rate: bool | None = None
    """Replace spikes of a wrapped-angle difference by the turn rate of the pose."""

    missing: Literal["error", "drop"] | None = None
    """Rows with a value missing: refuse, or leave them out."""

    gaps: Literal["error", "split", "keep"] | None = None
    """Gaps in time: refuse, split into episodes there, or keep one episode."""

    stamps: Literal["error", "drop"] | None = None
    """Stamps that do not increase: refuse, or leave those rows out."""

    clock: Literal["column", "velocity", "even"] | None = None
    """Take times from their column; rebuild each period from distance over speed where the column was made up later;
    or put rows on an even clock where they are frames of a camera, stamped as they arrived."""

    command_lag: float | None = None
    """Known delay of the command columns behind the moment at which the commands were sent [s]."""

    rate: float | None = None
    """Row rate [Hz] of a file without a time column; needs --mapping."""

    verbose: bool = False
    """Show the whole log."""

    def run(self) -> int:
        """Import, report, write."""
        from carlab.recording.csv.foreign import import_csv
        from carlab.recording.mcap.sink import write_episode

        required_file(self.recording)
        if not is_csv(self.recording):
            raise ConfigError(f"{self.recording} is not a .csv or .csv.gz; carlab import reads those.")
        stem = self.recording.name.removesuffix(".gz").removesuffix(".csv")
        out = self.out if self.out is not None else self.recording.with_name(f"{stem}.mcap")
        new_file(out, "--out", ".mcap")
        imported = import_csv(self.recording, mapping=self._mapping())
        console.print(imported.announcement)
        print_findings(imported.report)
        if self.report is not None:
            self.report.write_text(json.dumps(imported.report.to_dict(), indent=2) + "\n", encoding="utf-8")
        many = len(imported.episodes) > 1
        for index, episode in enumerate(imported.episodes, start=1):
            path = out.with_name(f"{out.stem}-{index}{out.suffix}") if many else out
            new_file(path, "--out", ".mcap")
            path.parent.mkdir(parents=True, exist_ok=True)
            try:
                write_episode(episode, path)
            except KeyboardInterrupt:
                # Half an import is worth nothing: the CSV is still there.
                path.with_name(f"{path.name}.partial").unlink(missing_ok=True)
                raise
            seconds = episode.times_s[-1] - episode.times_s[0]
            console.print(f"{path}: {episode.ticks} commands, {seconds:.1f} s")
        return 0

    def _mapping(self) -> ColumnMapping | None:
        own = {f.name: getattr(self, f.name) for f in fields(self)}
        options = {name: value for name, value in own.items() if name not in NOT_OF_THE_MAPPING}
        return resolved_mapping(self.recording, self.mapping, options)
