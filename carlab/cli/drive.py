"""``carlab drive``."""

from __future__ import annotations

import contextlib
import os
import shlex
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from rich.progress import Progress, TaskID
from tyro.conf import OmitArgPrefixes

from carlab.cli.console import console, fail, progress, table
from carlab.cli.options import CarOptions, has_screen
from carlab.cli.runs import ask_to_place, new_run, write_result
from carlab.core.errors import ConfigError, NotReadyError

if TYPE_CHECKING:
    from carlab.core.clock import Clock
    from carlab.core.outcome import EndReason
    from carlab.core.policy import Policy
    from carlab.experiment.session import EpisodeResult, SessionHooks
    from carlab.experiment.teleop_policy import TeleopPolicy
    from carlab.recording.run_directory import RunDirectory
    from sim_backends.car_parameters import SimulatorConfig

PolicyName = Literal[
    "parking",
    "neutral",
    "keyboard",
    "gamepad",
    "steering_steps",
    "throttle_steps",
    "steering_chirp",
    "figure_eight",
    "throttle_ramp",
    "coast_down",
    "slow_circle",
]
EXIT_SAFETY_STOP = 4
KEY_THROTTLE = 0.4


@dataclass
class Drive:
    """Drive episodes with a policy, a script or a gamepad on a car, and record them.

    Each episode leaves an MCAP and a rerun recording in a new folder under --out, beside a summary picture. Press ^C
    once to end after the tick, twice to stop at once.
    """

    which_car: OmitArgPrefixes[CarOptions] = field(default_factory=CarOptions)

    policy: PolicyName = "parking"
    """parking (feedback), a scripted manoeuvre, neutral, or by hand: keyboard, gamepad (hold the dead-man)."""

    task: Literal["parking", "path"] = "parking"
    """Where the car starts, what is rewarded, and the arena."""

    episodes: int = 1
    """How many."""

    ticks: int | None = None
    """Ticks an episode; the task's number (parking: 100) unless given."""

    seed: int = 0
    """Start poses and sensor noise."""

    max_throttle: float | None = None
    """Largest throttle that passes the safety gate, in (0, 1]."""

    place: bool = True
    """Start each episode at the task's start pose; off: from where the car stands."""

    out: Path = Path("runs")
    """Folder that receives the run's folder."""

    name: str = "drive"
    """Last part of the run folder's name."""

    rerun: bool = True
    """Record .rrd files beside the MCAP files."""

    picture: bool = True
    """Draw summary.png."""

    verbose: bool = False
    """Show the whole log."""

    def run(self) -> int:
        """Drive and say how it went."""
        from carlab.core.task import TASKS
        from carlab.experiment.session import Session

        self._refuse_nonsense()
        choice = self.which_car.choose(seed=self.seed)
        envelope = choice.envelope
        task = TASKS[self.task]()
        if not envelope.arena_m:
            envelope = replace(envelope, arena_m=task.arena_m)
        if self.max_throttle is not None:
            envelope = replace(envelope, max_throttle=self.max_throttle)
        policy, teleop = self._policy(choice.simulator)
        with contextlib.ExitStack() as stack:
            run = stack.enter_context(new_run(self.out, self.name, choice))
            if teleop is not None:
                stack.enter_context(teleop)
            stack.enter_context(choice.car)
            bar = stack.enter_context(progress())
            session = Session(
                choice.car,
                policy,
                task,
                envelope,
                run,
                choice.control_period_s,
                seed=self.seed,
                max_ticks=self.ticks if self.ticks is not None else (10**6 if teleop else None),
                config_toml=choice.config_toml,
                hooks=self._hooks(bar, run, teleop, choice.car.clock),
                place=self.place,
                record_rerun=self.rerun,
            )
            results = session.drive(self.episodes)
        return self._report(results, run)

    def _refuse_nonsense(self) -> None:
        for name, value, least in (("episodes", self.episodes, 1), ("ticks", self.ticks, 1), ("seed", self.seed, 0)):
            if value is not None and value < least:
                raise ConfigError(f"--{name} {value}: at least {least}.")
        if self.max_throttle is not None and not 0.0 < self.max_throttle <= 1.0:
            raise ConfigError(f"--max-throttle {self.max_throttle:g}: above 0, at most 1.")
        if self.task == "path" and self.policy == "parking":
            raise ConfigError("The parking policy follows no path; choose another --policy for --task path.")
        if self.policy == "keyboard" and not has_screen():
            raise NotReadyError("Keyboard", ["its window needs a screen and there is none; use --policy gamepad."])

    def _policy(self, simulator: SimulatorConfig) -> tuple[Policy, TeleopPolicy | None]:
        from carlab.core.manoeuvres import MANOEUVRES
        from carlab.experiment.scripted_policies import ManoeuvrePolicy, NeutralPolicy, ReverseParkingPolicy
        from carlab.experiment.teleop_policy import GamepadSource, KeyboardSource, TeleopPolicy

        if self.policy in ("keyboard", "gamepad"):
            # A gamepad at full travel means the largest throttle; a key never means more than that either.
            top = self.max_throttle or 1.0
            source = KeyboardSource(min(KEY_THROTTLE / top, 1.0)) if self.policy == "keyboard" else GamepadSource()
            teleop = TeleopPolicy(source, top)
            return teleop, teleop
        if self.policy == "neutral":
            return NeutralPolicy(), None
        if self.policy == "parking":
            return ReverseParkingPolicy.for_car(simulator), None
        return ManoeuvrePolicy(MANOEUVRES[self.policy]()), None

    def _hooks(self, bar: Progress, run: RunDirectory, teleop: TeleopPolicy | None, clock: Clock) -> SessionHooks:
        from carlab.core.clock import MonotonicClock
        from carlab.core.documents import Tick
        from carlab.experiment.session import SessionHooks

        rows: list[TaskID] = []
        wall = MonotonicClock()
        # A simulated car waits for nobody; one that is driven by hand must.
        waits = teleop is not None and not isinstance(clock, MonotonicClock)
        began_s = [0.0]

        def on_episode(number: int, ticks: int) -> None:
            rows.append(bar.add_task(f"episode {number}", total=ticks, note=""))
            began_s[0] = wall.now_s() - clock.now_s()

        def on_tick(tick: Tick) -> None:
            state = tick.observation.state
            note = f"({state.x_m:+.2f}, {state.y_m:+.2f}) m  {state.speed_mps:.2f} m/s"
            bar.update(rows[-1], completed=tick.step + 1, note=note)
            if waits:
                wall.sleep_until(began_s[0] + tick.t_s)

        def on_abandon(reason: EndReason, detail: str) -> None:
            fail(f"{reason.value} {detail} The recording is in {run.path}.")
            os._exit(EXIT_SAFETY_STOP)

        return SessionHooks(
            place_by_hand=ask_to_place(bar, "use --no-place or a terminal"),
            on_episode=on_episode,
            on_tick=on_tick,
            on_abandon=on_abandon,
            stop_reason=teleop.stop_reason if teleop is not None else lambda: None,
        )

    def _report(self, results: list[EpisodeResult], run: RunDirectory) -> int:
        from carlab.cli import EXIT_INTERRUPTED
        from carlab.core.outcome import EndReason

        if not results:
            console.print("No episode was driven.")
            return EXIT_INTERRUPTED
        write_result(run, results)
        names = list(results[0].summary)
        rows = [
            [
                str(r.episode),
                str(r.data.ticks),
                f"{r.total_reward:.1f}",
                *(_figure(name, r.summary[name]) for name in names),
                r.reason.name.lower().replace("_", " "),
            ]
            for r in results
        ]
        table("", ["episode", "ticks", "return", *(_heading(n) for n in names), "end"], rows)
        for r in results:
            if r.reason.is_safety_stop:
                fail(f"Episode {r.episode}: {r.reason.value} {r.data.metadata['end_detail']}".rstrip())
        if self.picture:
            from carlab.recording.mcap_source import read_episode
            from carlab.recording.picture import save_summary

            save_summary([read_episode(r.path) for r in results if r.path.exists()], run.path / "summary.png")
        first = results[0].path
        shown = " (summary.png shows it)" if self.picture else ""
        console.print(f"Recorded in {run.path}{shown}. Look at an episode with:", soft_wrap=True, markup=False)
        console.print(f"  carlab view {shlex.quote(str(first))}", soft_wrap=True, markup=False)
        last = results[-1].reason
        if last is EndReason.STOP_REQUESTED:
            return EXIT_INTERRUPTED
        if last in (EndReason.POLICY_ERROR, EndReason.RECORDER_ERROR):
            return 1
        return EXIT_SAFETY_STOP if last.is_safety_stop else 0


def _heading(name: str) -> str:
    stem, _, unit = name.rpartition("_")
    units = {"m": "m", "rad": "rad", "mps": "m/s"}
    return f"{stem.replace('_', ' ')}\n[{units[unit]}]" if unit in units else name.replace("_", " ")


def _figure(name: str, value: float) -> str:
    return ("yes" if value else "no") if name == "parked" else f"{value:.2f}"
