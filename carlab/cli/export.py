"""``carlab export``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from carlab.api.recordings import load
from carlab.cli.console import console
from carlab.cli.recordings import print_recording
from carlab.core.errors import ConfigError


@dataclass
class Export:
    """Write a recording as CSV (t,x,y,yaw,vx,vy,yaw_rate,steering,throttle in SI units) or Parquet."""

    recording: Positional[Path]
    """An MCAP (finished or .partial), or a CSV."""

    out: Path
    """FILE.csv, FILE.csv.gz or FILE.parquet."""

    verbose: bool = False
    """Show the whole log."""

    def run(self) -> int:
        """Read and write."""
        name = self.out.name.lower()
        if not name.endswith((".csv", ".csv.gz", ".parquet")):
            raise ConfigError(f"--out {self.out}: name a .csv, .csv.gz or .parquet file.")
        recording = print_recording(load(self.recording))
        recording.save(self.out)
        console.print(f"{self.out}: {recording.episode.ticks + 1} rows")
        return 0
