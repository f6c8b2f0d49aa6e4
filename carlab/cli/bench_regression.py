"""``carlab bench regression``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from carlab.cli.bench_output import followed, told
from carlab.cli.console import console
from carlab.core.errors import ConfigError

if TYPE_CHECKING:
    from carlab.cli.bench import Bench
    from carlab.experiment.regression_recordings import RecordedCase


def run_regression(options: Bench) -> int:
    """Fit every method to few rows, and print; what was measured is kept after each fit."""
    from carlab.experiment.regression_study import run_study

    case = _recorded(options) if options.case == "realcar" else options.case
    scores, stopped = followed(
        lambda progress: run_study(
            case, rows=options.rows, seeds=options.seeds, methods=options.methods, way=options.way, data=options.data,
            steps=options.steps, device=options.device, progress=progress,
        ),
        options,
        options.case,
    )  # fmt: skip
    return told(scores, stopped, options, f"{options.case}, {options.seeds} seeds, {options.way}", "method")


def _recorded(options: Bench) -> RecordedCase:
    from carlab.cli.recordings import load_episodes
    from carlab.experiment.regression_recordings import recorded_case

    if options.data is None or not options.data.is_dir():
        given = "" if options.data is None else f" ('{options.data}' is none)"
        raise ConfigError(f"--case realcar needs --data FOLDER{given}, with two recordings (MCAP or CSV) at least.")
    files = sorted(p for p in options.data.iterdir() if p.name.endswith((".mcap", ".csv", ".csv.gz")))
    case = recorded_case([load_episodes(path) for path in files], options.car, options.history)
    console.print(f"{case.told} Held out: {files[-1].name}.", soft_wrap=True)
    return case
