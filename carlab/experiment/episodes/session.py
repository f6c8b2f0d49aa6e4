"""Several recorded episodes on one car.

The car is opened once; each episode has its own recorder. Signals request the end of the loop. If the loop does not
end, a watchdog thread stops the car, writes the reason into the recording, finishes the files and calls ``on_abandon``.
A simulated clock stands still while the loop hangs, so there only a second signal starts the watchdog.
"""

from __future__ import annotations

import contextlib
import functools
import gc
import logging
import math
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from carlab.core.car import Car
from carlab.core.clock import SimulatedClock, wall_clock_ns
from carlab.core.documents import Document, EpisodeEnded, Tick
from carlab.core.episode_data import EpisodeData
from carlab.core.errors import ConfigError, PoseLostError, add_sentence
from carlab.core.geofence import contains
from carlab.core.outcome import EndReason
from carlab.core.policy import Policy
from carlab.core.quantities import CarState
from carlab.core.safety import SafetyEnvelope, SafetyStop
from carlab.core.task import Task
from carlab.experiment.episodes.episode import EpisodeHooks, run_episode
from carlab.experiment.episodes.hooks import RunHooks
from carlab.experiment.episodes.interrupts import Interrupts, LoopWatch
from carlab.experiment.episodes.result import EpisodeResult, result_of
from carlab.recording.mcap.sink import McapSink
from carlab.recording.recorder import Recorder
from carlab.recording.run_folder import RunDirectory
from carlab.recording.sink import LogLine, Sink

log = logging.getLogger(__name__)

STILL_MPS = 0.05
"""Largest measured speed of a car that stands [m/s]."""


@dataclass(slots=True)
class Session:
    """Drives ``episodes`` of a task with a policy on an open car into a run directory.

    ``stop_reason`` may end an episode (dead-man control).
    """

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
    hooks: RunHooks = field(default_factory=RunHooks)
    stop_reason: Callable[[], EndReason | None] = lambda: None
    hang_timeout_s: float = 2.0
    place: bool = True
    record_rerun: bool = True
    _abandoned: SafetyStop | None = field(default=None, init=False)

    def drive(self, episodes: int) -> list[EpisodeResult]:
        """Drive episodes; ends early on a stop request or after a safety stop.

        Raises:
            SafetyStop: the loop hung and the watchdog thread stopped the car. ConfigError: the task cannot draw a
                start, draws one outside the arena at which a person would place the car, or cannot evaluate an
                episode. Other errors: those of run_episode.
        """
        results: list[EpisodeResult] = []
        starts = np.random.SeedSequence(self.seed).spawn(episodes)
        with Interrupts() as interrupts:
            for index in range(episodes):
                if self._abandoned is not None:
                    raise self._abandoned
                start = _start_of(self.task, np.random.default_rng(starts[index]))
                if not (self.place and self.car.place(start)):
                    if self.place:
                        _require_inside(self.envelope, start)
                        interrupts.prompt(functools.partial(self.hooks.place_by_hand, start))
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
        sinks: list[Sink] = [McapSink(path, self.metadata)]
        if self.record_rerun:
            from carlab.recording.rerun.sink import RerunSink  # loads rerun

            sinks.append(RerunSink(self.run.episode_path(number, ".rrd")))
        recorder = Recorder(sinks)
        emitter = _Emitter(recorder, self.hooks)
        abandon = functools.partial(self._abandon, recorder, emitter, interrupts)
        timeout_s = math.inf if isinstance(self.car.clock, SimulatedClock) else self.hang_timeout_s
        watch = LoopWatch(abandon, timeout_s=timeout_s, urgent=interrupts.urgent)
        hooks = EpisodeHooks(
            emit=emitter.emit,
            stop_requested=lambda: interrupts.reason() or self.stop_reason(),
            recorder_failed=lambda: recorder.failed,
            heartbeat=watch.beat,
        )
        self.hooks.on_episode(number, self.task.max_ticks if self.max_ticks is None else self.max_ticks)
        try:
            with _objects_frozen(), recorder, _logged(recorder), watch:
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
                watch.pause()
        except Exception as error:
            if self._abandoned is not None:
                add_sentence(self._abandoned, f"The recording is {path}.")
                raise self._abandoned from error
            raise
        if emitter.hung is not None:
            data = _with_end(data, emitter.hung.reason, emitter.hung.detail)
        return result_of(number, _with_recorder_error(data, recorder.failed), self.task, path)

    def _abandon(self, recorder: Recorder, emitter: _Emitter, interrupts: Interrupts, where: str, stack: str) -> None:
        """Stop the car and finish the recording of a hanging loop; called from the watchdog thread."""
        reason = EndReason.STOP_REQUESTED if interrupts.urgent.is_set() else EndReason.LOOP_HUNG
        detail = f"The loop hung while {where}."
        log_text = f"The control loop hangs while {where}:\n{stack}"
        self._abandoned = SafetyStop(reason, detail)
        ends_episode = emitter.claim_end()
        with contextlib.suppress(Exception):
            self.car.stop(planned=False)
        tick = emitter.last_tick
        t_s = tick.t_s if tick is not None else self.car.clock.now_s()
        if ends_episode:
            emitter.hung = self._abandoned
            recorder.emit(LogLine(wall_clock_ns(), logging.CRITICAL, __name__, log_text))
            recorder.emit(EpisodeEnded(t_s, reason, detail, tick.step if tick is not None else 0, float("nan")))
        recorder.close()
        with contextlib.suppress(Exception):
            self.car.close()
        log.critical("%s", log_text)
        self.hooks.on_abandon(reason, detail)


