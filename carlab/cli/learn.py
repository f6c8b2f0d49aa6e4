"""``carlab learn``."""

from __future__ import annotations

import functools
import math
import shlex
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

from rich.progress import Progress, TaskID
from tyro.conf import OmitArgPrefixes, arg

from carlab.api.driving import drive
from carlab.api.learn_request import RAY_WAIT_S, Device, Method, Particles
from carlab.api.learning import LearnRun, learn
from carlab.api.runs import figure_names
from carlab.cli.console import console, fail, progress, table
from carlab.cli.exit_codes import EXIT_INTERRUPTED, EXIT_SAFETY_STOP
from carlab.cli.neutral_warnings import neutral_warning
from carlab.cli.options import ARGUMENT_DEFAULT, CarOptions, TaskOptions, arguments_of, options_of
from carlab.cli.runs import common_hooks, figure_text, heading
from carlab.core.documents import Document, SafetyEvent, Tick
from carlab.experiment.campaign.hooks import LearnHooks

if TYPE_CHECKING:
    from carlab.experiment.campaign.figures import EpisodeFigures
    from carlab.experiment.campaign.quick_check import EpisodeCheck
    from carlab.experiment.episodes.result import EpisodeResult

STEPS_PERIOD_S = 600.0


def _training_messages(figures: dict[str, Any]) -> list[str]:
    """Sentences about past commands and ticks, from the figures of a training."""
    messages = [figures["history_message"]] if "history_message" in figures else []
    if (ticks := figures.get("needed_ticks")) is not None:
        messages.append(
            f"In the learned car the policy succeeds only in longer episodes: in half of them within {ticks} ticks. "
            f"Start a run with --ticks {ticks} to give it this time."
        )
    return messages


def _print_figures(bar: Progress, row: EpisodeFigures) -> None:
    bar.console.print(
        f"episode {row.episode}: return {row.total_reward:.1f} "
        f"(predicted {row.predicted_return:.1f}, 90 % interval {row.predicted_low:.1f} to "
        f"{row.predicted_high:.1f}){_cost_text(row)}, {row.outcome}; "
        f"learned from {row.rows} rows (model {row.model_seconds:.0f} s, policy {row.policy_seconds:.0f} s)",
        soft_wrap=True,
    )


