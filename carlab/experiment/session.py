"""Several episodes on one car, each recorded, with everything that may go wrong looked after.

The car is opened once; each episode gets a recorder of its own. Signals ask the loop to end; a watch thread ends what
does not obey: it stops the car, tells the recording why, finishes the files and hands over to ``on_abandon``.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from carlab.core.car import Car
from carlab.core.clock import wall_clock_ns
from carlab.core.documents import Document, EpisodeEnded, Tick
from carlab.core.episode_data import EpisodeData
from carlab.core.errors import PoseLostError
from carlab.core.outcome import EndReason
from carlab.core.policy import Policy
from carlab.core.quantities import CarState
from carlab.core.safety import SafetyEnvelope
from carlab.core.task import Task
from carlab.experiment.episode import EpisodeHooks, run_episode
from carlab.experiment.interrupts import Interrupts, LoopWatch
from carlab.recording.mcap_sink import McapSink
from carlab.recording.recorder import Recorder
from carlab.recording.rerun_sink import RerunSink
from carlab.recording.run_directory import RunDirectory
from carlab.recording.sink import LogLine

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class EpisodeResult:
    """One line of the table at the end. ``summary`` are the task's figures of the final state."""

    episode: int
    data: EpisodeData
    reason: EndReason
    summary: Mapping[str, float]
    path: Path

    @property
    def total_reward(self) -> float:
        """Sum of rewards."""
        return float(np.sum(self.data.rewards))


def result_of(number: int, data: EpisodeData, task: Task, path: Path) -> EpisodeResult:
    """The line of an episode as it was recorded."""
    final = CarState.from_array(data.states[-1])
    return EpisodeResult(number, data, EndReason[data.metadata["end_reason"]], task.summary(final), path)


@dataclass(slots=True)
class SessionHooks:
    """What a session asks of the person in front of it.

    ``place_by_hand`` is called where the car cannot put itself at its start; it returns when it stands there.
    ``on_tick`` sees each tick, for a progress bar. ``stop_reason`` may end an episode (a dead-man, say).
    ``on_abandon`` is called last when the loop hung: reason, detail; the process must end there.
    """

    place_by_hand: Callable[[CarState], None] = lambda start: None
    on_episode: Callable[[int, int], None] = lambda episode, ticks: None
    on_tick: Callable[[Tick], None] = lambda tick: None
    on_result: Callable[[EpisodeResult], None] = lambda result: None
    stop_reason: Callable[[], EndReason | None] = lambda: None
    on_abandon: Callable[[EndReason, str], None] = lambda reason, detail: None


