"""``carlab bench regression``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from carlab.cli.bench_output import report, run_and_write
from carlab.cli.console import console
from carlab.core.errors import ConfigError

if TYPE_CHECKING:
    from carlab.cli.bench_options import BenchOptions
    from carlab.studies.regression.recordings import RecordedCase


def run_regression(options: BenchOptions) -> int:
    """Fit every method to few rows, and print; the figures are written after each fit."""
    from carlab.studies.regression.study import run_study

    case = _recorded(options) if options.case == "realcar" else options.case
    scores, stopped = run_and_write(
        lambda progress: run_study(
            case, rows=options.rows, seeds=options.seeds, methods=options.methods, structure=options.structure,
            data=options.data, steps=options.steps, device=options.device, progress=progress,
        ),
        options,
        options.case,
    )  # fmt: skip
    structure = ", structured simulator for all methods" if options.structure else ""
    return report(scores, stopped, options, f"{options.case}, {options.seeds} seeds{structure}", "method")


def _recorded(options: BenchOptions) -> RecordedCase:
    from carlab.cli.recordings import load_episodes
    from carlab.studies.regression.recordings import recorded_case

    if options.data is None or not options.data.is_dir():
        given = "" if options.data is None else f" ('{options.data}' is not a folder)"
        raise ConfigError(f"--case realcar needs --data FOLDER{given}, with at least two recordings (MCAP or CSV).")
    files = sorted(p for p in options.data.iterdir() if p.name.endswith((".mcap", ".csv", ".csv.gz")))
    case = recorded_case([load_episodes(path) for path in files], options.car, options.history)
    console.print(f"{case.history_message} Held out: {files[-1].name}.", soft_wrap=True)
    return case
