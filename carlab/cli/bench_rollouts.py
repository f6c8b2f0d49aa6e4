"""``carlab bench rollouts``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from carlab.cli.bench_output import command, write_figures
from carlab.cli.bench_priors import recordings_in
from carlab.cli.console import console, progress, table
from carlab.cli.exit_codes import EXIT_INTERRUPTED
from carlab.core.errors import ConfigError

if TYPE_CHECKING:
    from carlab.cli.bench_options import BenchOptions


def run_rollouts(options: BenchOptions) -> int:
    """Fit learned cars and their disturbances, and print coverage and error of their rollouts."""
    from carlab.cli.recordings import load_episodes
    from carlab.experiment.episodes.interrupts import Interrupts
    from carlab.studies.regression.recordings import recorded_case
    from carlab.studies.rollouts import RolloutScore, as_json, run_rollout_study

    if options.data is None:
        raise ConfigError("bench rollouts needs --data FOLDER with recordings of one car; add it.")
    files = recordings_in(options.data)
    recordings = [load_episodes(path) for path in files]
    case = recorded_case(recordings, options.car, options.history)
    console.print(f"{case.history_message} Held out: {files[-1].name}.", soft_wrap=True)
    scores: list[RolloutScore] = []
    with Interrupts() as interrupts, progress() as bar:
        row = bar.add_task("rollouts", total=None, note="")
        study = run_rollout_study(
            case, recordings, rows=options.rows, seeds=options.seeds, steps=options.steps,
            device=options.device,
            progress=lambda note, done, total: bar.update(row, completed=done, total=total, note=note),
            stop=interrupts.requested.is_set,
        )  # fmt: skip
        for score in study:
            scores.append(score)
            if options.out is not None:
                write_figures(options.out, as_json(scores, command()))
        stopped = interrupts.requested.is_set()
    columns = ["rows", "seed", "rollouts", "after [s]", "position rms [m]", "yaw rms [rad]", "energy score [m]",
               "ahead", "left", "yaw", "vx", "vy", "yaw rate", "one-step nll"]  # fmt: skip
    rows = [
        [str(s.rows), str(s.seed), s.model, f"{s.horizon_s:g}", f"{s.position_rms_m:.3f}", f"{s.yaw_rms_rad:.3f}",
         f"{s.energy_m:.4f}", *(f"{c:.2f}" for c in s.coverage), f"{s.nll:.2f}"]
        for s in scores
    ]  # fmt: skip
    table(f"Coverage of 90 % bands and errors on {files[-1].name}", columns, rows)
    if options.out is not None:
        console.print(f"{options.out}")
    return EXIT_INTERRUPTED if stopped else 0
