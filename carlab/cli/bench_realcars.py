"""``carlab bench realcars``."""

from __future__ import annotations

from pathlib import Path

from carlab.api.diagnosis import diagnose
from carlab.cli.bench_options import BenchOptions
from carlab.cli.bench_output import command
from carlab.cli.console import console, fail, table
from carlab.cli.exit_codes import EXIT_INCONCLUSIVE
from carlab.cli.recordings import recordings_in
from carlab.cli.runs import search_callbacks
from carlab.core.errors import ConfigError
from carlab.diagnosis.report.events import diagnosed_event_sentences
from carlab.recording.atomic_files import write_json
from carlab.studies.real_cars import as_json, real_car_errors, split_by_name


def run_realcars(options: BenchOptions) -> int:
    """Diagnose the recordings to fit, and print the errors of all models on the held-out recordings."""
    if options.data is None:
        raise ConfigError("bench realcars needs --data FOLDER with recordings of one car; add it.")
    files = {path.name: path for path in recordings_in(options.data)}
    fit, held_out = split_by_name(list(files), options.held_out, options.fit)
    with search_callbacks("diagnosis") as callbacks:
        report = diagnose(
            [files[name] for name in fit],
            options.car,
            held_out=[files[name] for name in held_out],
            curves=True,
            effects=options.effects,
            ceiling=True,
            discrepancy=True,
            adapt=True,
            keep_events=options.keep_events,
            out=None if options.out is None else options.out.with_suffix(""),
            **callbacks,
        )
    if report.outcome is None:
        fail(report.sentence)
        return EXIT_INCONCLUSIVE
    errors = real_car_errors(report.outcome, [Path(name).name for name in report.held_out_names])
    columns = ["held out", "model", "after [s]", "position rms [m]", "median [m]", "yaw rms [rad]", "windows"]
    rows = [
        [e.recording, e.model, f"{e.horizon_s:g}", f"{e.position_rms_m:.3f}", f"{e.position_median_m:.3f}",
         f"{e.yaw_rms_rad:.3f}", str(e.windows)]
        for e in errors
    ]  # fmt: skip
    table(f"Prediction errors, fitted to {', '.join(fit)}", columns, rows)
    for sentence in diagnosed_event_sentences(report.diagnosis):
        console.print(sentence)
    if options.out is not None:
        write_json(options.out, as_json(errors, command(), {"fit": fit, "held_out": held_out}))
        console.print(f"{options.out}; the report of the diagnosis is in {options.out.with_suffix('')}.")
    return 0
