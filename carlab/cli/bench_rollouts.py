"""``carlab bench rollouts``."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path

from carlab.cars import load_car_file
from carlab.cli.bench_jobs import StudyJob, bench_job, read_figures, recorded_files, reporting_job, run_study_parts
from carlab.cli.bench_options import BenchOptions
from carlab.cli.bench_output import command, load_case
from carlab.cli.console import console, table
from carlab.cli.exit_codes import EXIT_FAILED, EXIT_INTERRUPTED
from carlab.cli.recordings import recordings_in
from carlab.core.episode_data import EpisodeData
from carlab.core.errors import ConfigError
from carlab.recording.atomic_files import write_json
from carlab.studies.regression.recordings import RecordedCase
from carlab.studies.rollouts import RolloutScore, Rows, as_json, checked_counts, run_rollout_study, scores_from_json

Recordings = Sequence[Sequence[EpisodeData]]


def run_rollouts(options: BenchOptions) -> int:
    """Fit learned cars and their disturbances, and print coverage and error of their rollouts."""
    if options.data is None:
        raise ConfigError("bench rollouts needs --data FOLDER with recordings of one car; add it.")
    files = recordings_in(options.data)
    case, recordings = load_case(files, options.car, options.history)
    failures: list[str] = []
    curves_from = load_car_file(options.car).simulator if options.curves else None
    scores, stopped = run_study_parts(
        lambda progress, stop: run_rollout_study(
            case, recordings, rows=options.rows, seeds=options.seeds, first_seed=options.first_seed,
            steps=options.steps, device=options.device, curves_from=curves_from,
            correct_simulator=options.particles == "simulator", progress=progress, stop=stop,
        ),
        lambda: _jobs(options, case, recordings, files, failures),
        options,
        "rollouts",
        lambda new, scores: _write(scores, options),
    )  # fmt: skip
    _print(scores, files[-1].name)
    if options.out is not None:
        console.print(f"{options.out}")
    if stopped:
        return EXIT_INTERRUPTED
    return EXIT_FAILED if failures else 0


def _jobs(
    options: BenchOptions, case: RecordedCase, recordings: Recordings, files: Sequence[Path], failures: list[str]
) -> list[StudyJob[RolloutScore]]:
    """One job for each number of rows and seed; ``failures`` receives the messages of failed ones."""
    more, contents = recorded_files(files, options.car, case.rows.history)
    more += ["--curves"] if options.curves else []
    more += ["--particles", options.particles]

    def job(rows: Rows, seed: int) -> StudyJob[RolloutScore]:
        command = bench_job(options, rows, seed, more, contents)
        return reporting_job(
            f"{rows} rows, seed {seed}", command, lambda end: scores_from_json(read_figures(end)), failures
        )

    counts = checked_counts(case, recordings, options.rows, with_curves=options.curves)
    return list(itertools.starmap(job, itertools.product(counts, options.all_seeds)))


def _write(scores: Sequence[RolloutScore], options: BenchOptions) -> None:
    if options.out is not None:
        write_json(options.out, as_json(scores, command()))


def _print(scores: Sequence[RolloutScore], held_out: str) -> None:
    columns = ["rows", "seed", "rollouts", "after [s]", "position rms [m]", "yaw rms [rad]", "energy score [m]",
               "ahead", "left", "yaw", "vx", "vy", "yaw rate", "one-step nll"]  # fmt: skip
    rows = [
        [f"{s.rows} (all)" if s.all_rows else str(s.rows), str(s.seed), s.model, f"{s.horizon_s:g}",
         f"{s.position_rms_m:.3f}", f"{s.yaw_rms_rad:.3f}", f"{s.energy_m:.4f}",
         *(f"{c:.2f}" for c in s.coverage), f"{s.nll:.2f}"]
        for s in scores
    ]  # fmt: skip
    table(f"Coverage of 90 % bands and errors on {held_out}", columns, rows)
