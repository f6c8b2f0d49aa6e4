"""``carlab bench parking``."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, get_args

from carlab.cli.bench_output import command, write_figures
from carlab.cli.console import console, table
from carlab.core.errors import ConfigError

if TYPE_CHECKING:
    from carlab.cli.bench_options import BenchOptions
    from carlab.studies.parking import MethodFigures


def run_parking(options: BenchOptions) -> int:
    """Drive the missing runs of the study, and print the figures of all runs."""
    from carlab.cli.learn import Learn
    from carlab.cli.options import CarOptions
    from carlab.experiment.campaign.campaign import CAMPAIGN_FILE
    from carlab.studies.parking import as_json, check_run, draw, read_curve, run_folder, run_name, summarised
    from learning.world.car_fit import Method

    methods: tuple[Method, ...] = tuple(m for m in get_args(Method) if m in options.methods or not options.methods)
    if unknown := [m for m in options.methods if m not in get_args(Method)]:
        raise ConfigError(f"There is no method '{unknown[0]}'; choose among {', '.join(get_args(Method))}.")
    begun = {}
    for seed, method in itertools.product(range(options.seeds), methods):
        done = run_folder(options.runs, method, seed)
        if done is not None and (done / CAMPAIGN_FILE).is_file():
            expected = {
                "method": ("--methods", method), "updates": ("--updates", options.updates),
                "model_steps": ("--steps", options.steps),
            }  # fmt: skip
            check_run(done, expected)
            begun[(seed, method)] = done
    folders = []
    for seed in range(options.seeds):
        for method in methods:
            console.print(f"{method}, seed {seed}")
            code = Learn(
                CarOptions("sim"), episodes=options.episodes, updates=options.updates, method=method,
                model_steps=options.steps, seed=seed, device=options.device,
                resume=begun.get((seed, method)), out=options.runs,
                name=run_name(method, seed), rerun=False,
            ).run()  # fmt: skip
            if code != 0:
                return code
            folder = run_folder(options.runs, method, seed)
            assert folder is not None
            folders.append(folder)
    curves = [read_curve(folder) for folder in sorted(folders, key=lambda f: methods.index(read_curve(f).method))]
    table(
        f"Parking, simulated car, {options.seeds} seeds",
        [
            "method",
            "first parked in episode",
            "median",
            "parked in the last five",
            "seconds\nan episode",
            "minutes\na run",
        ],
        [_row(row) for row in summarised(curves)],
    )
    if options.out is not None:
        write_figures(options.out, as_json(curves, command()))
        picture = options.out.with_suffix(".png")
        draw(curves, picture)
        console.print(f"{options.out}, {picture}, {options.runs}")
    return 0


def _row(row: MethodFigures) -> list[str]:
    first = ", ".join("never" if f is None else str(f) for f in row.first_parked)
    median = "never" if row.median_first_parked == float("inf") else f"{row.median_first_parked:g}"
    return [
        row.method,
        first,
        median,
        f"{row.parked_at_last:.0%}",
        f"{row.seconds_an_episode:.0f}",
        f"{row.minutes:.0f}",
    ]
