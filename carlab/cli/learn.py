"""``carlab learn``."""

from __future__ import annotations

import contextlib
import functools
import os
import shlex
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from rich.progress import Progress, TaskID
from tyro.conf import OmitArgPrefixes

from carlab.cli.console import console, fail, progress, table
from carlab.cli.drive import EXIT_SAFETY_STOP
from carlab.cli.options import CarOptions, above_zero
from carlab.cli.runs import ask_to_place, existing_run, new_run, write_result
from carlab.core.errors import ConfigError

if TYPE_CHECKING:
    from carlab.cars import CarChoice
    from carlab.core.documents import Tick
    from carlab.core.outcome import EndReason
    from carlab.experiment.campaign import Campaign, CampaignHooks
    from carlab.experiment.campaign_figures import EpisodeFigures
    from carlab.experiment.interrupts import Interrupts
    from carlab.experiment.reality_check import RealityCheck
    from carlab.experiment.session import EpisodeResult
    from carlab.experiment.training import TrainingPlan
    from carlab.recording.run_directory import RunDirectory
    from sim_backends.car_parameters import SimulatorConfig

STEPS_PERIOD_S = 600.0
EPISODES = 20


@dataclass
class Learn:
    """Learn the car, learn to park in the learned car, drive, and again with what was recorded.

    The goal is the origin of the motion capture, facing along x; an episode is 100 ticks (3.3 s at 30 Hz). Before each
    one a person puts a real car at the start that is named; simulated and emulated ones are put there. Between episodes
    another process learns while the car sits in neutral. A run that was ended anywhere goes on with --resume.
    """

    which_car: OmitArgPrefixes[CarOptions] = field(default_factory=CarOptions)

    episodes: int | None = None
    """How many, those that are driven already included: 20 unless given; of a run that is taken up, as many as it was
    started with."""

    ticks: int | None = None
    """Ticks an episode; the task's number (100) unless given. More than --history."""

    prior: str = "kinematic"
    """The simulator that is the prior: kinematic (the car's file, wheels that do not slip), nominal (the car's file as
    it is), or FILE.toml (a diagnosed model.toml, say, which has its effects and its doubts of each number). Ranges are
    those of the file; where it has none, 30 % about motor gain, damping and steering angle, and unless the wheels do
    not slip about yaw inertia and the tyres' stiffness and grip."""

    method: Literal["sim-fsvgd", "fsvgd", "fsvgd-authors"] = "sim-fsvgd"
    """sim-fsvgd; fsvgd without a simulator; or that as the authors of Sim-FSVGD set it, to be compared with."""

    history: int | None = None
    """Past commands that model and policy see. Unless given as many as delay, motion capture and the window of the
    velocities need (4 for the simulated car; fsvgd-authors has the paper's 3); after three episodes it is said how many
    the recordings ask for."""

    model_steps: int | None = None
    """Steps of the model's optimiser before each episode: 2500 unless given (fsvgd-authors: 40 000 at most)."""

    updates: int = 30000
    """Gradient steps of SAC before an episode: half as many again before the first, and after the third the fewer the
    smaller the share of new rows is (3 / episode)."""

    seed: int = 0
    """Number from which all that is random follows: the same seed, the same run."""

    device: Literal["cpu", "cuda"] | None = None
    """Where model and policy learn: cpu unless given; of a run that is taken up, where they did. The car is driven from
    the CPU."""

    place: bool = True
    """Start each episode at the task's start pose, where a person is asked to put a real car; off: from where the car
    stands."""

    resume: Path | None = None
    """A run's folder that is taken up again; --car must be as it was, --episodes and --device may change, all else is
    as the run was started."""

    out: Path = Path("runs")
    """Folder that receives the run's folder."""

    name: str = "learn"
    """Last part of the run folder's name."""

    rerun: bool = True
    """Record .rrd files beside the MCAP files."""

    verbose: bool = False
    """Show the whole log."""

    def run(self) -> int:
        """Learn and say how it went."""
        from carlab.experiment.campaign import Campaign, CampaignHooks, check_same_car, seed_of, taken_up
        from carlab.experiment.campaign_report import restore_rows
        from carlab.experiment.interrupts import Interrupts
        from learning.devices import available

        above_zero(episodes=self.episodes, updates=self.updates, ticks=self.ticks, **{"model-steps": self.model_steps})
        if (self.history or 0) < 0 or self.seed < 0:
            raise ConfigError("--history and --seed: 0 or more.")
        available(self.device or "cpu")
        started = None if self.resume is None else seed_of(self.resume)
        choice = self.which_car.choose(seed=self.seed if started is None else started)
        figures: list[EpisodeFigures] = []
        with contextlib.ExitStack() as stack:
            if self.resume is None:
                plan = self._plan(choice)
                run = stack.enter_context(new_run(self.out, self.name, choice, keep="models"))
            else:
                run = stack.enter_context(existing_run(self.resume, choice))
                check_same_car(run, choice, self.which_car.typed())
                campaign = taken_up(run, choice, CampaignHooks(), self.device)
                available(campaign.plan.device)
                self._check_as_before(campaign, choice)
                campaign.set_stopped_aside()
                restore_rows(run, campaign.plan.task)
            stack.enter_context(choice.car)
            bar = stack.enter_context(progress(speed_estimate_period_s=STEPS_PERIOD_S))
            interrupts = stack.enter_context(Interrupts())
            hooks = self._hooks(bar, run, figures, interrupts)
            if self.resume is None:
                campaign = Campaign(
                    choice, plan, self.episodes or EPISODES, run, hooks, self.ticks, self.place, self.rerun,
                    self._questioned(), self.which_car.typed(),
                )  # fmt: skip
                campaign.write_plan()
            else:
                campaign.hooks = hooks
                if self.episodes is not None and self.episodes != campaign.episodes:
                    campaign.episodes = self.episodes
                    campaign.write_plan()
            results = list(self._watched(campaign, figures))
        return self._report(campaign, results, figures)

    def _plan(self, choice: CarChoice) -> TrainingPlan:
        import tomli_w

        from carlab.cars import is_preset, load_car_file
        from carlab.core.task import ParkingTask
        from carlab.experiment.campaign import PAPERS_HISTORY, check_period, needed_history, prior_simulator
        from carlab.experiment.training import TrainingPlan

        history = self.history
        if history is None:
            history = PAPERS_HISTORY if self.method == "fsvgd-authors" else needed_history(choice.simulator)
        if (ticks := self.ticks or ParkingTask().max_ticks) <= history:
            raise ConfigError(
                f"--ticks {ticks}: nothing is learned from fewer than --history ({history}) and one more."
            )

        if self.prior in ("kinematic", "nominal"):
            kind: Literal["kinematic", "nominal"] = "kinematic" if self.prior == "kinematic" else "nominal"
            simulator = prior_simulator(choice.simulator, kind)
        else:
            file = Path(self.prior)
            if file.suffix != ".toml" and not is_preset(file) and not file.is_file():
                raise ConfigError(f"--prior {self.prior}: neither kinematic nor nominal nor a car file that is there.")
            simulator = prior_simulator(load_car_file(file).simulator, "nominal")
            check_period(simulator, choice.control_period_s, f"car '{self.which_car.car}'")
        text = tomli_w.dumps(simulator.to_tables())
        return TrainingPlan(
            text, history, self.method, self.model_steps, self.updates, self.ticks, self.seed,
            device=self.device or "cpu",
        )  # fmt: skip

    def _check_as_before(self, campaign: Campaign, choice: CarChoice) -> None:
        """Raise ConfigError for an option that is given and is not that of the run which is taken up."""
        plan, usual = campaign.plan, Learn()
        was = {name: getattr(plan, name) for name in ("method", "history", "model_steps", "updates", "seed", "ticks")}
        own = {name: getattr(self, name) for name in was}
        given = [name for name in was if own[name] not in (getattr(usual, name), was[name])]
        if self.prior != usual.prior and self._plan(choice).prior_toml != plan.prior_toml:
            raise ConfigError("--prior: this run was started with another one; leave it out, or start a new run.")
        if given:
            option = given[0].replace("_", "-")
            raise ConfigError(
                f"--{option} {own[given[0]]}: this run was started with {was[given[0]]}; leave it out, or start a new "
                "run."
            )

    def _questioned(self) -> SimulatorConfig | None:
        """The simulator that episodes are checked against, where it is not that of the car's file."""
        from carlab.cars import load_car_file

        return None if self.prior in ("kinematic", "nominal") else load_car_file(Path(self.prior)).simulator

    def _hooks(
        self, bar: Progress, run: RunDirectory, figures: list[EpisodeFigures], interrupts: Interrupts
    ) -> CampaignHooks:
        from carlab.experiment.campaign import CampaignHooks
        from carlab.experiment.campaign_report import keep_check, keep_row
        from carlab.experiment.session import SessionHooks

        rows: dict[str, TaskID] = {}

        def at(what: str, done: int, total: int) -> None:
            if what not in rows:
                for task in rows.values():
                    bar.remove_task(task)
                rows.clear()
                rows[what] = bar.add_task(what, total=total, note="")
            bar.update(rows[what], completed=done, total=total)

        def on_episode(number: int, ticks: int) -> None:
            at(f"episode {number}", 0, ticks)

        def on_tick(tick: Tick) -> None:
            (task,) = rows.values()
            bar.update(task, completed=tick.step + 1)

        def on_abandon(reason: EndReason, detail: str) -> None:
            fail(f"{reason.value} {detail} The recording is in {run.path}.")
            os._exit(EXIT_SAFETY_STOP)

        def on_learned(told: dict[str, Any]) -> None:
            if "history_asked" in told:
                bar.console.print(f"  {told['history_words']}", soft_wrap=True, highlight=False)

        def on_figures(row: EpisodeFigures) -> None:
            figures.append(row)
            keep_row(run, row)
            parked = "parked" if row.parked else f"{row.distance_m:.2f} m from the goal"
            bar.console.print(
                f"episode {row.episode}: return {row.total_reward:.1f} (foretold {row.foretold:.1f}), {parked}; "
                f"learned from {row.rows} rows in {row.model_seconds:.0f} + {row.policy_seconds:.0f} s",
                soft_wrap=True,
            )

        def on_check(told: RealityCheck) -> None:
            if figures and figures[-1].episode == told.episode:
                figures[-1] = figures[-1].with_check(told)
            keep_check(run, told)
            for sentence in told.sentences:
                bar.console.print(f"  {sentence}", soft_wrap=True, markup=False, highlight=False)

        session = SessionHooks(
            place_by_hand=ask_to_place(bar, "use --no-place or a terminal"), on_episode=on_episode, on_tick=on_tick,
            on_abandon=on_abandon,
        )  # fmt: skip
        checking = functools.partial(at, "asking whether the simulator still explains it", 0, 1)
        return CampaignHooks(session, at, on_learned, on_figures, checking, on_check, interrupts.requested.is_set)

    def _watched(self, campaign: Campaign, figures: list[EpisodeFigures]) -> list[EpisodeResult]:
        from carlab.experiment.campaign_report import write_report

        results = []
        for result in campaign.go_on():
            results.append(result)
            write_report(campaign.run, campaign.plan, figures[-1])
        return results

    def _report(self, campaign: Campaign, results: list[EpisodeResult], figures: list[EpisodeFigures]) -> int:
        from carlab.cli import EXIT_INTERRUPTED
        from carlab.experiment.campaign import GOES_ON

        if not campaign.run.path.is_dir():
            console.print("Nothing was learned; start again.")
            return EXIT_INTERRUPTED
        done = len(campaign.run.recordings())
        if not results and done >= campaign.episodes:
            console.print(
                f"All {done} episodes are driven; {campaign.run.path} has nothing left to do.", soft_wrap=True
            )
        if results:
            write_result(campaign.run, results)
            table(
                "",
                ["episode", "return", "foretold", "distance\n[m]", "yaw error\n[rad]", "speed\n[m/s]", "parked", "end"],
                [
                    [str(r.episode), f"{r.total_reward:.1f}", f"{r.foretold:.1f}", f"{r.distance_m:.2f}",
                     f"{r.yaw_error_rad:.2f}", f"{r.speed_mps:.2f}", "yes" if r.parked else "no",
                     r.end.lower().replace("_", " ")]
                    for r in figures
                ],
            )  # fmt: skip
            console.print(f"Learned and recorded in {campaign.run.path} (learn.png, learn.rrd).", soft_wrap=True)
        if done < campaign.episodes:
            console.print(
                f"{done} of {campaign.episodes} episodes; go on with: "
                f"carlab learn --resume {shlex.quote(str(campaign.run.path))}{self.which_car.typed()}",
                soft_wrap=True,
            )
            last = results[-1].reason if results else None
            return (
                EXIT_SAFETY_STOP
                if last is not None and last.is_safety_stop and last not in GOES_ON
                else EXIT_INTERRUPTED
            )
        return 0
