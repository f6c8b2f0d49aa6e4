"""Parts of a study of ``carlab bench`` as jobs, on this machine (``--jobs``) or on Ray (``--ray``).

A job is the same command for one number of rows, one seed or one method, with copies of the files that it reads.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

from carlab.cars import is_preset
from carlab.cli.bench_options import BenchOptions
from carlab.cli.console import fail, progress
from carlab.experiment.episodes.interrupts import Interrupts
from carlab.jobs.child_jobs import CARLAB, ChildJob, JobEnd
from carlab.jobs.child_processes import ONE_THREAD, run_parallel
from carlab.jobs.ray_executor import chosen_executor

Result = TypeVar("Result")
DATA, CAR, FIGURES = "data", "car.toml", "figures.json"
"""Names in the folder of a job: recordings, car file, and the figures that it writes."""
JOBS_SPEED_PERIOD_S, FITS_SPEED_PERIOD_S = 86400.0, 600.0
"""Windows over which the progress bars of jobs and of fits estimate their speed."""
Progress = Callable[[str, int, int], None]
"""Called with the name of the next fit, the number of completed fits and the total number."""


@dataclass(frozen=True, slots=True)
class StudyJob(Generic[Result]):
    """A part of a study.

    Attributes:
        label: for the progress bar and messages.
        job: command and files.
        read: results of an ended job. Raises KeyError, TypeError or ValueError if it left none.
        failed: results in place of those of a job that left none, from the reason.
    """

    label: str
    job: ChildJob
    read: Callable[[JobEnd], list[Result]]
    failed: Callable[[str], list[Result]]

    def results(self, end: JobEnd) -> list[Result]:
        """Results of an ended job, or those in place of a failed one."""
        try:
            return self.read(end)
        except (KeyError, TypeError, ValueError) as error:
            return self.failed(end.failure or f"its result cannot be read ({error!r})")


def reporting_job(
    label: str, job: ChildJob, read: Callable[[JobEnd], list[Result]], failures: list[str]
) -> StudyJob[Result]:
    """A job without results if it fails; the message is printed and appended to ``failures``."""

    def failed(reason: str) -> list[Result]:
        failures.append(f"{label} failed: {reason}")
        fail(failures[-1])
        return []

    return StudyJob(label, job, read, failed)


def uses_jobs(options: BenchOptions) -> bool:
    """Whether the options ask for parallel jobs."""
    return bool(options.ray) or options.jobs > 1


def run_jobs(
    jobs: Sequence[StudyJob[Result]],
    options: BenchOptions,
    name: str,
    finished: Callable[[list[Result], list[Result]], None],
) -> tuple[list[Result], bool]:
    """Run jobs in parallel. ^C ends the study after the running jobs, a second ^C at once.

    Args:
        jobs: in the order of the study.
        options: with the executor.
        name: of the progress bar.
        finished: called after each job with its results and all results so far, in the order of the study.

    Returns:
        All results in the order of the study, and whether ^C ended it.
    """
    found: dict[int, list[Result]] = {}
    executor_of_options = chosen_executor(options.ray, options.jobs, gpu=options.device == "cuda")
    with Interrupts() as interrupts, executor_of_options as executor, progress(JOBS_SPEED_PERIOD_S) as bar:
        row = bar.add_task(name, total=len(jobs), note="")

        def on_end(number: int, end: JobEnd) -> None:
            if end.end.abandoned:
                return
            found[number] = jobs[number].results(end)
            bar.update(row, completed=len(found), note=jobs[number].label)
            finished(found[number], in_order())

        def in_order() -> list[Result]:
            return [result for number in sorted(found) for result in found[number]]

        run_parallel(
            executor.jobs,
            range(len(jobs)),
            lambda number: executor.run(jobs[number].job, interrupts.urgent.is_set),
            stop_requested=interrupts.requested.is_set,
            finished=on_end,
        )
        return in_order(), len(found) < len(jobs)


def run_study_parts(
    here: Callable[[Progress, Callable[[], bool]], Iterator[Result]],
    jobs: Callable[[], Sequence[StudyJob[Result]]],
    options: BenchOptions,
    name: str,
    finished: Callable[[list[Result], list[Result]], None],
) -> tuple[list[Result], bool]:
    """Run a study in this process, or its parts as parallel jobs. ^C ends it after the running fits, a second at once.

    Args:
        here: starts the study in this process with callbacks for its progress and for ^C.
        jobs: makes the jobs.
        options: with the executor.
        name: of the progress bar.
        finished: as for ``run_jobs``; called after each result.

    Returns:
        As ``run_jobs``.
    """
    if uses_jobs(options):
        return run_jobs(jobs(), options, name, finished)
    results: list[Result] = []
    with Interrupts(second_raises=True) as interrupts, progress(FITS_SPEED_PERIOD_S) as bar:
        row = bar.add_task(name, total=None, note="")
        stop = interrupts.requested.is_set
        for result in here(lambda note, done, total: bar.update(row, completed=done, total=total, note=note), stop):
            results.append(result)
            finished([result], results)
            if stop():
                break
        return results, stop()


def bench_job(
    options: BenchOptions, rows: int | str, seed: int, more: Sequence[str], files: Mapping[str, bytes]
) -> ChildJob:
    """The command of one number of rows and one seed, with further options and contents of the files that it reads.

    Its figures are in the output ``FIGURES``.
    """
    command = [*CARLAB, "bench", str(options.what), "--out", FIGURES, "--rows", str(rows), "--seeds", "1"]
    command += ["--first-seed", str(seed), "--device", options.device, *more]
    if options.steps is not None:
        command += ["--steps", str(options.steps)]
    return ChildJob(tuple(command), math.inf, files, (FIGURES,), environment=ONE_THREAD)


def recorded_files(recordings: Sequence[Path], car: Path, history: int) -> tuple[list[str], dict[str, bytes]]:
    """Options and files of a job that reads recordings: copies of recordings and car file, and the number of commands.

    Args:
        recordings: the last one is held out.
        car: car file, or the name of a preset.
        history: number of past commands, so that no job estimates it again.
    """
    files = {f"{DATA}/{path.name}": path.read_bytes() for path in recordings}
    given = ["--data", DATA, "--history", str(history), "--car", str(car)]
    if not is_preset(car):
        files[CAR] = car.read_bytes()
        given[-1] = CAR
    return given, files


def read_figures(end: JobEnd) -> dict[str, object]:
    """The figures of a job. Raises KeyError or ValueError if it left none."""
    content: dict[str, object] = json.loads(end.outputs[FIGURES])
    return content
