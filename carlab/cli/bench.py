"""``carlab bench``."""

from __future__ import annotations

import importlib
from dataclasses import dataclass

from carlab.api.arguments import above_zero, at_least, at_most
from carlab.cli.bench_options import STUDIES, BenchOptions, check_options, row_counts
from carlab.cli.console import console, table
from carlab.cli.options import json_file
from carlab.core.errors import ConfigError
from carlab.core.seeds import MAX_SEED
from carlab.recording.atomic_files import write_json


@dataclass
class Bench(BenchOptions):
    """Run a study: speed of the components, models fitted to few rows, priors, parking, real cars or rollouts."""

    def run(self) -> int:
        """Measure and print."""
        from learning.devices import available

        if self.what is None:
            studies = "".join(f"\n  carlab bench {name}: {text}" for name, text in STUDIES.items())
            raise ConfigError(f"Name a study:{studies}")
        if not self.ray:
            available(self.device)
        if self.out is not None:
            json_file(self.out, "--out")
        check_options(self)
        if self.what == "speed":
            return self._speed()
        above_zero(
            seeds=self.seeds, jobs=self.jobs, steps=self.steps, episodes=self.episodes, updates=self.updates,
            **{"rows": min(counts)} if (counts := row_counts(self)) else {},
        )  # fmt: skip
        at_least(0, first_seed=self.first_seed)
        at_most(MAX_SEED + 1 - self.seeds, first_seed=self.first_seed)
        study = importlib.import_module(f"carlab.cli.bench_{self.what}")
        return int(getattr(study, f"run_{self.what}")(self))

    def _speed(self) -> int:
        from carlab.studies.speed import measure_speed

        above_zero(seconds=self.seconds)
        figures = measure_speed(seconds=self.seconds, device=self.device, note=console.print)
        rows = [[part, name, f"{value:.4g}"] for part, values in figures.items() for name, value in _flat(values)]
        table("Speed", ["part", "figure", "value"], rows)
        if self.out is not None:
            write_json(self.out, figures)
            console.print(str(self.out))
        return 0


def _flat(values: object, prefix: str = "") -> list[tuple[str, float]]:
    if isinstance(values, dict):
        return [row for name, value in values.items() for row in _flat(value, f"{prefix}{name}  ")]
    return [(prefix.strip(), float(values))] if isinstance(values, (int, float)) else []