class _Emitter:
    """Passes documents to a recorder until the episode has ended.

    Either the loop or the watchdog thread ends the episode; later documents of the loop are discarded. ``hung`` is the
    end by the watchdog thread.
    """

    def __init__(self, recorder: Recorder, hooks: RunHooks) -> None:
        self._recorder, self._hooks = recorder, hooks
        self._lock = threading.Lock()
        self._ended = False
        self.last_tick: Tick | None = None
        self.hung: SafetyStop | None = None

    def claim_end(self) -> bool:
        """Whether the caller is the first to end the episode."""
        with self._lock:
            is_first, self._ended = not self._ended, True
        return is_first

    def emit(self, document: Document) -> None:
        """Record a document of the loop."""
        if self.claim_end() if isinstance(document, EpisodeEnded) else not self._ended:
            self._recorder.emit(document)
            self._hooks.on_document(document)
        if isinstance(document, Tick):
            self.last_tick = document
            self._hooks.on_tick(document)


def _require_inside(envelope: SafetyEnvelope, start: CarState) -> None:
    """Raise ConfigError if a person would have to place the car outside the arena, where each episode ends at once."""
    if envelope.arena_m and not contains(envelope.arena_m, start.x_m, start.y_m):
        raise ConfigError(
            f"The start pose ({start.x_m:.2f}, {start.y_m:.2f}) m is outside the arena; enlarge the arena (that of the "
            "car file, else that of the task), or start at the car's current pose (drive: --no-place)."
        )


def _start_of(task: Task, rng: np.random.Generator) -> CarState:
    """A start of the task. Raises ConfigError if the task cannot draw one."""
    try:
        return task.sample_start(rng)
    except (Exception, SystemExit) as error:
        raise ConfigError(
            f"The task {task.name} cannot draw a start ({type(error).__name__}: {error}); correct its sample_start."
        ) from error


def _with_recorder_error(data: EpisodeData, failed: str | None) -> EpisodeData:
    """Set the end reason to RECORDER_ERROR if the recording failed, unless the episode ended with a safety stop."""
    if failed is None or EndReason[data.metadata["end_reason"]].is_safety_stop:
        return data
    return _with_end(data, EndReason.RECORDER_ERROR, failed)


def _with_end(data: EpisodeData, reason: EndReason, detail: str) -> EpisodeData:
    return replace(data, metadata={**data.metadata, **reason.texts(detail)})


@contextlib.contextmanager
def _logged(recorder: Recorder) -> Iterator[None]:
    """Record the program's log within this context."""
    handler = recorder.log_handler()
    root = logging.getLogger()
    root.addHandler(handler)
    try:
        yield
    finally:
        root.removeHandler(handler)


@contextlib.contextmanager
def _objects_frozen() -> Iterator[None]:
    """Exempt present objects from garbage collection: to visit those of torch and rerun stops the loop for 0.3 s.

    They are not collected first: that would stop the reception of poses for as long, just before the car is armed.
    """
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


def wait_until_still(car: Car, timeout_s: float = 3.0) -> bool:
    """Wait until the measured speed is at most ``STILL_MPS``; False after ``timeout_s`` of the car's clock."""
    deadline_s = car.clock.now_s() + timeout_s
    while car.clock.now_s() <= deadline_s:
        with contextlib.suppress(PoseLostError):
            observation = car.observe()
            if observation.velocity_valid and observation.state.speed_mps <= STILL_MPS:
                return True
        car.clock.sleep_until(car.clock.now_s() + 0.02)
    return False
