"""``carlab bench parking``."""

from __future__ import annotations

import itertools
import math
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, get_args

from carlab.cli.bench_jobs import StudyJob, reporting_job, run_jobs, uses_jobs
from carlab.cli.bench_options import BenchOptions
from carlab.cli.bench_output import command
from carlab.cli.console import console, fail, table
from carlab.cli.exit_codes import EXIT_FAILED, EXIT_INTERRUPTED
from carlab.cli.learn import Learn
from carlab.cli.options import CarOptions
from carlab.core.errors import ConfigError
from carlab.core.json_files import plain
from carlab.experiment.campaign.campaign import CAMPAIGN_FILE
from carlab.jobs.child_jobs import CARLAB, ChildJob, JobEnd, read_files, write_files
from carlab.jobs.child_processes import ONE_THREAD
from carlab.recording.atomic_files import write_json
from carlab.recording.run_folder import RunDirectory
from carlab.studies.parking import (
    Curve,
    MethodFigures,
    as_json,
    check_run,
    draw,
    read_curve,
    run_folder,
    run_name,
    summarised,
)
from carlab.studies.parking_realities import ARMS, REALITIES, ArmFigures, arm_of, compared, write_reality
from learning.world.car_fit import Method

RUNS = "runs"
"""Folder of the runs in the folder of a job."""
LOW_FIDELITY_PRIOR = "kinematic"
"""Prior of the comparison of methods, as in the paper: it differs from the simulated car."""


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

    @property
    def name(self) -> str:
        """Last part of the name of its folder."""
        return run_name(self.label, self.seed)


def run_parking(options: BenchOptions) -> int:
    """Drive the missing runs of the study, and print the figures of all runs."""
    runs = _runs(options)
    started = _started_runs(runs, options)
    code = _drive_as_jobs(runs, started, options) if uses_jobs(options) else _drive_here(runs, started, options)
    if code in (0, EXIT_FAILED) and (curves := _curves(runs, options)):
        _report(curves, options)
    return code


def _started_runs(runs: Sequence[_Run], options: BenchOptions) -> dict[str, Path]:
    """Folders of the runs that exist, by name. Raises ConfigError if one was started with other options."""
    started = {}
    for run in runs:
        folder = run_folder(options.runs, run.label, run.seed)
        if folder is not None and (folder / CAMPAIGN_FILE).is_file():
            expected = {"updates": ("--updates", options.updates), "model_steps": ("--steps", options.steps)}
            if "method" in run.options:
                expected["method"] = ("--methods", run.options["method"])
            check_run(folder, expected)
            started[run.name] = folder
    return started


def _drive_here(runs: Sequence[_Run], started: Mapping[str, Path], options: BenchOptions) -> int:
    """Start or resume the runs in this process; returns the exit code of the first that fails, or 0."""
    for run in runs:
        console.print(f"{run.label}, seed {run.seed}")
        reality = write_reality(run.reality, options.runs / "realities") if run.reality else None
        folder = started.get(run.name)
        place: dict[str, Any] = {"out": options.runs, "name": run.name} if folder is None else {"resume": folder}
        code = Learn(
            CarOptions("sim", reality=reality), episodes=options.episodes, updates=options.updates,
            model_steps=options.steps, seed=run.seed, device=options.device, rerun=False, **place, **run.options,
        ).run()  # fmt: skip
        if code != 0:
            return code
    return 0


def _drive_as_jobs(runs: Sequence[_Run], started: Mapping[str, Path], options: BenchOptions) -> int:
    """Start or resume the incomplete runs as parallel jobs; returns the exit code."""
    failures: list[str] = []

    def study_job(run: _Run) -> StudyJob[Path]:
        job = _job(run, started.get(run.name), options)
        return reporting_job(f"{run.label}, seed {run.seed}", job, lambda end: [_stored(end, options.runs)], failures)

    def is_complete(run: _Run) -> bool:
        return run.name in started and len(RunDirectory(started[run.name]).recordings()) >= options.episodes

    jobs = [study_job(run) for run in runs if not is_complete(run)]
    _, stopped = run_jobs(jobs, options, "runs", lambda new, done: None)
    if stopped:
        fail("Stopped; run the same command to continue.")
        return EXIT_INTERRUPTED
    return EXIT_FAILED if failures else 0


