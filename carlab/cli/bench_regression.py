"""``carlab bench regression``."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from carlab.cli.bench_jobs import DATA, StudyJob, bench_job, recorded_files, run_study_parts
from carlab.cli.bench_options import BenchOptions, row_counts
from carlab.cli.bench_output import load_case, report, score_job, write_scores
from carlab.cli.recordings import recordings_in
from carlab.core.errors import ConfigError
from carlab.studies.regression.cases import CASES
from carlab.studies.regression.recordings import RecordedCase
from carlab.studies.regression.scores import Score
from carlab.studies.regression.study import plan_study, run_study


def run_regression(options: BenchOptions) -> int:
    """Fit every method to few rows, and print; the figures are written after each fit."""
    case: str | RecordedCase = options.case
    if options.case == "realcar":
        case, _ = load_case(_recordings(options), options.car, options.history)
    scores, stopped = run_study_parts(
        lambda progress, stop: run_study(
            case, rows=row_counts(options), seeds=options.seeds, first_seed=options.first_seed, methods=options.methods,
            structure=options.structure, data=options.data, steps=options.steps, device=options.device,
            progress=progress,
        ),
        lambda: _jobs(options, case),
        options,
        options.case,
        partial(write_scores, options=options),
    )  # fmt: skip
    structure = ", structured simulator for all methods" if options.structure else ""
    return report(scores, stopped, options, f"{options.case}, {options.seeds} seeds{structure}", "method")


def _jobs(options: BenchOptions, case: str | RecordedCase) -> list[StudyJob[Score]]:
    """One job for each fit."""
    plan = plan_study(
        case,
        rows=row_counts(options),
        seeds=options.all_seeds,
        methods=options.methods,
        structure=options.structure,
        data=options.data,
    )
    given = ["--case", options.case, *(["--structure"] if options.structure else [])]
    files: dict[str, bytes] = {}
    if not isinstance(case, str):
        recorded, files = recorded_files(_recordings(options), options.car, case.rows.history)
        given += recorded
    elif options.data is not None:
        given += ["--data", DATA]
    jobs = []
    for fit in plan.fits:
        more = dict(files)
        if isinstance(case, str) and options.data is not None:
            arrays = CASES[case].arrays_file(fit.rows, fit.seed)
            more[f"{DATA}/{arrays}"] = (options.data / arrays).read_bytes()
        job = bench_job(options, fit.rows, fit.seed, [*given, "--methods", fit.method], more)
        jobs.append(score_job(job, options.case, fit.rows, fit.seed, [fit.method]))
    return jobs


def _recordings(options: BenchOptions) -> list[Path]:
    """Recordings of --case realcar, the last one held out."""
    if options.data is None:
        raise ConfigError("--case realcar needs --data FOLDER, with at least two recordings (MCAP or CSV).")
    return recordings_in(options.data)
