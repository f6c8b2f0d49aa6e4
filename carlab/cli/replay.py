"""``carlab replay``."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from tyro.conf import OmitArgPrefixes, Positional

from carlab.cli.console import console, fail, progress, table
from carlab.cli.options import CarOptions, above_zero, new_file
from carlab.cli.recordings import load_episodes
from carlab.cli.runs import ask_to_place, new_run, write_result
from carlab.core.episode_data import EpisodeData
from carlab.core.errors import ConfigError
from carlab.core.quantities import STATE_NAMES, STATE_UNITS, FloatArray, Reality

if TYPE_CHECKING:
    from carlab.cars import CarChoice
    from sim_backends.car_parameters import SimulatorConfig


@dataclass
class Replay:
    """Send recorded actions to any car, real or simulated, and compare.

    On a simulated car: predict --horizon seconds ahead from many starts along the recording and print the errors by
    channel. On any other car (or with --drive): put it at the recorded start, send the recorded actions at their
    times, record that, and print how far it strays.
    """

    recording: Positional[Path]
    """An MCAP or a CSV."""

    which_car: OmitArgPrefixes[CarOptions] = field(default_factory=CarOptions)

    horizon: float = 1.0
    """How far to predict [s]."""

    stride: float = 0.25
    """From one start to the next [s]."""

    save: Path | None = None
    """Write FILE.rrd with the predictions beside the recording."""

    drive: bool = False
    """Drive a simulated car too."""

    seconds: float | None = None
    """Drive only this much of the recording."""

    seed: int = 0
    """Of sensor noise."""

    out: Path = Path("runs")
    """Folder for the recording of what was driven."""

    verbose: bool = False
    """Show the whole log."""

    def run(self) -> int:
        """Predict or drive, and print."""
        above_zero(horizon=self.horizon, stride=self.stride, seconds=self.seconds)
        if self.seed < 0:
            raise ConfigError(f"--seed {self.seed}: at least 0.")
        if self.save is not None:
            new_file(self.save, "--save", ".rrd")
        choice = self.which_car.choose(seed=self.seed)
        episodes = load_episodes(self.recording)
        if choice.car.reality is Reality.SIMULATED and not self.drive:
            for index, episode in enumerate(episodes):
                self._predict(episode, choice.simulator, index if len(episodes) > 1 else None)
            return 0
        return self._drive(max(episodes, key=lambda e: e.ticks), choice)

    def _predict(self, episode: EpisodeData, simulator: SimulatorConfig, index: int | None) -> None:
        from carlab.experiment.prediction_errors import prediction_errors

        found = prediction_errors(episode, simulator, self.horizon, self.stride)
        rows = [
            [f"{channel} [{unit}]", *(f"{value:.4f}" for value in (rms, median, p90, bias, constant, still))]
            for channel, unit, rms, median, p90, bias, constant, still in found.rows()
        ]
        part = "" if index is None else f", part {index + 1}"
        title = f"Error after {found.horizon_s:.2f} s, {found.shots} starts{part}"
        columns = ["channel", "rms", "median", "p90", "bias", "constant velocity: rms", "no change: rms"]
        table(title, columns, rows)
        if found.note:
            console.print(found.note)
        left_out = [f"{count} {why}" for why, count in found.left_out.items() if count]
        if left_out:
            console.print(f"Starts left out: {', '.join(left_out)}.")
        if self.save is not None:
            from carlab.recording.rerun_sink import episode_to_rrd

            path = self.save if index is None else self.save.with_name(f"{self.save.stem}-{index + 1}.rrd")
            episode_to_rrd(episode, path, self.recording.name, overlays={"predicted": found.overlay})
            console.print(f"{path}")

    def _drive(self, episode: EpisodeData, choice: CarChoice) -> int:
        from carlab.cli import EXIT_INTERRUPTED
        from carlab.cli.drive import EXIT_SAFETY_STOP
        from carlab.core.outcome import EndReason
        from carlab.core.quantities import CarState
        from carlab.core.task import RecordedTask
        from carlab.experiment.scripted_policies import ReplayPolicy
        from carlab.experiment.session import Session, SessionHooks

        period_s = choice.control_period_s
        duration_s = float(episode.times_s[-1] - episode.times_s[0])
        duration_s = duration_s if self.seconds is None else min(duration_s, self.seconds)
        task = RecordedTask(CarState.from_array(episode.states[0]), max_ticks=max(round(duration_s / period_s), 1))
        envelope = choice.envelope
        if not envelope.arena_m and choice.car.reality is not Reality.REAL:
            x, y = episode.states[:, 0], episode.states[:, 1]
            from carlab.core.geofence import rectangle

            envelope = replace(envelope, arena_m=rectangle(x.min() - 20, x.max() + 20, y.min() - 20, y.max() + 20))
        with contextlib.ExitStack() as stack:
            run = stack.enter_context(new_run(self.out, "replay", choice))
            car = stack.enter_context(choice.car)
            bar = stack.enter_context(progress())
            row = bar.add_task("replay", total=task.max_ticks, note="")
            hooks = SessionHooks(
                place_by_hand=ask_to_place(bar, "use a terminal"),
                on_tick=lambda tick: bar.update(row, completed=tick.step + 1),
            )
            policy = ReplayPolicy(episode.times_s[:-1], episode.sent)
            session = Session(
                car, policy, task, envelope, run, period_s, seed=self.seed, config_toml=choice.config_toml, hooks=hooks
            )
            results = session.drive(1)
        if not results:
            console.print("Nothing was driven.")
            return EXIT_INTERRUPTED
        write_result(run, results)
        driven = results[0].data
        elapsed_s = driven.times_s - driven.times_s[0]
        recorded = np.stack(
            [np.interp(elapsed_s, episode.times_s - episode.times_s[0], c) for c in _unwrapped(episode).T]
        )
        error = _unwrapped(driven) - recorded.T
        rows = [
            [
                f"{name} [{unit}]",
                *(f"{abs(error[_row_at(elapsed_s, t), k]):.4f}" for t in (0.5, 1.0, 2.0)),
                f"{abs(error[-1, k]):.4f}",
            ]
            for k, (name, unit) in enumerate(zip(STATE_NAMES, STATE_UNITS, strict=True))
        ]
        table("Difference to the recording", ["channel", "0.5 s", "1 s", "2 s", f"end ({elapsed_s[-1]:.1f} s)"], rows)
        console.print(f"Recorded in {results[0].path}")
        if results[0].reason.is_safety_stop:
            fail(f"{results[0].reason.value} {driven.metadata['end_detail']}".rstrip())
            return EXIT_SAFETY_STOP
        return EXIT_INTERRUPTED if results[0].reason is EndReason.STOP_REQUESTED else 0


def _unwrapped(episode: EpisodeData) -> FloatArray:
    states = episode.states.copy()
    states[:, 2] = np.unwrap(states[:, 2])
    return states


def _row_at(elapsed_s: FloatArray, t_s: float) -> int:
    return int(np.argmin(np.abs(elapsed_s - t_s)))