@dataclass(slots=True)
class Session:
    """Drives ``episodes`` of a task with a policy on an open car into a run directory."""

    car: Car
    policy: Policy
    task: Task
    envelope: SafetyEnvelope
    run: RunDirectory
    period_s: float
    seed: int = 0
    max_ticks: int | None = None
    config_toml: str = ""
    metadata: Mapping[str, str] = field(default_factory=dict)
    hooks: SessionHooks = field(default_factory=SessionHooks)
    hang_timeout_s: float = 2.0
    place: bool = True
    record_rerun: bool = True

    def drive(self, episodes: int) -> list[EpisodeResult]:
        """Drive; ends early when asked to stop or when an episode ended for safety. Raises what run_episode raises."""
        results: list[EpisodeResult] = []
        starts = np.random.SeedSequence(self.seed).spawn(episodes)
        with Interrupts() as interrupts:
            for index in range(episodes):
                start = self.task.sample_start(np.random.default_rng(starts[index]))
                if not (self.place and self.car.place(start)):
                    if self.place:
                        interrupts.ask(functools.partial(self.hooks.place_by_hand, start))
                    if not interrupts.requested.is_set():
                        wait_until_still(self.car)
                if interrupts.requested.is_set():
                    break
                result = self._drive_one(self.run.next_episode(), interrupts)
                results.append(result)
                self.hooks.on_result(result)
                if result.reason.is_safety_stop or result.reason is EndReason.STOP_REQUESTED:
                    break
        return results

    def _drive_one(self, number: int, interrupts: Interrupts) -> EpisodeResult:
        path = self.run.episode_path(number, ".mcap")
        sinks: list[McapSink | RerunSink] = [McapSink(path, self.metadata)]
        if self.record_rerun:
            sinks.append(RerunSink(self.run.episode_path(number, ".rrd")))
        recorder = Recorder(sinks)
        last_tick: list[Tick] = []
        # Whoever tells the end first, the loop or the watch, has the last word: a loop that comes back says no more.
        turn, told = threading.Lock(), [False]

        def take_last_word() -> bool:
            with turn:
                first, told[0] = not told[0], True
            return first

        def emit(document: Document) -> None:
            if take_last_word() if isinstance(document, EpisodeEnded) else not told[0]:
                recorder.emit(document)
            if isinstance(document, Tick):
                last_tick[:] = [document]
                self.hooks.on_tick(document)

        def abandon(where: str, stack: str) -> None:
            urgent = interrupts.urgent.is_set()
            reason = EndReason.STOP_REQUESTED if urgent else EndReason.LOOP_HUNG
            detail = f"The loop hung while {where}."
            stood = f"The control loop hangs while {where}:\n{stack}"
            has_last_word = take_last_word()
            with contextlib.suppress(Exception):
                self.car.stop(planned=False)
            t_s = last_tick[0].t_s if last_tick else self.car.clock.now_s()
            steps = last_tick[0].step if last_tick else 0
            if has_last_word:
                recorder.emit(LogLine(wall_clock_ns(), logging.CRITICAL, __name__, stood))
                recorder.emit(EpisodeEnded(t_s, reason, detail, steps, float("nan")))
            recorder.close()
            with contextlib.suppress(Exception):
                self.car.close()
            log.critical("%s", stood)
            self.hooks.on_abandon(reason, detail)

        watch = LoopWatch(abandon, timeout_s=self.hang_timeout_s, urgent=interrupts.urgent)
        hooks = EpisodeHooks(
            emit=emit,
            stop_requested=lambda: interrupts.reason() or self.hooks.stop_reason(),
            recorder_failed=lambda: recorder.failed,
            heartbeat=watch.beat,
        )
        ticks = self.task.max_ticks if self.max_ticks is None else self.max_ticks
        self.hooks.on_episode(number, ticks)
        with recorder, _logged(recorder), watch:
            data = run_episode(
                self.car,
                self.policy,
                self.task,
                self.envelope,
                period_s=self.period_s,
                max_ticks=self.max_ticks,
                hooks=hooks,
                episode=number,
                seed=self.seed,
                config_toml=self.config_toml,
                metadata=self.metadata,
            )
            watch.rest()
        if recorder.failed is not None:
            log.error("Episode %d: %s", number, recorder.failed)
        return result_of(number, data, self.task, path)


@contextlib.contextmanager
def _logged(recorder: Recorder) -> Iterator[None]:
    """Write the program's log into the recording meanwhile."""
    handler = recorder.log_handler()
    root = logging.getLogger()
    root.addHandler(handler)
    try:
        yield
    finally:
        root.removeHandler(handler)


def wait_until_still(car: Car, timeout_s: float = 3.0, speed_mps: float = 0.05) -> bool:
    """Wait, in neutral, until the car is seen to stand; False where it is not within ``timeout_s`` of its clock."""
    give_up_s = car.clock.now_s() + timeout_s
    while car.clock.now_s() <= give_up_s:
        with contextlib.suppress(PoseLostError):
            seen = car.observe()
            if seen.velocity_valid and seen.state.speed_mps <= speed_mps:
                return True
        car.clock.sleep_until(car.clock.now_s() + 0.02)
    return False
