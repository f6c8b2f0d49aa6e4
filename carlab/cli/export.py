"""``carlab export``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from carlab.cli.console import console
from carlab.cli.recordings import load_episodes
from carlab.core.errors import ConfigError, DataError


@dataclass
class Export:
    """Write a recording as CSV (t,x,y,yaw,vx,vy,yaw_rate,steering,throttle in SI units) or Parquet."""

    recording: Positional[Path]
    """An MCAP (finished or .partial)."""

    out: Path
    """FILE.csv, FILE.csv.gz or FILE.parquet."""

    verbose: bool = False
    """Show the whole log."""

    def run(self) -> int:
        """Read and write."""
        from carlab.recording.csv.export import write_csv, write_parquet

        name = self.out.name.lower()
        if not name.endswith((".csv", ".csv.gz", ".parquet")):
            raise ConfigError(f"--out {self.out}: name a .csv, .csv.gz or .parquet file.")
        if self.out.exists():
            raise DataError(f"{self.out} is there already; remove it or choose another --out.")
        episodes = load_episodes(self.recording)
        if len(episodes) > 1:
            raise DataError(f"{self.recording} holds {len(episodes)} episodes; import it and export one of them.")
        (write_parquet if name.endswith(".parquet") else write_csv)(episodes[0], self.out)
        console.print(f"{self.out}: {episodes[0].ticks + 1} rows")
        return 0
