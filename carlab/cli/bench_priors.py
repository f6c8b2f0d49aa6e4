"""``carlab bench priors``."""

from __future__ import annotations

import hashlib
import json
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from carlab.cli.bench_output import followed, told
from carlab.cli.console import console, progress
from carlab.cli.options import required_file
from carlab.core.errors import ConfigError, DataError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from carlab.cli.bench import Bench

HOLDOUT_SHARE = 0.1
"""Of the recordings that are diagnosed. Of train_1 of the ETH car a diagnosis that fits 70 % names four effects, one
that fits 90 % eight."""


def run_priors(options: Bench) -> int:
    """Record or read, diagnose what is not held out, learn under each prior, and print."""
    from carlab.cars import load_car_file
    from carlab.cli.recordings import load_episodes
    from carlab.experiment.prior_study import prior_models, run_prior_study
    from carlab.experiment.regression_recordings import recorded_case

    with ExitStack() as stack:
        work = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        if options.out is not None:
            work = options.out.with_suffix("")
        car, files, what = _recordings(options, work)
        if options.diagnosed is None:
            model = _diagnosed(files[:-1], car, work / "diagnosis")
        else:
            model = options.diagnosed
            check_unseen(model, files[-1])
        diagnosed = load_car_file(model).simulator
        simulator = load_car_file(car).simulator
        case = recorded_case([load_episodes(path) for path in files], car, options.history)
        console.print(f"{case.told} Held out: {files[-1].name}.", soft_wrap=True)
        priors = prior_models(case, simulator, diagnosed)
        scores, stopped = followed(
            lambda progress: run_prior_study(
                case, priors, rows=options.rows, seeds=options.seeds, steps=options.steps, device=options.device,
                progress=progress,
            ),
            options,
            "priors",
        )  # fmt: skip
        return told(scores, stopped, options, f"{what}, {options.seeds} seeds", "prior", work)


def check_unseen(model: Path, held_out: Path) -> None:
    """Raise ConfigError where the report beside a diagnosed car names the recording that is held out."""
    required_file(model, "The diagnosed car")
    report = model.parent / "report.json"
    if not report.is_file():
        return
    try:
        known = {use["sha256"] for use in json.loads(report.read_text(encoding="utf-8"))["recordings"]}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(f"{report} cannot be read ({error!r}); diagnose again.") from error
    if hashlib.sha256(held_out.read_bytes()).hexdigest() in known:
        raise ConfigError(
            f"{model} was diagnosed with {held_out.name}, which is held out here; diagnose without it, or leave out "
            "--diagnosed."
        )


def _recordings(options: Bench, work: Path) -> tuple[Path, list[Path], str]:
    """Car file, recordings, the last of which is held out, and what they are."""
    if options.data is not None:
        if not options.data.is_dir():
            raise ConfigError(
                f"--data {options.data} is no folder; name one with two recordings or more (MCAP or CSV)."
            )
        files = sorted(p for p in options.data.iterdir() if p.name.endswith((".mcap", ".csv", ".csv.gz")))
        if len(files) < 2:
            raise DataError(f"{options.data} has {len(files)} recordings; the last is held out, so two are needed.")
        return options.car, files, options.data.name
    from carlab.experiment.concealed_recordings import CAR_NAME, HELD_OUT_NAME, TRAINING_NAME, record_pair

    folder = work / "recordings"
    with progress() as bar:
        task = bar.add_task("recording", total=None, note="sizing two concealed effects")
        pair = record_pair(options.pair, folder, *options.recorded_s)
        bar.remove_task(task)
    what = " and ".join(name.replace("_", " ") for name in pair.effects)
    console.print(f"Concealed in the simulated car, told to nobody else: {what} (seed {pair.seed}).", soft_wrap=True)
    return folder / CAR_NAME, [folder / TRAINING_NAME, folder / HELD_OUT_NAME], what


def _diagnosed(files: Sequence[Path], car: Path, folder: Path) -> Path:
    """The car file of a diagnosis of some recordings, which holds out the end of each for itself.

    No more than it needs: the recording that is held out from it is what judges here.
    """
    from carlab.cli.diagnose import Diagnose

    if Diagnose(tuple(files), car=str(car), out=folder, holdout_share=HOLDOUT_SHARE).run() != 0:
        console.print("Nothing could be diagnosed: the diagnosed prior is the car's file.")
    return folder / "model.toml"
