"""``carlab replay``."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Annotated

import numpy as np
from tyro.conf import OmitArgPrefixes, Positional, arg

from carlab.api.arguments import above_zero, valid_seed
from carlab.api.driving import replay
from carlab.api.prediction import PredictionErrors, predict
from carlab.api.recordings import load
from carlab.cli.console import banner, console, fail, progress, table
from carlab.cli.exit_codes import EXIT_INTERRUPTED, EXIT_SAFETY_STOP
from carlab.cli.options import ARGUMENT_DEFAULT, CarOptions, arguments_of, new_file, options_of
from carlab.cli.recordings import print_errors, print_recording
from carlab.cli.runs import ask_to_place
from carlab.core.episode_data import EpisodeData
from carlab.core.errors import ConfigError
from carlab.core.outcome import EndReason
from carlab.core.quantities import STATE_NAMES, STATE_UNITS, FloatArray, Reality
from carlab.experiment.episodes.hooks import RunHooks

OPTIONS_OF_PREDICTIONS = ("horizon_s", "stride_s", "holdout_share", "adapt", "keep_events", "save")


@dataclass
@options_of(predict, replay)
class Replay:
    """Print the prediction errors of a simulator on a recording, or send the recorded actions to a car again.

    On a simulated car: predict --horizon seconds ahead from many initial states along the recording, and print the
    errors of the simulator and of constant velocity. The errors are computed as in carlab diagnose, for the whole
    recording and for its last part, which a diagnosis of this recording alone holds out. On a real or
    emulated car, or with option --drive: put the car at the recorded start, send the recorded actions at their times
    (a real car moves), record the drive, and print its difference from the recording. For predictions with the car file
    of a real car, use --car sim --vehicle FILE.
    """

    recording: Positional[Path]
    """An MCAP or a CSV."""

    car: OmitArgPrefixes[CarOptions] = field(default_factory=CarOptions)

    horizon_s: Annotated[float, arg(name="horizon")] = ARGUMENT_DEFAULT
    stride_s: Annotated[float, arg(name="stride")] = ARGUMENT_DEFAULT
    holdout_share: float = ARGUMENT_DEFAULT
    adapt: bool = ARGUMENT_DEFAULT
    keep_events: bool = ARGUMENT_DEFAULT

    save: Path | None = None
    """Write FILE.rrd with the recording and the predictions."""

    drive: bool = False
    """Drive a simulated car too, instead of predicting."""

    seconds: float | None = ARGUMENT_DEFAULT
    seed: int = ARGUMENT_DEFAULT
    out: Path = ARGUMENT_DEFAULT

    verbose: bool = False
    """Show the whole log."""

    def run(self) -> int:
        """Predict or drive, and print."""
        from carlab.cars import choose_car

        above_zero(horizon=self.horizon_s, stride=self.stride_s, seconds=self.seconds)
        valid_seed(seed=self.seed)
        if self.save is not None:
            new_file(self.save, "--save", ".rrd")
        car = self.car
        choice = choose_car(
            car.car, vehicle=car.vehicle, reality=car.reality, dry_run=car.dry_run, seed=self.seed, is_driven=False
        )
        if choice.car.reality is not Reality.SIMULATED or self.drive:
            self._refuse_options_of_predictions()
            return self._drive()
        for option, value in (("seconds", self.seconds), ("reality", car.reality)):
            if value is not None:
                raise ConfigError(f"--{option} has no effect on predictions; add --drive, or remove it.")
        self._predict()
        return 0

    def _refuse_options_of_predictions(self) -> None:
        for option in fields(self):
            if option.name in OPTIONS_OF_PREDICTIONS and getattr(self, option.name) != option.default:
                name = option.name.removesuffix("_s").replace("_", "-")
                raise ConfigError(f"--{name} is for predictions by a simulated car; remove it to drive.")

    def _predict(self) -> None:
        from carlab.diagnosis.report.events import event_sentences
        from carlab.diagnosis.score_recording import MODEL, describe_windows

        car = self.car
        if car.vehicle is not None and car.car != "sim":
            raise ConfigError(f"--vehicle needs --car sim; '{car.car}' has its own physics.")
        found = predict(**arguments_of(self, predict) | {"car": car.vehicle or car.car})
        for note in found.recordings.notes:
            console.print(note)
        for fault in (*found.recordings.faults, *found.score.faults):
            console.print(f"{fault.channel}: {fault.action}")
        for part in (found.score.whole, found.score.last):
            if part is None:
                console.print("The last part is too short to be scored by itself.")
                continue
            print_errors(f"Error after {found.horizon_s:.2f} s, {describe_windows(part)}", "model", part.summaries())
        self._print_channels(found)
        errors = (found.summary[MODEL], found.summary_with_events[MODEL]) if found.events.held_out_windows else ()
        for sentence in event_sentences(found.events, *errors):
            console.print(sentence)
        if self.adapt:
            self._print_changes(found)
        if self.save is not None:
            for path in found.save(self.save):
                console.print(f"{path}")

    def _print_changes(self, found: PredictionErrors) -> None:
        rows = [
            [f"{c.quantity} [{c.unit}]", *(f"{v:.3f}" for v in (c.value, c.std, c.first, c.last))]
            for c in found.changes
        ]
        columns = ["quantity", "mean", "std", "first quarter", "last quarter"]
        table("Difference of the car from its simulator, estimated from the past of each moment", columns, rows)
        if not found.is_adaptation_noise_known:
            console.print(
                "The noise of the adaptation was chosen on this recording; carlab diagnose --adapt chooses it on the "
                "fitted recordings and writes it into model.toml.",
            )

    def _print_channels(self, found: PredictionErrors) -> None:
        from carlab.diagnosis.score_recording import CONSTANT_VELOCITY, MODEL, NO_CHANGE

        model, *baselines = (found.channels(name) for name in (MODEL, CONSTANT_VELOCITY, NO_CHANGE))
        rows = [
            [
                f"{e.channel} [{e.unit}]",
                *(f"{v:.4f}" for v in (e.rms, e.median, e.p90, e.bias, *(b[k].rms for b in baselines))),
            ]
            for k, e in enumerate(model)
        ]
        columns = ["channel", "rms", "median", "p90", "bias", "constant velocity: rms", "no change: rms"]
        table(f"By channel, {found.score.whole.part}", columns, rows)

    def _drive(self) -> int:
        recording = print_recording(load(self.recording))
        with progress() as bar:
            row = bar.add_task("replay", total=None, note="")
            hooks = RunHooks(
                on_start=lambda folder, car: banner(car.reality, car.name),
                place_by_hand=ask_to_place(bar, "use a terminal"),
                on_episode=lambda number, ticks: bar.update(row, total=ticks),
                on_tick=lambda tick: bar.update(row, completed=tick.step + 1),
            )
            episode, run = replay(**arguments_of(self, replay) | {"recording": recording}, hooks=hooks)
        if not run.episodes:
            console.print("Nothing was driven.")
            return EXIT_INTERRUPTED
        (result,) = run.episodes
        _print_difference(result.data, episode)
        console.print(f"Recorded in {result.path}")
        if result.reason.is_safety_stop:
            fail(result.reason.sentences(result.data.metadata["end_detail"]))
            return EXIT_SAFETY_STOP
        return EXIT_INTERRUPTED if result.reason is EndReason.STOP_REQUESTED else 0


def _print_difference(driven: EpisodeData, episode: EpisodeData) -> None:
    """Print the difference between the drive and the recording at times that the drive reached, and at its end."""
    elapsed_s = driven.times_s - driven.times_s[0]
    recorded = np.stack([np.interp(elapsed_s, episode.times_s - episode.times_s[0], c) for c in _unwrapped(episode).T])
    error = np.abs(_unwrapped(driven) - recorded.T)
    times_s = [t_s for t_s in (0.5, 1.0, 2.0) if t_s <= elapsed_s[-1] + 1e-6]
    indices = [int(np.argmin(np.abs(elapsed_s - t_s))) for t_s in times_s]
    rows = [
        [f"{name} [{unit}]", *(f"{error[index, k]:.4f}" for index in (*indices, -1))]
        for k, (name, unit) in enumerate(zip(STATE_NAMES, STATE_UNITS, strict=True))
    ]
    columns = ["channel", *(f"{t_s:g} s" for t_s in times_s), f"end ({elapsed_s[-1]:.2f} s)"]
    table("Difference to the recording", columns, rows)


def _unwrapped(episode: EpisodeData) -> FloatArray:
    states = episode.states.copy()
    states[:, 2] = np.unwrap(states[:, 2])
    return states