def _job(run: _Run, started: Path | None, options: BenchOptions) -> ChildJob:
    """A run as a job: ``carlab learn``, with a copy of the run's folder if it exists."""
    command = [*CARLAB, "learn", "--car", "sim", "--no-rerun", "--device", options.device]
    files: dict[str, bytes] = {}
    if run.reality:
        reality = write_reality(run.reality, options.runs / "realities")
        files[reality.name] = reality.read_bytes()
        command += ["--reality", reality.name]
    if started is None:
        command += ["--out", RUNS, "--name", run.name]
    else:
        files |= {f"{RUNS}/{name}": content for name, content in read_files(started.parent, started.name).items()}
        command += ["--resume", f"{RUNS}/{started.name}"]
    given = {"episodes": options.episodes, "updates": options.updates, "seed": run.seed}
    given |= run.options | ({} if options.steps is None else {"model-steps": options.steps})
    command += [word for name, value in given.items() for word in (f"--{name}", str(value))]
    return ChildJob(tuple(command), math.inf, files, (RUNS,), environment=ONE_THREAD)


def _stored(end: JobEnd, runs: Path) -> Path:
    """Write the run folder of an ended job to the runs of the study. Raises ValueError if the run is incomplete."""
    names = {Path(name).parts[1] for name in end.outputs}
    if end.end.exit_status != 0 or len(names) != 1:
        raise ValueError("the run is incomplete")
    folder = runs / names.pop()
    unfinished = folder.with_name(f".{folder.name}.partial")
    shutil.rmtree(unfinished, ignore_errors=True)
    write_files(unfinished, {str(Path(k).relative_to(RUNS, folder.name)): v for k, v in end.outputs.items()})
    shutil.rmtree(folder, ignore_errors=True)
    unfinished.replace(folder)
    return folder


def _curves(runs: Sequence[_Run], options: BenchOptions) -> list[Curve]:
    """Curves of the runs that exist, method by method; a longer run counts up to the last episode of the study."""
    names = list(dict.fromkeys(run.method for run in runs))
    folders = [(run, run_folder(options.runs, run.label, run.seed)) for run in runs]
    curves = [
        replace(read_curve(folder, options.episodes), method=run.method, reality=run.reality)
        for run, folder in folders
        if folder is not None
    ]
    return sorted(curves, key=lambda c: names.index(c.method))


def _runs(options: BenchOptions) -> list[_Run]:
    """All runs of the study, seed by seed."""
    seeds = options.all_seeds
    if options.realities is not None:
        if not 0 < options.realities <= len(REALITIES):
            raise ConfigError(f"--realities {options.realities}: give a number from 1 to {len(REALITIES)}.")
        arms = {name: arm_of(name) for name in options.methods or ARMS}
        names = list(REALITIES)[: options.realities]
        return [_Run(arm, s, arms[arm], reality) for s, reality, arm in itertools.product(seeds, names, arms)]
    methods = [m for m in get_args(Method) if m in options.methods or not options.methods]
    if unknown := [m for m in options.methods if m not in get_args(Method)]:
        raise ConfigError(f"There is no method '{unknown[0]}'; choose among {', '.join(get_args(Method))}.")
    return [_Run(m, seed, {"method": m, "prior": LOW_FIDELITY_PRIOR}) for seed, m in itertools.product(seeds, methods)]


def _report(curves: list[Curve], options: BenchOptions) -> None:
    """Print the tables, and write the figures and the picture."""
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
        write_json(options.out, content | ({"arms": [plain(asdict(row)) for row in arms]} if arms else {}))
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
