"""What studies of ``carlab bench`` leave behind: figures kept after every fit, a table, a picture, and an exit code."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from carlab.cli.console import console, fail, progress, table

if TYPE_CHECKING:
    from carlab.cli.bench import Bench
    from carlab.experiment.regression_study import Progress, Row, Score

MINUTES_S = 600.0
EXIT_FAILED = 1


def command() -> str:
    """The command line that is run."""
    return " ".join(["carlab", *sys.argv[1:]])


def write_figures(path: Path, figures: Mapping[str, Any]) -> None:
    """Write a JSON file whole, or leave the one that is there; DataError where that fails."""
    from carlab.recording.whole_files import write_text

    write_text(path, json.dumps(figures, indent=2) + "\n")


def followed(study: Callable[[Progress], Iterator[Score]], options: Bench, name: str) -> tuple[list[Score], bool]:
    """Scores of a study, each written as soon as it is there, and whether ^C ended it; a fit that failed is told.

    Args:
        study: begins it, and tells how far it is.
        options: among them the file that is written.
        name: of the progress bar.
    """
    from carlab.experiment.interrupts import Interrupts
    from carlab.experiment.regression_study import as_json

    scores: list[Score] = []
    with Interrupts() as interrupts, progress(speed_estimate_period_s=MINUTES_S) as bar:
        task = bar.add_task(name, total=None, note="")
        for score in study(lambda note, done, total: bar.update(task, completed=done, total=total, note=note)):
            scores.append(score)
            if options.out is not None:
                write_figures(options.out, as_json(scores, command(), options.device))
            if score.failed is not None:
                fail(f"{score.method}, {score.rows} rows, seed {score.seed} failed: {score.failed}")
            if interrupts.requested.is_set():
                break
        return scores, interrupts.requested.is_set()


def told(scores: Sequence[Score], stopped: bool, options: Bench, title: str, first: str, *beside: Path) -> int:
    """Print and draw a study; the exit code says whether it was ended early or some fit failed.

    Args:
        scores: of it.
        stopped: whether it was ended early.
        options: among them the file that was written.
        title: of the table.
        first: what is compared.
        beside: what else was written.
    """
    from carlab.cli import EXIT_INTERRUPTED
    from carlab.experiment.regression_picture import draw
    from carlab.experiment.regression_study import summarised

    found = summarised(scores)
    print_rows(f"{title}{', interrupted' if stopped else ''}", first, found)
    if options.out is not None:
        written = [options.out, *beside]
        if any(row.seeds for row in found):
            written.insert(1, options.out.with_suffix(".png"))
            draw(found, written[1])
        console.print(", ".join(map(str, written)))
    if stopped:
        return EXIT_INTERRUPTED
    return EXIT_FAILED if any(row.failed for row in found) else 0


def print_rows(title: str, first: str, rows: Sequence[Row]) -> None:
    """Scores as a table; ``first`` says what is compared."""
    columns = ["rows", first, "NLL [nat]", "+-", "RMSE", "calibration error", "seconds"]
    cells = [[f"{r.rows}", _named(r), *_figures(r)] for r in rows]
    if any(r.nll_in_world is not None for r in rows):
        columns.append("NLL, seven outputs\nin the world")
        for cell, r in zip(cells, rows, strict=True):
            cell.append("" if r.nll_in_world is None else f"{r.nll_in_world:.2f}")
    table(title, columns, cells)


def _named(row: Row) -> str:
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


__all__ = ["command", "followed", "print_rows", "told", "write_figures"]
