"""``carlab bench parking``."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from carlab.cli.bench_output import command, write_figures
from carlab.cli.console import console, table
from carlab.core.errors import ConfigError

if TYPE_CHECKING:
    from carlab.cli.bench_options import BenchOptions
    from carlab.studies.parking import Curve, MethodFigures
    from carlab.studies.parking_realities import ArmFigures


@dataclass(frozen=True, slots=True)
class _Run:
    """One run of the study: a method (or arm) with its options of ``carlab learn``, a seed, and a reality."""

    method: str
    seed: int
    options: dict[str, Any]
    reality: str = ""

    @property
    def label(self) -> str:
        """Method and reality."""
        return f"{self.method}-{self.reality}" if self.reality else self.method


def run_parking(options: BenchOptions) -> int:
    """Drive the missing runs of the study, and print the figures of all runs."""
    from carlab.cli.learn import Learn
    from carlab.cli.options import CarOptions
    from carlab.experiment.campaign.campaign import CAMPAIGN_FILE
    from carlab.studies.parking import check_run, read_curve, run_folder, run_name
    from carlab.studies.parking_realities import write_reality

    runs = _runs(options)
    begun = {}
    for run in runs:
        done = run_folder(options.runs, run.label, run.seed)
        if done is not None and (done / CAMPAIGN_FILE).is_file():
            expected = {"updates": ("--updates", options.updates), "model_steps": ("--steps", options.steps)}
            if "method" in run.options:
                expected["method"] = ("--methods", run.options["method"])
            check_run(done, expected)
            begun[run.label, run.seed] = done
    curves = []
    for run in runs:
        console.print(f"{run.label}, seed {run.seed}")
        reality = write_reality(run.reality, options.runs / "realities") if run.reality else None
        code = Learn(
            CarOptions("sim", reality=reality), episodes=options.episodes, updates=options.updates,
            model_steps=options.steps, seed=run.seed, device=options.device,
            resume=begun.get((run.label, run.seed)), out=options.runs,
            name=run_name(run.label, run.seed), rerun=False, **run.options,
        ).run()  # fmt: skip
        if code != 0:
            return code
        folder = run_folder(options.runs, run.label, run.seed)
        assert folder is not None
        curves.append(replace(read_curve(folder), method=run.method, reality=run.reality))
    names = list(dict.fromkeys(run.method for run in runs))
    _report(sorted(curves, key=lambda c: names.index(c.method)), options)
    return 0


def _runs(options: BenchOptions) -> list[_Run]:
    """All runs of the study, seed by seed."""
    from carlab.studies.parking_realities import ARMS, REALITIES, arm_of
    from learning.world.car_fit import Method

    seeds = range(options.seeds)
    if options.realities is not None:
        if not 0 < options.realities <= len(REALITIES):
            raise ConfigError(f"--realities {options.realities}: give a number from 1 to {len(REALITIES)}.")
        arms = {name: arm_of(name) for name in options.methods or ARMS}
        names = list(REALITIES)[: options.realities]
        return [_Run(arm, s, arms[arm], reality) for s, reality, arm in itertools.product(seeds, names, arms)]
    methods = [m for m in get_args(Method) if m in options.methods or not options.methods]
    if unknown := [m for m in options.methods if m not in get_args(Method)]:
        raise ConfigError(f"There is no method '{unknown[0]}'; choose among {', '.join(get_args(Method))}.")
    return [_Run(method, seed, {"method": method}) for seed, method in itertools.product(seeds, methods)]


def _report(curves: list[Curve], options: BenchOptions) -> None:
    """Print the tables, and write the figures and the picture."""
    from carlab.studies.parking import as_json, draw, summarised
    from carlab.studies.parking_realities import compared

    cars = "simulated car" if options.realities is None else f"{options.realities} simulated cars"
    table(
        f"Parking, {cars}, {options.seeds} seeds",
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
    arms = [] if options.realities is None else compared(curves)
    if arms:
        columns = [
            *("arm", "runs", "first parked\n(mean)", "parked by\nepisode 4", "parked\nafter the first"),
            *("return in the\n90 % interval", "latest against\nnominal"),
        ]
        table("Cars that differ from the prior", columns, [_arm_row(row) for row in arms])
    if options.out is not None:
        content = as_json(curves, command())
        write_figures(options.out, content | ({"arms": [row.to_dict() for row in arms]} if arms else {}))
        picture: Path = options.out.with_suffix(".png")
        draw(curves, picture)
        console.print(f"{options.out}, {picture}, {options.runs}")


def _arm_row(row: ArmFigures) -> list[str]:
    shares = [f"{x:.0%}" for x in (row.parked_early, row.parked_after, row.coverage)]
    return [row.arm, str(row.runs), f"{row.mean_first_parked:.1f}", *shares, f"{row.latest_against_nominal:+.0f}"]


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
