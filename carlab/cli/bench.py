"""``carlab bench``."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from carlab.cli.console import console, table
from carlab.cli.options import above_zero


@dataclass
class Bench:
    """Measure how fast the parts are, as ratios taken in one run."""

    what: Positional[Literal["speed"]] = "speed"
    """speed: simulator, gradients, NatNet decoding, lateness of the command sender."""

    out: Path | None = None
    """Write the figures as JSON."""

    seconds: float = 10.0
    """Length of each condition of the sender's measurement [s]."""

    verbose: bool = False
    """Show the whole log."""

    def run(self) -> int:
        """Measure and print."""
        from carlab.experiment.speed import measure_speed

        above_zero(seconds=self.seconds)
        figures = measure_speed(seconds=self.seconds, note=lambda text: console.print(text))
        rows = [[part, name, f"{value:.4g}"] for part, values in figures.items() for name, value in _flat(values)]
        table("Speed", ["part", "figure", "value"], rows)
        if self.out is not None:
            self.out.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
            console.print(f"{self.out}")
        return 0


def _flat(values: object, prefix: str = "") -> list[tuple[str, float]]:
    if isinstance(values, dict):
        return [row for name, value in values.items() for row in _flat(value, f"{prefix}{name}  ")]
    return [(prefix.strip(), float(values))] if isinstance(values, (int, float)) else []