@dataclass
@options_of(learn, drive)
class Learn:
    """Fit a model of the car (the learned car), train a policy in it, drive an episode with the policy, and repeat.

    The goal of parking is the origin of the motion capture with heading along x, in 100 ticks (3.3 s at 30 Hz). Before
    each episode a person places a real car at the printed start pose; simulated and emulated cars are placed
    automatically. Between episodes another process trains while the car is in neutral. --resume continues an
    interrupted run.
    """

    car: OmitArgPrefixes[CarOptions] = field(default_factory=CarOptions)

    task: OmitArgPrefixes[TaskOptions] = field(default_factory=TaskOptions)

    episodes: int | None = ARGUMENT_DEFAULT
    ticks: int | None = ARGUMENT_DEFAULT

    prior: str | None = ARGUMENT_DEFAULT
    """The prior simulator: nominal (the default: the car file), kinematic (the car file without tyre slip), auto, or
    FILE.toml (for example model.toml of a diagnosis). auto begins with nominal; between episodes, effects and
    parameters that the recordings support are added to the prior, and those that they contradict are removed; the run
    prints each change. Parameters lie in the ranges of the file. Without a range, drive gain, damping, maximum steering
    angle, yaw inertia and B and mu of the tyres lie within 30 % of their values (with kinematic only the first three
    are uncertain). If the file states standard deviations (a diagnosis), its other numbers are exact."""

    method: Annotated[str | None, arg(metavar="{" + ",".join(get_args(Method)) + "}")] = ARGUMENT_DEFAULT
    particles: Annotated[str | None, arg(metavar="{" + ",".join(get_args(Particles)) + "}")] = ARGUMENT_DEFAULT
    history: int | None = ARGUMENT_DEFAULT
    model_steps: int | None = ARGUMENT_DEFAULT
    updates: int | None = ARGUMENT_DEFAULT
    seed: int | None = ARGUMENT_DEFAULT
    device: Device | None = ARGUMENT_DEFAULT

    ray: str = ARGUMENT_DEFAULT
    """Train on Ray while the car stays with this computer: local, or the address of a cluster (ray://HOST:10001) with
    the same version of carlab, for example a computer with a GPU (--device cuda). While the cluster does not answer,
    the car stays in neutral and the run waits (--ray-wait). Then the run trains on this computer, and tries the cluster
    again before the next episode. Needs the extra ray of carlab (see "Run on a Ray
    cluster")."""

    ray_wait: float = ARGUMENT_DEFAULT
    place: bool | None = ARGUMENT_DEFAULT
    resume: Path | None = ARGUMENT_DEFAULT
    out: Path | None = ARGUMENT_DEFAULT
    name: str | None = ARGUMENT_DEFAULT
    rerun: bool | None = ARGUMENT_DEFAULT
    live: bool = ARGUMENT_DEFAULT
    viewer: str | None = ARGUMENT_DEFAULT

    verbose: bool = False
    """Show the whole log."""

    def run(self) -> int:
        """Learn and print the results."""
        with progress(speed_estimate_period_s=STEPS_PERIOD_S) as bar:
            run = learn(**arguments_of(self, learn), hooks=self._hooks(bar))
        return self._report(run)

    def _hooks(self, bar: Progress) -> LearnHooks:
        rows: dict[str, TaskID] = {}
        events: list[SafetyEvent] = []

        def show_progress(activity: str, done: int, total: int) -> None:
            if activity not in rows:
                for task in rows.values():
                    bar.remove_task(task)
                rows.clear()
                rows[activity] = bar.add_task(activity, total=total, note="")
            bar.update(rows[activity], completed=done, total=total)

        def on_episode(number: int, ticks: int) -> None:
            events.clear()
            show_progress(f"episode {number}", 0, ticks)

        def on_tick(tick: Tick) -> None:
            (task,) = rows.values()
            bar.update(task, completed=tick.step + 1)

        def on_document(document: Document) -> None:
            if isinstance(document, SafetyEvent):
                events.append(document)

        def on_result(result: EpisodeResult) -> None:
            if not result.reason.is_safety_stop and (warning := neutral_warning(result.data, events)):
                bar.console.print(f"Warning: Episode {result.episode}: {warning}", soft_wrap=True)

        def show(sentence: str) -> None:
            bar.console.print(f"  {sentence}", soft_wrap=True)

        def on_learned(figures: dict[str, Any]) -> None:
            for message in _training_messages(figures):
                show(message)

        def on_check(check: EpisodeCheck) -> None:
            for sentence in check.sentences:
                show(sentence)

        return LearnHooks(
            **common_hooks(bar),
            on_episode=on_episode,
            on_tick=on_tick,
            on_document=on_document,
            on_result=on_result,
            on_training=show_progress,
            on_learned=on_learned,
            on_figures=functools.partial(_print_figures, bar),
            on_checking=functools.partial(show_progress, "quick check of the simulator", 0, 1),
            on_check=on_check,
            on_correcting=functools.partial(show_progress, "correction of the prior", 0, 1),
            on_prior=lambda version: show(version.sentence),
            on_link=show,
        )

    def _report(self, run: LearnRun) -> int:
        from carlab.experiment.campaign.campaign import CONTINUE_REASONS

        if not run.folder.is_dir():
            console.print("No model was trained; start the run again.")
            return EXIT_INTERRUPTED
        done = len(run.recordings)
        if not run.results and run.is_complete:
            console.print(f"All {done} episodes are driven; the run in {run.folder} is complete.", soft_wrap=True)
        if run.results:
            self._print_episodes(run)
            last = run.results[-1]
            # Without a person who places the car, any safety stop ends the run.
            is_ended = last.reason not in CONTINUE_REASONS or (self.place is False and done < run.target_episodes)
            if last.reason.is_safety_stop and is_ended:
                fail(f"Episode {last.episode}: {last.reason.sentences(last.data.metadata['end_detail'])}")
            console.print(f"Learned and recorded in {run.folder} (learn.png, learn.rrd).", soft_wrap=True)
        if done < run.target_episodes:
            console.print(
                f"{done} of {run.target_episodes} episodes; resume with: "
                f"carlab learn --resume {shlex.quote(str(run.folder))}{self.car.to_text()}"
                f"{self.task.to_text()}{self.ray_text()}",
                soft_wrap=True,
            )
        if run.end is not None and run.end.is_safety_stop and run.end not in CONTINUE_REASONS:
            return EXIT_SAFETY_STOP
        return 0 if run.is_complete else EXIT_INTERRUPTED

    def ray_text(self) -> str:
        """The options of the cluster as command-line text, with a leading space; empty without a cluster."""
        wait = "" if self.ray_wait == RAY_WAIT_S else f" --ray-wait {self.ray_wait:g}"
        return f" --ray {shlex.quote(self.ray)}{wait}" if self.ray else ""

    def _print_episodes(self, run: LearnRun) -> None:
        """Table of the episodes, and the number of successes."""
        names = [name for name in figure_names(run.results) if name != "success"]
        table(
            "",
            ["episode", "return", "predicted", *(heading(n) for n in names), "success", "end"],
            [
                [str(row.episode), f"{row.total_reward:.1f}", f"{row.predicted_return:.1f}",
                 *(figure_text(n, result.summary.get(n, math.nan)) for n in names), "yes" if row.success else "no",
                 row.end.lower().replace("_", " ")]
                for row, result in zip(run.episodes, run.results, strict=True)
            ],
        )  # fmt: skip
        rows = run.episodes
        text = f"Success in {sum(r.success for r in rows)} of {len(rows)} episodes"
        if all(r.violations == r.violations for r in rows):
            text += f", {sum(r.violations > 0 for r in rows)} with a violated constraint"
        if all(r.data.metadata["task"] in ("parking", "obstacles") for r in run.results):
            text += (
                ": within 0.2 m and 0.35 rad of the goal, slower than 0.3 m/s at the end. Strictly, by the criterion "
                "of the authors of Sim-FSVGD, within 0.05 m and 0.2 rad: "
                f"{sum(r.is_strictly_parked for r in rows)}"
            )
        console.print(f"{text}.", soft_wrap=True)


def _cost_text(row: EpisodeFigures) -> str:
    """Constraint cost and violations of an episode; empty for a task without a constraint."""
    if row.cost != row.cost:
        return ""
    return f", constraint cost {row.cost:.1f} (predicted {row.predicted_cost:.1f}) in {row.violations:.0f} ticks"
