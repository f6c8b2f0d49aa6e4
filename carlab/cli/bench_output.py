"""Output of the studies of ``carlab bench``: figures written after every fit, a table, a picture, an exit code."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from carlab.cli.bench_jobs import StudyJob, read_figures
from carlab.cli.bench_options import BenchOptions
from carlab.cli.console import console, fail, table
from carlab.cli.exit_codes import EXIT_FAILED, EXIT_INTERRUPTED
from carlab.cli.recordings import load_episodes
from carlab.core.episode_data import EpisodeData
from carlab.jobs.child_jobs import ChildJob
from carlab.recording.atomic_files import write_json
from carlab.studies.regression.picture import draw
from carlab.studies.regression.recordings import RecordedCase, recorded_case
from carlab.studies.regression.scores import Row, Score, as_json, failed_score, scores_from_json, summarised
from learning.devices import device_name


def command() -> str:
    """The current command line, quoted for a shell."""
    return shlex.join(["carlab", *sys.argv[1:]])


def load_case(
    files: Sequence[Path], car: Path, history: int | None
) -> tuple[RecordedCase, list[Sequence[EpisodeData]]]:
    """The case of recordings (the last one is held out) and their episodes; prints the number of past commands."""
    recordings = [load_episodes(path) for path in files]
    case = recorded_case(recordings, car, history)
    console.print(f"{case.history_message} Held out: {files[-1].name}.", soft_wrap=True)
    return case, recordings


def score_job(job: ChildJob, case: str, rows: int, seed: int, methods: Sequence[str]) -> StudyJob[Score]:
    """A job that writes the scores of methods; if it fails, each method has a failed score."""
    return StudyJob(
        f"{', '.join(methods)}, {rows} rows, seed {seed}",
        job,
        lambda end: scores_from_json(read_figures(end)),
        lambda reason: [failed_score(case, method, rows, seed, reason) for method in methods],
    )


def write_scores(new: Sequence[Score], scores: Sequence[Score], options: BenchOptions) -> None:
    """Write all scores, and print the failures among the new ones."""
    if options.out is not None:
        device = f"{options.device} of Ray {options.ray}" if options.ray else device_name(options.device)
        write_json(options.out, as_json(scores, command(), device))
    for score in new:
        if score.failed is not None:
            fail(f"{score.method}, {score.rows} rows, seed {score.seed} failed: {score.failed}")


def report(scores: Sequence[Score], stopped: bool, options: BenchOptions, title: str, first: str, *others: Path) -> int:
    """Print and draw the scores of a study; ``first`` is the header of the column with the compared methods.

    Returns:
        The exit code: interrupted (``stopped``), failed (at least one fit failed) or 0.
    """
    rows = summarised(scores)
    print_rows(f"{title}{', interrupted' if stopped else ''}", first, rows)
    if options.out is not None:
        written = [options.out, *others]
        if any(row.seeds for row in rows):
            written.insert(1, options.out.with_suffix(".png"))
            draw(rows, written[1])
        console.print(", ".join(map(str, written)))
    if stopped:
        return EXIT_INTERRUPTED
    return EXIT_FAILED if any(row.failed for row in rows) else 0


def print_rows(title: str, first: str, rows: Sequence[Row]) -> None:
    """Print scores as a table; ``first`` is the header of the column with the compared methods."""
    columns = ["rows", first, "NLL [nat]", "+-", "RMSE", "calibration error", "seconds"]
    cells = [[f"{r.rows}", _label(r), *_figures(r)] for r in rows]
    if any(r.nll_in_world is not None for r in rows):
        columns.append("NLL, seven outputs\nin the world")
        for cell, r in zip(cells, rows, strict=True):
            cell.append("" if r.nll_in_world is None else f"{r.nll_in_world:.2f}")
    table(title, columns, cells)


def _label(row: Row) -> str:
    return f"{row.method}, {row.failed} of {row.seeds + row.failed} failed" if row.failed else row.method


def _figures(row: Row) -> list[str]:
    if not row.seeds:
        return [""] * 5
    return [
        f"{row.nll:.2f}",
        f"{row.nll_standard_error:.2f}",
        f"{row.rmse:.3g}",
        f"{row.calibration:.3f}",
        f"{row.seconds:.1f}",
    ]
