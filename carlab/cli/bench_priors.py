"""``carlab bench priors``."""

from __future__ import annotations

import itertools
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path

from carlab.api.recordings import required_file
from carlab.cars import load_car_file
from carlab.cli.bench_jobs import StudyJob, bench_job, recorded_files, run_study_parts
from carlab.cli.bench_options import BenchOptions, row_counts
from carlab.cli.bench_output import load_case, report, score_job, write_scores
from carlab.cli.console import console, progress
from carlab.cli.diagnose import Diagnose
from carlab.cli.recordings import recordings_in
from carlab.core.errors import ConfigError, DataError
from carlab.core.hashes import sha256_of
from carlab.core.json_files import read_json
from carlab.studies.priors import checked_counts, prior_models, run_prior_study
from carlab.studies.regression.recordings import RecordedCase
from carlab.studies.regression.scores import Score

MODEL = "model.toml"
HOLDOUT_SHARE = 0.1
"""Share of each diagnosed recording in the validation split of the diagnosis (docs/decisions/0014)."""


def run_priors(options: BenchOptions) -> int:
    """Record or read recordings, diagnose all but the held-out one, fit a model under each prior, and print."""
    with ExitStack() as stack:
        work = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        if options.out is not None:
            work = options.out.with_suffix("")
        car, files, what = _recordings(options, work)
        if options.diagnosed is None:
            model = _diagnosed(files[:-1], car, work / "diagnosis")
        else:
            model = options.diagnosed
            check_held_out(model, files[-1])
        diagnosed = load_car_file(model).simulator
        simulator = load_car_file(car).simulator
        case, _ = load_case(files, car, options.history)
        priors = prior_models(case, simulator, diagnosed)
        scores, stopped = run_study_parts(
            lambda progress, stop: run_prior_study(
                case, priors, rows=row_counts(options), seeds=options.seeds, first_seed=options.first_seed,
                steps=options.steps, device=options.device, progress=progress,
            ),
            lambda: _jobs(options, case, list(priors), files, car, model),
            options,
            "priors",
            partial(write_scores, options=options),
        )  # fmt: skip
        return report(scores, stopped, options, f"{what}, {options.seeds} seeds", "prior", work)


def _jobs(
    options: BenchOptions, case: RecordedCase, priors: Sequence[str], files: Sequence[Path], car: Path, model: Path
) -> list[StudyJob[Score]]:
    """One job for each number of rows and seed, with all priors."""
    recorded, contents = recorded_files(files, car, case.rows.history)
    contents[MODEL] = model.read_bytes()
    jobs = []
    for rows, seed in itertools.product(checked_counts(case, row_counts(options)), options.all_seeds):
        job = bench_job(options, rows, seed, [*recorded, "--diagnosed", MODEL], contents)
        jobs.append(score_job(job, case.name, rows, seed, priors))
    return jobs


def check_held_out(model: Path, held_out: Path) -> None:
    """Check that the report of a diagnosed car does not list the held-out recording.

    Raises:
        ConfigError: the report lists it, or the model does not exist.
        DataError: the report cannot be read.
    """
    required_file(model, "The diagnosed car")
    report = model.parent / "report.json"
    if not report.is_file():
        return
    try:
        known = {use["sha256"] for use in read_json(report)["recordings"]}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(f"{report} cannot be read ({error!r}); diagnose again.") from error
    if sha256_of(held_out) in known:
        raise ConfigError(
            f"{model} was diagnosed with {held_out.name}, which is held out here; diagnose without it, or remove "
            "--diagnosed."
        )


def _recordings(options: BenchOptions, work: Path) -> tuple[Path, list[Path], str]:
    """Car file, recordings (the last one is held out), and a title."""
    if options.data is not None:
        return options.car, recordings_in(options.data), options.data.name
    from carlab.studies.concealed_recordings import CAR_NAME, HELD_OUT_NAME, TRAINING_NAME, record_pair

    folder = work / "recordings"
    with progress() as bar:
        task = bar.add_task("recording", total=None, note="sizing two concealed effects")
        pair = record_pair(options.pair, folder, *options.recorded_s)
        bar.remove_task(task)
    what = " and ".join(name.replace("_", " ") for name in pair.effects)
    console.print(f"Concealed in the simulated car: {what} (seed {pair.seed}).", soft_wrap=True)
    return folder / CAR_NAME, [folder / TRAINING_NAME, folder / HELD_OUT_NAME], what


def _diagnosed(files: Sequence[Path], car: Path, folder: Path) -> Path:
    """The car file of a diagnosis of recordings, with the end of each as its validation split."""
    if Diagnose(tuple(files), car=str(car), out=folder, holdout_share=HOLDOUT_SHARE).run() != 0:
        console.print("The diagnosis is inconclusive; the diagnosed prior is the car file.")
    return folder / "model.toml"
