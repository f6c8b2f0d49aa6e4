"""``carlab drive``."""

from __future__ import annotations

import math
import shlex
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from rich.progress import Progress, TaskID
from tyro.conf import OmitArgPrefixes

from carlab.api.drive_run import DriveRun
from carlab.api.driving import EXCITATION, drive
from carlab.api.runs import figure_names
from carlab.cli.console import console, fail, progress, table, warn
from carlab.cli.exit_codes import EXIT_INTERRUPTED, EXIT_SAFETY_STOP
from carlab.cli.neutral_warnings import neutral_warning
from carlab.cli.options import ARGUMENT_DEFAULT, CarOptions, TaskOptions, arguments_of, options_of
from carlab.cli.runs import common_hooks, figure_text, heading
from carlab.core.documents import Document, SafetyEvent, Tick
from carlab.core.manoeuvres import MANOEUVRES
from carlab.core.outcome import EndReason
from carlab.experiment.episodes.hooks import RunHooks


@dataclass
@options_of(drive)
class Drive:
    """Drive episodes with a policy, a scripted manoeuvre, a gamepad or the keyboard on a car, and record them.

    A new folder in --out receives an MCAP and a rerun recording of each episode and a summary picture. Press ^C once to
    end after the tick, twice to stop at once.
    """

    car: OmitArgPrefixes[CarOptions] = field(default_factory=CarOptions)

    task: OmitArgPrefixes[TaskOptions] = field(default_factory=TaskOptions)

    policy: str = ARGUMENT_DEFAULT
    """parking (feedback), excitation (random commands inside the arena, for a diagnosis), neutral (no motion), keyboard
    or gamepad (hold the dead-man control), a scripted manoeuvre (steering_steps, throttle_steps, steering_chirp,
    figure_eight, throttle_ramp, coast_down, slow_circle), or the run folder of carlab learn: its newest policy
    (RUN/models/0003: the policy of episode 3)."""

    episodes: int = ARGUMENT_DEFAULT
    ticks: int | None = ARGUMENT_DEFAULT
    seed: int = ARGUMENT_DEFAULT
    max_throttle: float | None = ARGUMENT_DEFAULT
    place: bool = ARGUMENT_DEFAULT
    out: Path = ARGUMENT_DEFAULT
    name: str = ARGUMENT_DEFAULT
    rerun: bool = ARGUMENT_DEFAULT
    live: bool = ARGUMENT_DEFAULT
    viewer: str | None = ARGUMENT_DEFAULT
    picture: bool = ARGUMENT_DEFAULT

    verbose: bool = False
    """Show the whole log."""

    def run(self) -> int:
        """Drive and print the results."""
        events: defaultdict[int, list[SafetyEvent]] = defaultdict(list)
        with progress() as bar:
            run = drive(**arguments_of(self, drive), hooks=self._hooks(bar, events))
        return self._report(run, events)

    def _hooks(self, bar: Progress, events: defaultdict[int, list[SafetyEvent]]) -> RunHooks:
        """Callbacks that show the progress and collect the events of each episode."""
        rows: list[TaskID] = []
        numbers: list[int] = []

        def on_episode(number: int, ticks: int) -> None:
            numbers.append(number)
            rows.append(bar.add_task(f"episode {number}", total=ticks, note=""))

        def on_tick(tick: Tick) -> None:
            state = tick.observation.state
            note = f"({state.x_m:+.2f}, {state.y_m:+.2f}) m  {state.speed_mps:.2f} m/s"
            bar.update(rows[-1], completed=tick.step + 1, note=note)

        def on_document(document: Document) -> None:
            if isinstance(document, SafetyEvent):
                events[numbers[-1]].append(document)

        return RunHooks(**common_hooks(bar), on_episode=on_episode, on_tick=on_tick, on_document=on_document)

    def _has_task(self) -> bool:
        """Whether the figures of a task say something: a manoeuvre does not try to park."""
        return self.task.task is not None or self.policy not in (EXCITATION, "neutral", *MANOEUVRES)

    def _report(self, run: DriveRun, events: Mapping[int, list[SafetyEvent]]) -> int:
        results = run.episodes
        if not results:
            console.print("No episode was driven.")
            return EXIT_INTERRUPTED
        names = figure_names(results) if self._has_task() else []
        rows = [
            [
                str(r.episode),
                str(r.data.ticks),
                *([f"{r.total_reward:.1f}"] if names else []),
                *(figure_text(name, r.summary.get(name, math.nan)) for name in names),
                r.reason.name.lower().replace("_", " "),
            ]
            for r in results
        ]
        table("", ["episode", "ticks", *(["return"] if names else []), *(heading(n) for n in names), "end"], rows)
        for r in results:
            if r.reason.is_safety_stop:
                fail(f"Episode {r.episode}: {r.reason.sentences(r.data.metadata['end_detail'])}")
            elif warning := neutral_warning(r.data, events.get(r.episode, [])):
                warn(f"Episode {r.episode}: {warning}")
        complete = [r.path for r in results if r.has_recorded_ticks]
        shown = " (summary.png shows it)" if run.picture.is_file() else ""
        unit = "tick" if any(r.path.exists() for r in results) else "episode"
        ending = " View an episode with:" if complete else f" No {unit} is complete."
        console.print(f"Recorded in {run.folder}{shown}.{ending}", soft_wrap=True)
        if complete:
            console.print(f"  carlab view {shlex.quote(str(complete[0]))}", soft_wrap=True)
        last = results[-1].reason
        if last is EndReason.STOP_REQUESTED:
            return EXIT_INTERRUPTED
        if last in (EndReason.POLICY_ERROR, EndReason.RECORDER_ERROR):
            return 1
        return EXIT_SAFETY_STOP if last.is_safety_stop else 0
